"""Zeiss: the SmartSEM block of tag 34118, as tifffile parses it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from semrecon.input.vendors.base import (
    UM_PER_UNIT,
    Entry,
    ImageMetadata,
    Size,
    compose,
    number,
    pair,
    same_grid,
    tilt_correction,
)

DETECTORS = ("dp_detector_type", "dp_detector_channel")


def zeiss(tags: Mapping[str, Any], size_px: Size, name: str) -> ImageMetadata:
    """Read the SmartSEM block of a Zeiss microscope.

    "Image Pixel Size" belongs to the stored pixels ("Pixel Size" to 1024 columns); the stage is "Stage at T" ("Tilt
    Angle" is the setting of the tilt correction).

    Parameters
    ----------
    tags
        Name to (label, value[, unit]), as tifffile parses them.
    size_px
        Columns and rows of the stored image.
    name
        File name, for warnings.
    """
    scanned = pair(_text(tags.get("dp_image_store")).replace("*", "x").replace(" ", ""))
    pixel = Entry(_length_um(tags.get("ap_image_pixel_size")), "AP_IMAGE_PIXEL_SIZE")
    pixel, other_grid = same_grid(name, pixel, scanned, size_px)
    detector = next((tag for tag in DETECTORS if _text(tags.get(tag))), DETECTORS[0])
    corrected = _text(tags.get("dp_tilt_correction")) == "True"
    return compose(
        name,
        "Zeiss metadata",
        pixel_size_um=pixel,
        tilt_deg=Entry(_number(tags.get("ap_stage_at_t")), "AP_STAGE_AT_T"),
        tilt_axis_deg=Entry(_axis(tags, scanned, size_px), "DP_STAGE_TILTED"),
        working_distance_um=Entry(_length_um(tags.get("ap_wd")), "AP_WD"),
        detector=(_text(tags.get(detector)), detector.upper()),
        warnings=(other_grid, tilt_correction(name, "DP_TILT_CORRECTION") if corrected else ""),
    )


def _axis(tags: Mapping[str, Any], scanned: Size | None, size_px: Size) -> float | None:
    """Axis along the scan lines, unless the stored image is the scanned one turned by a quarter.

    Which way it was turned is not recorded, and the direction of the axis only changes the sign of the relief.
    """
    rotated = _text(tags.get("dp_scan_rot")) == "True" and (_number(tags.get("ap_scanrotation")) or 0.0) % 360 != 0
    if rotated or scanned is None or _text(tags.get("dp_stage_tilted")) != "in X":
        return None
    turned = scanned == size_px[::-1] and scanned != size_px
    return 0.0 if turned else 90.0


def _text(tag: Any) -> str:
    return str(tag[1]).strip() if isinstance(tag, tuple) and len(tag) > 1 else ""


def _number(tag: Any) -> float | None:
    return number(_text(tag))


def _length_um(tag: Any) -> float | None:
    value = _number(tag)
    unit = UM_PER_UNIT.get(str(tag[2]).strip()) if isinstance(tag, tuple) and len(tag) > 2 else None
    return value * unit if value is not None and unit is not None else None
