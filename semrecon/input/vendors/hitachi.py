"""Hitachi: a `.txt` file beside the image with a [SemImageFile] section."""

from __future__ import annotations

from semrecon.input.vendors.base import Entry, ImageMetadata, Size, compose, length_um, number, pair, same_grid
from semrecon.input.vendors.text import sections

SECTION = "SemImageFile"


def is_hitachi(block: bytes) -> bool:
    """Tell whether a sidecar is Hitachi's."""
    return SECTION in sections(block)


def hitachi(block: bytes, size_px: Size, name: str, file: str) -> ImageMetadata:
    """Read the sidecar of a Hitachi microscope: pixels in nm, the working distance in um unless a unit is named."""
    facts = sections(block).get(SECTION, {})
    pixel = Entry(length_um(facts.get("PixelSize"), "nm"), "PixelSize")
    pixel, other_grid = same_grid(name, pixel, pair(facts.get("DataSize")), size_px)
    tilt = facts.get("StagePositionT", "").removesuffix("deg").removesuffix("°")
    return compose(
        name,
        f"Hitachi {file}",
        pixel_size_um=pixel,
        tilt_deg=Entry(number(tilt), "StagePositionT"),
        working_distance_um=Entry(length_um(facts.get("WorkingDistance"), "um"), "WorkingDistance"),
        detector=(facts.get("SignalName", ""), "SignalName"),
        warnings=(other_grid,),
    )
