"""What the microscope wrote into an image file: pixel size, stage tilt, working distance. One reader a vendor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semrecon.images import TIFF_MARKS, quiet

UM_PER_UNIT = {"fm": 1e-9, "pm": 1e-6, "nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1e3, "m": 1e6}
"""Micrometres of a length unit; the micro sign has two code points, and files use both."""


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
    source
        Who says so, for messages; empty where the file says nothing.
    warnings
        Sentences about settings that spoil the geometry.
    """

    pixel_size_um: float | None = None
    tilt_deg: float | None = None
    tilt_axis_deg: float | None = None
    working_distance_um: float | None = None
    source: str = ""
    warnings: tuple[str, ...] = ()


def read_metadata(path: Path | str) -> ImageMetadata:
    """Read what a microscope wrote into a file; all None for other files. Damage is left to `read_image` to report."""
    import tifffile

    path = Path(path)
    with quiet():
        try:
            with path.open("rb") as file:
                if file.read(4) not in TIFF_MARKS:
                    return ImageMetadata()
            with tifffile.TiffFile(path) as tiff:
                page = tiff.pages[0]
                tags = tiff.sem_metadata
                return zeiss(tags, (page.imagewidth, page.imagelength), path.name) if tags else ImageMetadata()
        except (OSError, ValueError, IndexError, tifffile.TiffFileError):
            return ImageMetadata()


def zeiss(tags: Mapping[str, Any], size_px: tuple[int, int], name: str) -> ImageMetadata:
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
    return ImageMetadata(
        pixel_size_um=_length_um(tags.get("ap_image_pixel_size")),
        tilt_deg=_number(tags.get("ap_stage_at_t")),
        tilt_axis_deg=_zeiss_axis(tags, size_px),
        working_distance_um=_length_um(tags.get("ap_wd")),
        source="Zeiss metadata",
        warnings=_zeiss_warnings(tags, name),
    )


def _zeiss_axis(tags: Mapping[str, Any], size_px: tuple[int, int]) -> float | None:
    """Axis along the scan lines, unless the stored image is the scanned one turned by a quarter.

    Which way it was turned is not recorded, and the direction of the axis only changes the sign of the relief.
    """
    rotated = _text(tags.get("dp_scan_rot")) == "True" and (_number(tags.get("ap_scanrotation")) or 0.0) % 360 != 0
    if rotated or _text(tags.get("dp_stage_tilted")) != "in X":
        return None
    try:
        scanned = tuple(int(part) for part in _text(tags.get("dp_image_store")).split("*"))
    except ValueError:
        return None
    turned = scanned == size_px[::-1] and scanned != size_px
    return 0.0 if turned else 90.0


def _zeiss_warnings(tags: Mapping[str, Any], name: str) -> tuple[str, ...]:
    if _text(tags.get("dp_tilt_correction")) != "True":
        return ()
    return (f"{name} was taken with tilt correction on, which stretches the image; reconstructions expect it off",)


def _text(tag: Any) -> str:
    return str(tag[1]).strip() if tag is not None and len(tag) > 1 else ""


def _number(tag: Any) -> float | None:
    try:
        return float(tag[1]) if tag is not None else None
    except (TypeError, ValueError, IndexError):
        return None


def _length_um(tag: Any) -> float | None:
    """Read a positive length with its unit; a zero is how microscopes say that they do not know."""
    value = _number(tag)
    unit = UM_PER_UNIT.get(str(tag[2]).strip()) if tag is not None and len(tag) > 2 else None
    return value * unit if value is not None and unit is not None and value > 0 else None
