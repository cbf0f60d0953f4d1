"""JEOL: a `.txt` file beside the image, a key and its values a line."""

from __future__ import annotations

from semrecon.input.vendors.base import Entry, ImageMetadata, Size, compose, length_um, number, pair, same_grid
from semrecon.input.vendors.text import complete_lines

MARKS = ("$CM_", "$$SM_", "$SM_")
TILT = 4
"""Place of the tilt in the stage's x, y, z, rotation, tilt where the axes are not named."""


def is_jeol(block: bytes) -> bool:
    """Tell whether a sidecar is JEOL's."""
    return any(line.startswith(MARKS) for line in complete_lines(block))


def jeol(block: bytes, size_px: Size, name: str, file: str) -> ImageMetadata:
    """Read the sidecar of a JEOL microscope.

    Older instruments state the length of the micron marker on the specimen and in whole pixels, from which the pixel
    size follows to half a pixel of the bar; newer ones the field of view.
    """
    facts = _facts(block)
    grid_key = "CM_IMAGE_SIZE" if "CM_IMAGE_SIZE" in facts else "CM_FULL_SIZE"
    grid = pair(facts.get(grid_key))
    pixel, rounding = _pixel_size(facts, grid, name)
    pixel, other_grid = same_grid(name, pixel, grid, size_px)
    stage_key = "CM_STAGE_POSITION" if "CM_STAGE_POSITION" in facts else "CM_STAGE_POS"
    bar = size_px[1] - grid[1] if grid and grid[0] == size_px[0] and size_px[1] > grid[1] else None
    return compose(
        name,
        f"JEOL {file}",
        pixel_size_um=pixel,
        tilt_deg=Entry(_tilt(facts.get(stage_key, "")), f"${stage_key}"),
        working_distance_um=Entry(length_um(facts.get("SM_WD"), "mm"), "SM_WD"),
        detector=(facts.get("CM_SIGNAL", ""), "$CM_SIGNAL"),
        data_bar_px=Entry(bar, f"${grid_key}"),
        warnings=(other_grid, rounding if pixel.value is not None else ""),
    )


def _tilt(stage: str) -> float | None:
    """Tilt of a stage position: by name (``X=37.2, Y=44.9, Z=16.9, T=3.0``) or by place (``0 0 0 0 3.5 0``)."""
    if "=" in stage:
        named = dict(part.strip().split("=", 1) for part in stage.split(",") if "=" in part)
        return number(named.get("T"))
    axes = stage.split()
    return number(axes[TILT]) if len(axes) > TILT else None


def _pixel_size(facts: dict[str, str], grid: Size | None, name: str) -> tuple[Entry, str]:
    field = facts.get("CM_FIELD_OF_VIEW", "").split()
    width_um = length_um(field[0], "um") if len(field) == 2 else None
    if width_um is not None and grid is not None:
        return Entry(width_um / grid[0], "$CM_FIELD_OF_VIEW"), ""
    bar_px, bar_um = number(facts.get("SM_MICRON_BAR")), length_um(facts.get("SM_MICRON_MARKER"), "none")
    if bar_px is None or bar_px < 1 or bar_um is None:
        return Entry(None, "$$SM_MICRON_BAR"), ""
    return Entry(bar_um / bar_px, "$$SM_MICRON_MARKER / $$SM_MICRON_BAR"), (
        f"{name} gives its pixel size by a marker of {bar_px:g} whole pixels, so to {0.5 / bar_px:.1%} only; "
        "give --pixel-size-um if it is known better"
    )


def _facts(block: bytes) -> dict[str, str]:
    """Key, without its dollar signs, to the rest of the line; a key with two values is dropped."""
    facts: dict[str, str] = {}
    torn = set()
    for line in complete_lines(block):
        if line.startswith(MARKS):
            key, _, value = line.replace("\t", " ").partition(" ")
            if facts.setdefault(key.lstrip("$"), value.strip()) != value.strip():
                torn.add(key.lstrip("$"))
    return {key: value for key, value in facts.items() if key not in torn}
