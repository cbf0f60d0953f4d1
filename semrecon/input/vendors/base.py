"""What one image file states of itself, and the checks that every vendor's reader goes through."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

Size = tuple[int, int]
"""Columns and rows."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
UM_PER_UNIT = {"fm": 1e-9, "pm": 1e-6, "nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1e3, "m": 1e6}
"""Micrometres of a length unit; the micro sign has two code points, and files use both."""
LIMITS = {
    "pixel_size_um": (1e-6, 1e3, "pixel size", "um"),
    "tilt_deg": (-90.0, 90.0, "tilt", "degrees"),
    "working_distance_um": (1.0, 1e6, "working distance", "um"),
}
"""Least and greatest value that a microscope can mean, and how to call it in a sentence."""
SQUARE = 1e-3
"""Relative difference of a pixel's two edges up to which it is square."""


@dataclass(frozen=True)
class ImageMetadata:
    """What one file states; None where it is silent.

    Parameters
    ----------
    pixel_size_um
        Of the pixels as stored.
    tilt_deg
        Of the stage.
    tilt_axis_deg
        Direction of the stage's tilt axis in the stored image: 0 is up, 90 is right.
    working_distance_um
        From the lens to the focus.
    detector
        Its name at the vendor; empty where the file says nothing.
    data_bar_px
        Rows of the data bar at the bottom, as stated; the picture may show another number.
    source
        Who says so, for messages; empty where the file says nothing.
    warnings
        Sentences about settings that spoil the geometry, and about values that were not believed.
    tags
        Pairs of a field of this class and the vendor's name of the entry that it was read from.
    """

    pixel_size_um: float | None = None
    tilt_deg: float | None = None
    tilt_axis_deg: float | None = None
    working_distance_um: float | None = None
    detector: str = ""
    data_bar_px: int | None = None
    source: str = ""
    warnings: tuple[str, ...] = ()
    tags: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Entry:
    """A value and the vendor's name of the entry that it was read from."""

    value: float | None
    tag: str


NOTHING = Entry(None, "")


def compose(
    name: str,
    source: str,
    *,
    pixel_size_um: Entry = NOTHING,
    tilt_deg: Entry = NOTHING,
    working_distance_um: Entry = NOTHING,
    tilt_axis_deg: Entry = NOTHING,
    detector: tuple[str, str] = ("", ""),
    data_bar_px: Entry = NOTHING,
    warnings: Iterable[str] = (),
) -> ImageMetadata:
    """Keep what can be true; a value outside `LIMITS` becomes None and a sentence."""
    said = [sentence for sentence in warnings if sentence]
    numbers = {"pixel_size_um": pixel_size_um, "tilt_deg": tilt_deg, "working_distance_um": working_distance_um}
    kept = {field: _believed(name, field, entry, said) for field, entry in numbers.items()}
    entries = {**numbers, "tilt_axis_deg": tilt_axis_deg, "data_bar_px": data_bar_px}
    believed = {**kept, "tilt_axis_deg": tilt_axis_deg.value, "data_bar_px": data_bar_px.value}
    tags = [(field, entry.tag) for field, entry in entries.items() if believed[field] is not None]
    bar = data_bar_px.value
    return ImageMetadata(
        **kept,
        tilt_axis_deg=tilt_axis_deg.value,
        detector=detector[0],
        data_bar_px=None if bar is None else int(bar),
        source=source,
        warnings=tuple(said),
        tags=(*tags, *([("detector", detector[1])] if detector[0] else [])),
    )


def _believed(name: str, field: str, entry: Entry, said: list[str]) -> float | None:
    """Drop zeros of lengths, which are how microscopes say that they do not know, and absurd values aloud."""
    least, most, noun, unit = LIMITS[field]
    value = entry.value
    if value is None or (value == 0 and least > 0):
        return None
    if math.isfinite(value) and least <= value <= most:
        return value
    said.append(f"{name} states a {noun} of {value:.4g} {unit} ({entry.tag}), which cannot be; it is not used")
    return None


def same_grid(name: str, pixel_size: Entry, stated: Size | None, stored: Size) -> tuple[Entry, str]:
    """Withhold a pixel size that was stated for another number of columns than are stored.

    Rows may differ (a data bar, or its being cropped), and a picture may have been turned by a quarter; other widths
    mean that it was cut at the sides or resized, which need different answers.

    Returns
    -------
    The entry, or one of None; and a sentence, empty where all is well.
    """
    if pixel_size.value is None or stated is None or stated[0] in stored:
        return pixel_size, ""
    value, (columns, _), (now, _) = pixel_size.value, stated, stored
    return Entry(None, pixel_size.tag), (
        f"{name} states a pixel size of {value:.5g} um ({pixel_size.tag}) for {columns} columns and has {now}; "
        f"if it was cut, give --pixel-size-um {value:.5g}, if it was resized, --pixel-size-um "
        f"{value * columns / now if now else math.nan:.5g}"
    )


def tilt_correction(name: str, tag: str) -> str:
    """Say what tilt correction does to the geometry."""
    return f"{name} was taken with tilt correction on ({tag}), which stretches the image; reconstructions expect it off"


def not_square(name: str, x: float | None, y: float | None) -> str:
    """Say that a pixel is not square, or nothing."""
    if not x or not y or abs(y / x - 1) <= SQUARE:
        return ""
    return f"{name} has pixels that are {y / x:.4g} times as high as wide; reconstructions expect square ones"


def number(text: str | None) -> float | None:
    """Read a whole text as a finite decimal number; anything else is None, for a guess would be a wrong value."""
    stripped = (text or "").strip()
    if not NUMBER.fullmatch(stripped):
        return None
    value = float(stripped)
    return value if math.isfinite(value) else None


def length_um(text: str | None, unit: str) -> float | None:
    """Read a length; `unit` holds where the text names none."""
    match = re.fullmatch(r"\s*([^\s°µμa-df-zA-DF-Z]+)\s*([µμa-zA-Z]*)\s*", text or "")
    factor = UM_PER_UNIT.get(match[2] or unit) if match else None
    value = number(match[1]) if match else None
    return value * factor if value is not None and factor is not None else None


def scaled(value: float | None, factor: float) -> float | None:
    """Multiply what is known."""
    return None if value is None else value * factor


def pair(text: str | None) -> Size | None:
    """Read two positive whole numbers, as ``1280x960`` or ``1280 960``."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[x*, ]\s*(\d{1,6})\s*", text or "")
    size = (int(match[1]), int(match[2])) if match else None
    return size if size and min(size) > 0 else None
