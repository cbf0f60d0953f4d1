"""From what a user gives (a folder or images, flags) to a series, with a word on every contradiction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from semrecon.data import ChannelGeometry, TiltSeries
from semrecon.errors import InputError
from semrecon.input.bottom import Bottom, bottom_of
from semrecon.input.dead_lines import dead_lines_of, said_of, without
from semrecon.input.duplicates import SAME_TILT_DEG, check_named_once, check_no_copies, equal_tilts
from semrecon.input.metadata import ImageMetadata, read_metadata
from semrecon.input.series import SERIES_FILE, SeriesFile, ViewEntry, check_length, read_series_file, series_from_file

SAME_PIXEL_SIZE = 1e-3
"""Relative difference of pixel sizes up to which two statements agree; 0.1 % already bends a surface visibly."""


@dataclass(frozen=True)
class Stated:
    """What the user says on the command line; None leaves it to the files.

    Parameters
    ----------
    tilts_deg
        One an image, degrees.
    pixel_size_um, tilt_axis_deg
        As in `series.toml`.
    flip_tilt
        Count tilts the other way: a relief that came out inside out turns right.
    crop_bottom_px
        Rows to cut off at the bottom of every image; None cuts off a data bar where one is certain, 0 nothing.
    working_distance_um
        Take the projection to be central, from so far above the specimen; None leaves it parallel, unless
        `series.toml` says otherwise.
    tilts_required
        Whether images of which nobody states the tilt are refused; otherwise it is taken to be 0, for methods that do
        not look at tilts.
    """

    tilts_deg: tuple[float, ...] | None = None
    pixel_size_um: float | None = None
    tilt_axis_deg: float | None = None
    flip_tilt: bool = False
    crop_bottom_px: int | None = None
    working_distance_um: float | None = None
    tilts_required: bool = True


@dataclass(frozen=True)
class Intake:
    """A series ready to reconstruct.

    Parameters
    ----------
    series
        Images, tilts and optics.
    working_distance_um
        As the files state it, None where they do not; used for warnings only.
    sources
        Who stated the pixel size and the tilts, for the report.
    warnings
        Contradictions and bad settings.
    axis_stated
        Whether files or user stated the direction of the tilt axis; where not, that of the series is 0 for the time
        being, and the images have to tell.
    """

    series: TiltSeries
    working_distance_um: float | None
    sources: tuple[str, ...]
    warnings: tuple[str, ...]
    axis_stated: bool = True


@dataclass(frozen=True)
class Facts:
    """What the files state before the user has spoken.

    Parameters
    ----------
    folder
        What the names of the images are relative to.
    entries
        Images; their tilts count only where `stated` has one.
    stated
        What each image, or `series.toml` for it, says.
    channel
        Where the detectors of channels sit, by name.
    """

    folder: Path
    entries: tuple[ViewEntry, ...]
    stated: tuple[ImageMetadata, ...]
    channel: Mapping[str, ChannelGeometry] = field(default_factory=dict)

    @property
    def pixel_size_um(self) -> float | None:
        """Pixel size of all images; None where one is silent or two differ."""
        return agreed((one.pixel_size_um for one in self.stated), SAME_PIXEL_SIZE)

    @property
    def tilt_axis_deg(self) -> float | None:
        """Tilt axis of all images; None where one is silent or two differ."""
        return agreed((one.tilt_axis_deg for one in self.stated), 0.0)

    @property
    def working_distance_um(self) -> float | None:
        """Working distance of the first image: it may drift a little from one to the next."""
        return self.stated[0].working_distance_um if self.stated else None

    @property
    def data_bar_px(self) -> int | None:
        """Rows of the data bar of all images; None where one is silent or two differ."""
        claims = {one.data_bar_px for one in self.stated}
        return claims.pop() if len(claims) == 1 else None

    @property
    def source(self) -> str:
        """Who speaks, for messages."""
        return ", ".join(dict.fromkeys(one.source for one in self.stated if one.source))


def take_in(inputs: Sequence[Path], stated: Stated | None = None) -> Intake:
    """Read a series folder or image files; what the user states wins over what the files state.

    Raises
    ------
    InputError
        A file is missing or damaged, the images do not fit together, or the tilts or pixel size are nowhere stated.
    """
    stated = stated or Stated()
    facts = facts_of(inputs)
    settings = _merge(stated, facts)
    series = series_from_file(facts.folder, settings, stated.crop_bottom_px or 0)
    bottom = Bottom()
    if stated.crop_bottom_px is None:
        bottom = bottom_of([view.image for view in series.views], facts.data_bar_px, keep=facts.source == SERIES_FILE)
    warnings = [sentence for one in facts.stated for sentence in one.warnings]
    warnings += [*_contradictions(stated, facts), *bottom.said]
    series = _without_bottom(series, bottom.crop_px) if bottom.crop_px else series
    check_no_copies(series)
    series, dead = _without_dead_lines(series)
    warnings += [*dead, *equal_tilts(series)]
    axis_stated = settings.tilt_axis_deg is not None
    return Intake(series, facts.working_distance_um, _sources(stated, facts), tuple(warnings), axis_stated)


def _without_bottom(series: TiltSeries, rows: int) -> TiltSeries:
    """Cut rows off the bottom of every view of plain files, which have no channels."""
    height_px = series.optics.height_px - rows
    views = tuple(
        replace(view, image=view.image[:height_px], mask=None if view.mask is None else view.mask[:height_px])
        for view in series.views
    )
    return replace(series, views=views, optics=replace(series.optics, height_px=height_px))


def _without_dead_lines(series: TiltSeries) -> tuple[TiltSeries, list[str]]:
    """Mask dead lines of every view and channel; say so, and where single pixels are no numbers."""
    found, views, said = [], [], []
    for view in series.views:
        alive = np.ones(view.image.shape, dtype=np.bool_)
        for name, image in {view.name: view.image, **view.channels}.items():
            lines = dead_lines_of(image if view.mask is None else np.where(view.mask, image, np.nan))
            found.append((name if image is view.image else f"channel {name} of {view.name}", lines))
            alive &= without(lines, view.image.shape)
        usable = alive if view.mask is None else alive & view.mask
        odd = int((alive & ~usable).sum())
        said += [f"{view.name}: {odd} pixels are no numbers, left out"] if odd else []
        views.append(view if usable.all() else replace(view, mask=usable))
    return replace(series, views=tuple(views)), [*said_of(found), *said]


def facts_of(inputs: Sequence[Path]) -> Facts:
    """Collect what a series folder or image files state of themselves."""
    folders = [path for path in inputs if _there(path) and path.is_dir()]
    if folders and len(inputs) > 1:
        raise InputError(f"give one series folder or image files, not {folders[0]} beside {len(inputs) - 1} others")
    if folders:
        return _facts_of_folder(folders[0])
    check_named_once(inputs)
    entries = tuple(ViewEntry(str(path), math.nan) for path in inputs)
    return Facts(Path(), entries, tuple(read_metadata(path) for path in inputs))


def _there(path: Path) -> bool:
    """Raise `InputError` for a path that does not exist, or cannot."""
    try:
        there = path.exists()
    except OSError as error:
        raise InputError(f"{str(path)[:200]} cannot be read: {error.strerror}") from None
    if not there:
        raise InputError(f"{path} does not exist; give the paths of images or of one series folder")
    return True


def _facts_of_folder(folder: Path) -> Facts:
    settings = read_series_file(folder)
    check_named_once([folder / view.image for view in settings.view])
    common = ImageMetadata(
        pixel_size_um=settings.pixel_size_um,
        tilt_axis_deg=settings.tilt_axis_deg,
        working_distance_um=settings.working_distance_um,
        source=SERIES_FILE,
    )
    stated = tuple(replace(common, tilt_deg=view.tilt_deg) for view in settings.view)
    return Facts(folder, settings.view, stated, settings.channel)


def agreed(values: Iterable[float | None], tolerance: float) -> float | None:
    """Take the value that all state within a relative tolerance."""
    all_values = list(values)
    known = [value for value in all_values if value is not None]
    if not known or len(known) < len(all_values):
        return None
    return known[0] if all(abs(value - known[0]) <= tolerance * abs(known[0]) for value in known) else None


def _merge(stated: Stated, facts: Facts) -> SeriesFile:
    """Complete settings; raises `InputError` for what nobody stated."""
    axis_deg = stated.tilt_axis_deg if stated.tilt_axis_deg is not None else facts.tilt_axis_deg
    sign = -1.0 if stated.flip_tilt else 1.0
    tilts = _tilts(stated, facts)  # adding 0.0 below turns -0.0 into 0.0
    views = tuple(replace(view, tilt_deg=sign * tilt + 0.0) for view, tilt in zip(facts.entries, tilts, strict=True))
    perspective_um = facts.working_distance_um if facts.source == SERIES_FILE else None
    if stated.working_distance_um is not None:
        perspective_um = stated.working_distance_um
    return SeriesFile(_pixel_size(stated, facts), views, axis_deg, perspective_um, facts.channel)


def _pixel_size(stated: Stated, facts: Facts) -> float:
    if stated.pixel_size_um is not None:
        check_length("pixel_size_um", stated.pixel_size_um, option="--pixel-size-um")
        return stated.pixel_size_um
    if facts.pixel_size_um is None:
        raise InputError("the images state no common pixel size; give --pixel-size-um, micrometres a pixel")
    return facts.pixel_size_um


def _tilts(stated: Stated, facts: Facts) -> tuple[float, ...]:
    """Tilt of every image, before any flip."""
    if stated.tilts_deg is None:
        for entry, one in zip(facts.entries, facts.stated, strict=True):
            if one.tilt_deg is None and stated.tilts_required:
                raise InputError(f"{entry.image} states no tilt angle; give --tilts, one angle in degrees an image")
        return tuple(0.0 if one.tilt_deg is None else one.tilt_deg for one in facts.stated)
    if len(stated.tilts_deg) != len(facts.entries):
        n, m = len(stated.tilts_deg), len(facts.entries)
        raise InputError(f"--tilts has {n} angles for {m} images; give one angle an image, in their order")
    return stated.tilts_deg


def _contradictions(stated: Stated, facts: Facts) -> list[str]:
    """Write a sentence for each flag that overrides something else that the files say."""
    said = []
    flag, theirs = stated.pixel_size_um, facts.pixel_size_um
    if flag is not None and theirs is not None and abs(flag / theirs - 1) > SAME_PIXEL_SIZE:
        said.append(f"--pixel-size-um {flag:g} overrides {theirs:g} of the {facts.source}")
    flag, theirs = stated.tilt_axis_deg, facts.tilt_axis_deg
    if flag is not None and theirs is not None and flag != theirs:
        said.append(f"--tilt-axis-deg {flag:g} overrides {theirs:g} of the {facts.source}")
    tilts = [one.tilt_deg for one in facts.stated]
    pairs = zip(stated.tilts_deg or (), tilts, strict=False)
    if any(tilt is not None and abs(mine - tilt) > SAME_TILT_DEG for mine, tilt in pairs):
        angles = ", ".join("none" if tilt is None else f"{tilt:g}" for tilt in tilts)
        said.append(f"--tilts overrides the angles of the {facts.source} ({angles})")
    return said


def _sources(stated: Stated, facts: Facts) -> tuple[str, ...]:
    """Who stated the geometry."""
    flags = (stated.tilts_deg, stated.pixel_size_um, stated.tilt_axis_deg)
    spoke = any(flag is not None for flag in flags) or stated.flip_tilt
    return tuple(name for name in (facts.source, "command line" if spoke else "") if name)
