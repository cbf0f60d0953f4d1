"""Tilt series on disk: a folder of images with `series.toml`, or plain image files with stated tilts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from semrecon.data import ChannelGeometry, Image, Optics, TiltSeries, View
from semrecon.errors import InputError
from semrecon.folder import whole_folder
from semrecon.input.images import read_image
from semrecon.input.vendors.base import LIMITS
from semrecon.settings import read_toml

SERIES_FILE = "series.toml"
MOST_TILT_DEG, MOST_AXIS_DEG = 90.0, 360.0


@dataclass(frozen=True)
class ViewEntry:
    """One ``[[view]]`` of `series.toml`: image files are named relative to the folder."""

    image: str
    tilt_deg: float
    channels: Mapping[str, str] = field(default_factory=dict)
    stage_um: tuple[float, float] | None = None


@dataclass(frozen=True)
class SeriesFile:
    """What `series.toml` may say; the names of the fields are the keys of the file."""

    pixel_size_um: float
    view: tuple[ViewEntry, ...]
    tilt_axis_deg: float | None = None
    working_distance_um: float | None = None
    channel: Mapping[str, ChannelGeometry] = field(default_factory=dict)


def read_series_file(folder: Path | str) -> SeriesFile:
    """Read and check `series.toml`; raises `InputError` with the key and the file in the sentence."""
    file = Path(folder) / SERIES_FILE
    if not file.exists():
        raise InputError(f"{folder} holds no {SERIES_FILE}; write one, or give the image files instead")
    settings = read_toml(file, SeriesFile)
    if not settings.view:
        raise InputError(f"{file} names no [[view]]; give one for every image, with image and tilt_deg")
    check_length("pixel_size_um", settings.pixel_size_um, f"{file}: ")
    if settings.working_distance_um is not None:
        check_length("working_distance_um", settings.working_distance_um, f"{file}: ")
    if settings.tilt_axis_deg is not None:
        check_axis(settings.tilt_axis_deg, f"{file}: ")
    recorded = {name for entry in settings.view for name in entry.channels}
    if strangers := sorted(set(settings.channel) - recorded):
        named = f"those named are {', '.join(sorted(recorded))}" if recorded else "none is named"
        raise InputError(f"{file}: channel {strangers[0]} is in no [[view]]; {named}")
    return settings


def read_series(folder: Path | str) -> TiltSeries:
    """Read a series folder (docs/conventions.md). `truth/` beside the images is never opened."""
    return series_from_file(folder, read_series_file(folder))


def series_from_file(folder: Path | str, settings: SeriesFile, crop_bottom_px: int = 0) -> TiltSeries:
    """Read the images that `settings` names, relative to `folder`."""
    folder = Path(folder)
    views = tuple(_read_view(folder, entry, crop_bottom_px) for entry in settings.view)
    wd_um = settings.working_distance_um
    series = _assemble(
        views, settings.pixel_size_um, settings.tilt_axis_deg or 0.0, 0.0 if wd_um is None else 1 / wd_um
    )
    return replace(series, channel_geometry=dict(settings.channel))


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
        if view.stage_um is not None:
            tables[-1]["stage_um"] = list(view.stage_um)
    k = series.optics.inverse_working_distance
    perspective = {"working_distance_um": 1 / k} if k > 0 else {}
    scale = {"pixel_size_um": series.optics.pixel_size_um, "tilt_axis_deg": series.tilt_axis_deg}
    known = {name: _stated(asdict(geometry)) for name, geometry in series.channel_geometry.items()}
    return {**scale, **perspective, **({"channel": known} if known else {}), "view": tables}


def _stated(values: dict[str, float | None]) -> dict[str, float]:
    """Leave out what is not known: TOML has no word for it."""
    return {key: value for key, value in values.items() if value is not None}


def _read_view(folder: Path, entry: ViewEntry, crop_bottom_px: int) -> View:
    channels = {name: _cropped(folder / file, crop_bottom_px) for name, file in entry.channels.items()}
    image = _cropped(folder / entry.image, crop_bottom_px)
    for name, channel in channels.items():
        if channel.shape != image.shape:
            raise InputError(f"channel {name} of {entry.image} differs in size from it; record both in one scan")
    if not abs(entry.tilt_deg) <= MOST_TILT_DEG and not math.isnan(entry.tilt_deg):
        raise InputError(f"{entry.image} has a tilt of {entry.tilt_deg:g} degrees; give one from -90 to 90")
    numbers = np.logical_and.reduce([~np.isnan(one) for one in (image, *channels.values())])
    filled = {name: _filled(channel) for name, channel in channels.items()}
    mask = None if numbers.all() else numbers
    return View(_filled(image), entry.tilt_deg, Path(entry.image).name, mask, filled, entry.stage_um)


def _filled(image: Image) -> Image:
    """Put the median where a float image has no number, so that every view is finite; its mask says where."""
    if image.dtype.kind != "f" or not np.isnan(image).any():
        return image
    filled = np.where(np.isnan(image), np.nanmedian(image), image).astype(image.dtype)
    filled.setflags(write=False)
    return filled


def _cropped(path: Path, crop_bottom_px: int) -> Image:
    image = read_image(path)
    if not 0 <= crop_bottom_px < len(image):
        raise InputError(f"cannot crop {crop_bottom_px} rows off {path}, which has {len(image)}")
    return image[: len(image) - crop_bottom_px]


def _assemble(views: tuple[View, ...], pixel_size_um: float, tilt_axis_deg: float, k: float) -> TiltSeries:
    if not views:
        raise InputError("the series names no image; give the paths of images")
    check_axis(tilt_axis_deg)
    height, width = views[0].image.shape
    return TiltSeries(views, Optics(pixel_size_um, width, height, k), tilt_axis_deg)


def check_axis(tilt_axis_deg: float, where: str = "") -> None:
    """Refuse what is no direction; raises `InputError` with `where` in front of the sentence."""
    if not abs(tilt_axis_deg) <= MOST_AXIS_DEG:
        raise InputError(f"{where}tilt axis must be an angle in degrees from -360 to 360, not {tilt_axis_deg:g}")


def check_length(key: str, value: float, where: str = "", option: str = "") -> None:
    """Refuse a length that is none, or that no microscope can have; raises `InputError`.

    Parameters
    ----------
    key
        Of `series.toml` and of the limits for metadata.
    where, option
        Begin of the sentence, and how to call the key in it.
    """
    least, most, noun, unit = LIMITS[key]
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{where}{option or key} must be a positive number of micrometres, not {value:g}")
    if not least <= value <= most:
        raise InputError(f"{where}{option or key} is {value:g}, which no {noun} can be; give it in {unit}")
