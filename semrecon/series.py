"""Tilt series on disk: a folder of images with `series.toml`, or plain image files with stated tilts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semrecon.data import Image, Optics, TiltSeries, View
from semrecon.errors import InputError
from semrecon.folder import whole_folder
from semrecon.images import read_image
from semrecon.settings import read_toml

SERIES_FILE = "series.toml"


@dataclass(frozen=True)
class ViewEntry:
    """One ``[[view]]`` of `series.toml`: image files are named relative to the folder."""

    image: str
    tilt_deg: float
    channels: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SeriesFile:
    """What `series.toml` may say; the names of the fields are the keys of the file."""

    pixel_size_um: float
    view: tuple[ViewEntry, ...]
    tilt_axis_deg: float = 0.0
    working_distance_um: float | None = None


def read_series_file(folder: Path | str) -> SeriesFile:
    """Read and check `series.toml`; raises `InputError` with the key and the file in the sentence."""
    file = Path(folder) / SERIES_FILE
    if not file.exists():
        raise InputError(f"{folder} holds no {SERIES_FILE}; write one, or give the image files instead")
    settings = read_toml(file, SeriesFile)
    if not settings.view:
        raise InputError(f"{file} names no [[view]]; give two or more, each with image and tilt_deg")
    _check_positive("pixel_size_um", settings.pixel_size_um, file)
    if settings.working_distance_um is not None:
        _check_positive("working_distance_um", settings.working_distance_um, file)
    return settings


def read_series(folder: Path | str) -> TiltSeries:
    """Read a series folder (docs/conventions.md). `truth/` beside the images is never opened."""
    return series_from_file(folder, read_series_file(folder))


def series_from_file(folder: Path | str, settings: SeriesFile, crop_bottom_px: int = 0) -> TiltSeries:
    """Read the images that `settings` names, relative to `folder`."""
    folder = Path(folder)
    views = tuple(_read_view(folder, entry, crop_bottom_px) for entry in settings.view)
    wd_um = settings.working_distance_um
    return _assemble(views, settings.pixel_size_um, settings.tilt_axis_deg, 0.0 if wd_um is None else 1 / wd_um)


def read_images(
    paths: Sequence[Path | str],
    tilts_deg: Sequence[float],
    pixel_size_um: float,
    tilt_axis_deg: float = 0.0,
    crop_bottom_px: int = 0,
) -> TiltSeries:
    """Read plain image files as a series.

    Parameters
    ----------
    paths, tilts_deg
        One tilt an image, degrees.
    pixel_size_um
        Of all images.
    crop_bottom_px
        Rows to cut off at the bottom (a data bar), of all images.
    """
    if len(paths) != len(tilts_deg):
        raise InputError(f"there are {len(tilts_deg)} tilts for {len(paths)} images; give one tilt an image")
    entries = [ViewEntry(str(path), float(tilt)) for path, tilt in zip(paths, tilts_deg, strict=True)]
    views = tuple(_read_view(Path(), entry, crop_bottom_px) for entry in entries)
    return _assemble(views, pixel_size_um, tilt_axis_deg, 0.0)


def write_series(series: TiltSeries, folder: Path | str) -> None:
    """Write a series folder that `read_series` reads back to the bit; the folder must be new or empty."""
    import tifffile
    import tomli_w

    with whole_folder(Path(folder), recognise=lambda _: False) as partial:
        for name, image in _files(series):
            tifffile.imwrite(partial / name, image, photometric="minisblack", metadata=None)
        with (partial / SERIES_FILE).open("wb") as file:
            tomli_w.dump(_content(series), file)


def _files(series: TiltSeries) -> list[tuple[str, Image]]:
    """Name every image and channel as `series.toml` does."""
    named = [(f"view_{i:02d}.tif", view.image) for i, view in enumerate(series.views)]
    channels = [(f"view_{i:02d}_{c}.tif", image) for i, v in enumerate(series.views) for c, image in v.channels.items()]
    return named + channels


def _content(series: TiltSeries) -> dict[str, Any]:
    """`series.toml` as a dictionary."""
    tables: list[dict[str, Any]] = []
    for i, view in enumerate(series.views):
        tables.append({"image": f"view_{i:02d}.tif", "tilt_deg": view.tilt_deg})
        if view.channels:
            tables[-1]["channels"] = {c: f"view_{i:02d}_{c}.tif" for c in view.channels}
    k = series.optics.inverse_working_distance
    perspective = {"working_distance_um": 1 / k} if k > 0 else {}
    scale = {"pixel_size_um": series.optics.pixel_size_um, "tilt_axis_deg": series.tilt_axis_deg}
    return {**scale, **perspective, "view": tables}


def _read_view(folder: Path, entry: ViewEntry, crop_bottom_px: int) -> View:
    channels = {name: _cropped(folder / file, crop_bottom_px) for name, file in entry.channels.items()}
    image = _cropped(folder / entry.image, crop_bottom_px)
    for name, channel in channels.items():
        if channel.shape != image.shape:
            raise InputError(f"channel {name} of {entry.image} differs in size from it; record both in one scan")
    return View(image, entry.tilt_deg, name=Path(entry.image).name, channels=channels)


def _cropped(path: Path, crop_bottom_px: int) -> Image:
    image = read_image(path)
    if not 0 <= crop_bottom_px < len(image):
        raise InputError(f"cannot crop {crop_bottom_px} rows off {path}, which has {len(image)}")
    return image[: len(image) - crop_bottom_px]


def _assemble(views: tuple[View, ...], pixel_size_um: float, tilt_axis_deg: float, k: float) -> TiltSeries:
    if not views:
        raise InputError("the series names no image; give two or more")
    if not math.isfinite(tilt_axis_deg):
        raise InputError(f"tilt axis must be an angle in degrees, not {tilt_axis_deg}")
    height, width = views[0].image.shape
    return TiltSeries(views, Optics(pixel_size_um, width, height, k), tilt_axis_deg)


def _check_positive(key: str, value: float, file: Path) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{file}: {key} must be a positive number of micrometres, not {value:g}")
