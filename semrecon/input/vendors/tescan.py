"""TESCAN: key=value text behind a JPEG thumbnail in tag 50431, and the same in a `.hdr` file beside the image."""

from __future__ import annotations

import re

from semrecon.input.vendors.base import (
    Entry,
    ImageMetadata,
    Size,
    compose,
    not_square,
    number,
    same_grid,
    scaled,
    tilt_correction,
)
from semrecon.input.vendors.text import sections

JPEG_END = b"\xff\xd9"
LINE = re.compile(rb"([A-Za-z][A-Za-z0-9_]*)=([^\r\n\0]*)(?=[\r\n\0])")
"""A complete line; chunk headers, all binary, stand before the first of each section."""


def tescan_tag(block: bytes, size_px: Size, name: str) -> ImageMetadata:
    """Read tag 50431, whose text follows a thumbnail."""
    text = block[block.rfind(JPEG_END) + 1 :] if JPEG_END in block else block
    return tescan(_unique(LINE.findall(text)), size_px, name, "TESCAN metadata")


def tescan_header(block: bytes, size_px: Size, name: str, file: str) -> ImageMetadata:
    """Read a `.hdr` file; its sections [MAIN] and [SEM] share no key."""
    ini = sections(block)
    pairs = [(key.encode(), value.encode()) for part in ini.values() for key, value in part.items()]
    return tescan(_unique(pairs), size_px, name, f"TESCAN {file}")


def tescan(facts: dict[str, str], size_px: Size, name: str, source: str) -> ImageMetadata:
    """Read keys in metres and degrees.

    The number of columns that the pixel size was stated for follows from the magnification and the width of the
    print it refers to. The stage tilts about the horizontal of the unrotated scan, as the maker's stages are built.
    """
    width, height = number(facts.get("PixelSizeX")), number(facts.get("PixelSizeY"))
    pixel, other_grid = same_grid(name, Entry(scaled(width, 1e6), "PixelSizeX"), _grid(facts, size_px), size_px)
    unrotated = number(facts.get("ScanRotation")) == 0
    strip = number(facts.get("ImageStripSize"))
    corrected = number(facts.get("TiltCorrection")) not in {None, 0.0}
    return compose(
        name,
        source,
        pixel_size_um=pixel,
        tilt_deg=Entry(number(facts.get("StageTilt")), "StageTilt"),
        tilt_axis_deg=Entry(90.0 if unrotated else None, "ScanRotation = 0"),
        working_distance_um=Entry(scaled(number(facts.get("WD")), 1e6), "WD"),
        detector=(facts.get("Detector", ""), "Detector"),
        data_bar_px=Entry(strip if strip is not None and 0 <= strip < size_px[1] else None, "ImageStripSize"),
        warnings=(
            other_grid,
            not_square(name, width, height),
            tilt_correction(name, "TiltCorrection") if corrected else "",
        ),
    )


def _grid(facts: dict[str, str], size_px: Size) -> Size | None:
    """Columns that the pixel size belongs to, where the magnification tells; within 1 % they are those stored."""
    numbers = [number(facts.get(key)) for key in ("MagnificationReference", "Magnification", "PixelSizeX")]
    reference, magnification, pixel = (value if value and value > 0 else None for value in numbers)
    if reference is None or magnification is None or pixel is None:
        return None
    columns = reference / magnification / pixel
    if not 1 <= columns < 1e6:
        return None
    return (size_px[0] if abs(columns / size_px[0] - 1) < 0.01 else round(columns)), size_px[1]


def _unique(pairs: list[tuple[bytes, bytes]]) -> dict[str, str]:
    """Drop keys that come twice with two values: nobody can tell which one is right."""
    facts: dict[str, str] = {}
    torn = set()
    for raw_key, raw_value in pairs:
        key, value = raw_key.decode("utf-8", "replace"), raw_value.decode("utf-8", "replace").strip()
        if facts.setdefault(key, value) != value:
            torn.add(key)
    return {key: value for key, value in facts.items() if key not in torn}
