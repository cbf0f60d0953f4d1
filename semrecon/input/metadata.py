"""What the microscope wrote into an image file, or beside it: pixel size, stage tilt, working distance, detector."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from semrecon.input.images import TIFF_MARKS, quiet
from semrecon.input.vendors.base import ImageMetadata, Size
from semrecon.input.vendors.fei import fei
from semrecon.input.vendors.hitachi import hitachi, is_hitachi
from semrecon.input.vendors.jeol import is_jeol, jeol
from semrecon.input.vendors.tescan import tescan_header, tescan_tag
from semrecon.input.vendors.text import sidecar
from semrecon.input.vendors.zeiss import zeiss

__all__ = ["ImageMetadata", "read_metadata", "zeiss"]

ZEISS_TAG, FEI_TAG, TESCAN_TAG = 34118, 34682, 50431
AGREE = 1e-3
"""Relative difference up to which a file and its sidecar say the same."""


def read_metadata(path: Path | str) -> ImageMetadata:
    """Read what a microscope wrote into a file or beside it; all None for other files.

    A block in the file wins over a sidecar. Damage to the picture is left to `read_image` to report.
    """
    path = Path(path)
    inside = _from_tags(path)
    if inside.source and not inside.source.startswith("TESCAN"):
        return inside
    beside = _from_sidecar(path)
    if not inside.source:
        return replace(beside, warnings=(*inside.warnings, *beside.warnings))
    return replace(inside, warnings=(*inside.warnings, *_disagreements(inside, beside, path.name)))


def _from_tags(path: Path) -> ImageMetadata:
    """Read the vendor's tag of a TIFF."""
    import tifffile

    with quiet():
        try:
            with path.open("rb") as file:
                if file.read(4) not in TIFF_MARKS:
                    return ImageMetadata()
            with tifffile.TiffFile(path) as tiff:
                return _from_page(tiff, path.name)
        except OSError:
            return ImageMetadata()
        except Exception:  # a damaged block can trip the parser anywhere
            return ImageMetadata(warnings=(f"{path.name} holds metadata that cannot be read; none of it is used",))


def _from_page(tiff: Any, name: str) -> ImageMetadata:
    page = tiff.pages[0]
    size_px = (page.imagewidth, page.imagelength)
    if ZEISS_TAG in page.tags:
        return zeiss(_whole_entries(tiff), size_px, name)
    if FEI_TAG in page.tags:
        return fei(_raw(tiff, page.tags[FEI_TAG]), size_px, name)
    if TESCAN_TAG in page.tags:
        return tescan_tag(_raw(tiff, page.tags[TESCAN_TAG]), size_px, name)
    return ImageMetadata()


def _whole_entries(tiff: Any) -> dict[str, Any]:
    """Zeiss' entries as tifffile parses them, less the last one where its line has no end: it may be half a number."""
    entries = dict(tiff.sem_metadata or {})
    if entries and not _raw(tiff, tiff.pages[0].tags[ZEISS_TAG]).endswith((b"\n", b"\0")):
        entries.popitem()
    return entries


def _raw(tiff: Any, tag: Any) -> bytes:
    """Bytes of a tag as stored: tifffile's own parsers guess types, and stop at what they do not know."""
    tiff.filehandle.seek(tag.valueoffset)
    return bytes(tiff.filehandle.read(tag.valuebytecount))


def _from_sidecar(path: Path) -> ImageMetadata:
    """Read TESCAN's `.hdr`, or JEOL's or Hitachi's `.txt`."""
    header, file = sidecar(path, ".hdr")
    text, text_file = sidecar(path, ".txt")
    jeols, hitachis = is_jeol(text), is_hitachi(text)
    if not (b"PixelSizeX" in header or jeols or hitachis):
        return ImageMetadata()
    size_px = _size(path)
    if size_px is None:
        return ImageMetadata()
    if b"PixelSizeX" in header:
        return tescan_header(header, size_px, path.name, file)
    return (jeol if jeols else hitachi)(text, size_px, path.name, text_file)


def _size(path: Path) -> Size | None:
    """Columns and rows, without decoding the picture."""
    import PIL.Image
    import tifffile

    with quiet():
        try:
            with tifffile.TiffFile(path) as tiff:
                return tiff.pages[0].imagewidth, tiff.pages[0].imagelength
        except Exception:  # no TIFF, or a damaged one
            try:
                with PIL.Image.open(path) as picture:
                    return picture.size
            except Exception:  # `read_image` says what is wrong with it
                return None


def _disagreements(inside: ImageMetadata, beside: ImageMetadata, name: str) -> list[str]:
    """Write a sentence for each number that a sidecar states differently."""
    said = []
    for field, noun in (("pixel_size_um", "pixel size"), ("tilt_deg", "tilt")):
        mine, theirs = getattr(inside, field), getattr(beside, field)
        if mine is not None and theirs is not None and abs(mine - theirs) > AGREE * max(abs(mine), abs(theirs)):
            said.append(
                f"{name} states a {noun} of {mine:.5g} and {beside.source} one of {theirs:.5g}; the former is used"
            )
    return said
