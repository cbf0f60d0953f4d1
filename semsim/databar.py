"""The data bar: a band below the picture with the instrument's settings and a scale bar of exactly known length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semsim.detector import Image
from semsim.errors import InputError
from semsim.mesh import Array
from semsim.microscope import PRINT_WIDTH_UM, Microscope

if TYPE_CHECKING:
    from PIL import ImageDraw, ImageFont

LONGEST_SHARE = 0.25
"""The scale bar takes at most this part of the width."""
TEXT_SHARE = 0.34
"""Height of the letters as a part of the band's."""


@dataclass(frozen=True)
class DataBarOptions:
    """What the data bar shows.

    Parameters
    ----------
    height_px
        Rows below the picture; 0 is no data bar, otherwise at least 24.
    voltage_kv
        Accelerating voltage to print.
    detector
        Name of the detector to print; empty is none.
    print_width_um
        Width of the print that the magnification refers to.

    Raises
    ------
    InputError
        A value outside its range.
    """

    height_px: int = 0
    voltage_kv: float = 5.0
    detector: str = "SE"
    print_width_um: float = PRINT_WIDTH_UM

    def __post_init__(self) -> None:
        if self.height_px != 0 and not 24 <= self.height_px <= 1000:
            raise InputError(f"data bar option height_px must be 0 or lie between 24 and 1000, not {self.height_px}")
        if not (0 < self.voltage_kv < 1e4 and 0 < self.print_width_um < 1e9):
            raise InputError("data bar options voltage_kv (below 10000) and print_width_um must be positive")


@dataclass(frozen=True)
class ScaleBar:
    """A line of round length.

    Parameters
    ----------
    length_um, length_px
        On the specimen and in the image: ``length_um = length_px * pixel_size_um``.
    column
        Pixel whose left border is the bar's left end.
    rows
        First row of the picture with its data bar that the bar covers, and the one after the last.
    """

    length_um: float
    length_px: float
    column: int
    rows: tuple[int, int]


def with_data_bar(image: Image, options: DataBarOptions, microscope: Microscope, label: str = "") -> Image:
    """Add the data bar below a picture, which stays as it is: (rows + height_px, columns) of the same type.

    The band is black and its ink white. The last pixel of the scale bar is grey in proportion to the part that
    the bar covers, so that the sum along it, over white, is its length to half a grey level.

    Parameters
    ----------
    label
        Name of the specimen or view, printed where there is room.
    """
    if options.height_px == 0:
        return image
    from PIL import Image as Pillow
    from PIL import ImageDraw

    bar = scale_bar(options, microscope)
    canvas = Pillow.new("L", (microscope.width_px, options.height_px), 0)
    _write(ImageDraw.Draw(canvas), _settings(options, microscope, label), bar, microscope)
    ink = np.asarray(canvas) / 255.0
    ink[bar.rows[0] - microscope.height_px : bar.rows[1] - microscope.height_px] += _covered(bar, microscope.width_px)
    white = np.iinfo(image.dtype).max
    return np.concatenate([image, np.rint(np.clip(ink, 0, 1) * white).astype(image.dtype)])


def scale_bar(options: DataBarOptions, microscope: Microscope) -> ScaleBar:
    """Choose a scale bar, 1, 2 or 5 times a power of ten um long, and its place at the right of the data bar."""
    length_um = round_length(LONGEST_SHARE * microscope.width_px * microscope.pixel_size_um)
    length_px = length_um / microscope.pixel_size_um
    margin = options.height_px // 4
    top = microscope.height_px + round(0.68 * options.height_px)
    thickness = max(2, options.height_px // 12)
    column = microscope.width_px - margin - int(np.ceil(length_px))
    return ScaleBar(length_um, length_px, max(column, 0), (top, top + thickness))


def round_length(longest_um: float) -> float:
    """Find the longest length that is 1, 2 or 5 times a power of ten and not above `longest_um`."""
    power = int(np.floor(np.log10(longest_um)))
    candidates = [float(f"{digit}e{power + shift}") for shift in (0, 1) for digit in (1, 2, 5)]
    return max((length for length in candidates if length <= longest_um), default=float(f"5e{power - 1}"))


def _covered(bar: ScaleBar, width_px: int) -> Array:
    """Part of each pixel of a row that the bar covers, (columns,)."""
    from_left = np.arange(width_px) - bar.column
    return np.asarray(np.where(from_left < 0, 0.0, np.clip(bar.length_px - from_left, 0.0, 1.0)))


def _settings(options: DataBarOptions, microscope: Microscope, label: str) -> list[str]:
    magnification = options.print_width_um / (microscope.pixel_size_um * microscope.width_px)
    distance = microscope.working_distance_um
    return [
        f"Mag {_with_thousands(magnification)}",
        f"HV {options.voltage_kv:.2f} kV",
        *([f"WD {distance / 1e3:.1f} mm"] if distance is not None else []),
        *([f"Det {options.detector}"] if options.detector else []),
        *([label] if label else []),
    ]


def _with_thousands(magnification: float) -> str:
    return f"{magnification / 1e3:.2f} KX" if magnification >= 1e3 else f"{magnification:.0f} X"


def _length_text(length_um: float) -> str:
    # "um", since the font that Pillow brings along has no Greek letters.
    units = {"mm": 1e3, "um": 1.0, "nm": 1e-3}
    unit = next((unit for unit, size_um in units.items() if length_um >= size_um), "nm")
    return f"{length_um / units[unit]:g} {unit}"


def _write(draw: ImageDraw.ImageDraw, settings: list[str], bar: ScaleBar, microscope: Microscope) -> None:
    """Print the settings from the left as far as there is room, and the length above the scale bar."""
    height = draw.im.size[1]
    font = _font(TEXT_SHARE * height)
    text = _length_text(bar.length_um)
    middle = bar.column + bar.length_px / 2
    above = bar.rows[0] - microscope.height_px - max(2, height // 14)
    right = microscope.width_px - draw.textlength(text, font=font) / 2 - 2
    draw.text((min(middle, right), above), text, fill=255, font=font, anchor="ms")
    gap, x = height / 3, height / 4
    room = min(bar.column, middle - draw.textlength(text, font=font) / 2) - gap
    for setting in settings:
        width = draw.textlength(setting, font=font)
        if x + width > room:
            break
        draw.text((x, height / 2), setting, fill=255, font=font, anchor="lm")
        x += width + gap


def _font(size_px: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(max(8.0, size_px))
