"""FEI and Thermo Fisher: the INI text of tag 34682, in metres and radians."""

from __future__ import annotations

import math

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
from semrecon.input.vendors.text import Sections, sections


def fei(block: bytes, size_px: Size, name: str) -> ImageMetadata:
    """Read the block of a FEI or Thermo Fisher microscope.

    The stage tilts about the horizontal of the unrotated scan; the file does not say so, the stages are so built.

    Parameters
    ----------
    block
        As stored.
    size_px
        Columns and rows of the stored image.
    name
        File name, for warnings.
    """
    ini = sections(block)
    beam = ini.get("Beam", {}).get("Beam", "EBeam")
    scan = ini.get("Beam", {}).get("Scan", "EScan")
    grid = _whole(ini, "Image", "ResolutionX"), _whole(ini, "Image", "ResolutionY")
    stated = (grid[0], grid[1]) if grid[0] and grid[1] else None
    width, tag = _first(ini, ("Scan", "PixelWidth"), (scan, "PixelWidth"))
    height, _ = _first(ini, ("Scan", "PixelHeight"), (scan, "PixelHeight"))
    pixel, other_grid = same_grid(name, Entry(scaled(width, 1e6), tag), stated, size_px)
    tilt, tilt_tag = _first(ini, ("Stage", "StageT"), (beam, "StageTa"))
    distance, distance_tag = _first(ini, ("Stage", "WorkingDistance"), (beam, "WD"))
    return compose(
        name,
        "FEI metadata",
        pixel_size_um=pixel,
        tilt_deg=Entry(scaled(tilt, 180 / math.pi), tilt_tag),
        tilt_axis_deg=_axis(ini, beam),
        working_distance_um=Entry(scaled(distance, 1e6), distance_tag),
        detector=(ini.get("Detectors", {}).get("Name", ""), "Detectors/Name"),
        data_bar_px=Entry(_whole(ini, "PrivateFei", "DatabarHeight"), "PrivateFei/DatabarHeight"),
        warnings=(other_grid, not_square(name, width, height), *_settings(ini, beam, name)),
    )


def _axis(ini: Sections, beam: str) -> Entry:
    rotation, tag = _first(ini, (beam, "ScanRotation"), ("Beam", "ScanRotation"))
    return Entry(90.0 if rotation == 0 else None, f"{tag} = 0")


def _settings(ini: Sections, beam: str, name: str) -> list[str]:
    said = []
    if ini.get(beam, {}).get("TiltCorrectionIsOn", "no").lower() in {"yes", "true", "on", "1"}:
        said.append(tilt_correction(name, f"{beam}/TiltCorrectionIsOn"))
    if beam.startswith("I"):
        said.append(f"{name} was taken with the ion beam, whose column leans; its stage tilt is not the angle of view")
    return said


def _first(ini: Sections, *places: tuple[str, str]) -> tuple[float | None, str]:
    """Take the first place that holds a number."""
    for section, key in places:
        value = number(ini.get(section, {}).get(key))
        if value is not None:
            return value, f"{section}/{key}"
    return None, "/".join(places[-1])


def _whole(ini: Sections, section: str, key: str) -> int | None:
    value = number(ini.get(section, {}).get(key))
    return int(value) if value is not None and value == int(value) and 0 <= value < 1e6 else None
