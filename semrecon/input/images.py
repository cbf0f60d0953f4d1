"""Reading micrographs: grey values as recorded, whatever the file wraps them in."""

from __future__ import annotations

import contextlib
import logging
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Image
from semrecon.errors import InputError

TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of a TIFF or BigTIFF of either byte order."""
MIN_IS_WHITE, PALETTE = 0, 3
"""Photometric interpretations of TIFF 6.0 that need care."""
ORIENTATION, UPRIGHT = 274, {0, 1}
"""Tag, in TIFF and in EXIF, of how a picture has to be turned before it is shown; and its values for not at all."""
MOST_PIXELS = 1 << 28
"""More pixels than any series can be reconstructed from; a damaged header may declare them."""
Pixels = NDArray[Any]


def read_image(path: Path | str) -> Image:
    """Read one grey image.

    Colour containers (RGB, palette) are read where all they hold is grey; an alpha channel is dropped.

    Returns
    -------
    (rows, columns), uint8, uint16 or float32, read-only; NaN where a float file holds no number.

    Raises
    ------
    InputError
        The file is missing, is no image, is damaged, in colour, turned, too large, or holds several images.
    """
    path = Path(path)
    mark = _first_bytes(path)
    pixels = _read_tiff(path) if mark in TIFF_MARKS else _read_with_pillow(path)
    if pixels.size == 0:
        raise InputError(f"{path} has no pixels; export it again")
    image = np.ascontiguousarray(_as_recorded(_grey(pixels, path), path))
    image.setflags(write=False)
    return image


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep what tifffile logs and Pillow warns about odd tags away from the user; damage is found by our own checks."""
    logger = logging.getLogger("tifffile")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(4)
    except IsADirectoryError:
        raise InputError(f"{path} is a folder where an image file was expected") from None
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; give the path of an image") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError:  # a NUL in the name
        raise InputError(f"{str(path)!r} cannot be the name of a file; give the path of an image") from None


def _read_tiff(path: Path) -> Pixels:
    """First image of a TIFF; compressions that tifffile cannot undo alone go to Pillow."""
    import tifffile

    with quiet():
        try:
            with tifffile.TiffFile(path) as tiff:
                page = _only_page(tiff, path)
                _check_complete(page, path)
                return _tiff_pixels(page, path)
        except InputError:
            raise
        except Exception as error:  # a damaged TIFF can trip the parser anywhere
            raise InputError(f"{path} is a damaged TIFF ({_brief(error)}); export it again") from None


def _only_page(tiff: Any, path: Path) -> Any:
    pages = [page for page in tiff.pages if not page.is_reduced]
    if not pages:
        raise InputError(f"{path} is a damaged TIFF (no image in it); export it again")
    if len(pages) > 1:
        raise InputError(f"{path} holds {len(pages)} images; save one image a file")
    orientation = pages[0].tags.get(ORIENTATION)
    _check_header(path, pages[0].imagewidth, pages[0].imagelength, orientation.value if orientation else 1)
    return pages[0]


def _check_header(path: Path, columns: int, rows: int, orientation: Any) -> None:
    if columns * rows > MOST_PIXELS:
        raise InputError(f"{path} declares {columns} x {rows} pixels, more than a series can have; export it again")
    if orientation not in UPRIGHT:
        raise InputError(
            f"{path} is to be turned before it is shown (orientation tag {orientation}), so that nobody can tell which "
            "way its tilt axis points; save it upright"
        )


def _check_complete(page: Any, path: Path) -> None:
    """Refuse a short file, or one without all its strips or tiles: it must not pass as a picture with a black part."""
    ends = [offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)]
    size = path.stat().st_size
    if not ends or max(ends) > size:
        raise InputError(f"{path} is cut short: it has {size} bytes of {max(ends, default=0)}; copy it again")
    parts = math.prod(page.chunked)
    if not page.is_contiguous and (len(ends) < parts or 0 in page.databytecounts[:parts]):
        raise InputError(f"{path} is a damaged TIFF (parts of the picture are missing); export it again")


def _tiff_pixels(page: Any, path: Path) -> Pixels:
    try:
        pixels = page.asarray()
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
        return _read_with_pillow(path)
    if page.photometric == PALETTE and page.colormap is not None:
        # 8 bit colours are stored times 257 by the book, times 256 by some writers; the high byte is right for both
        pixels = np.moveaxis(page.colormap >> 8, 0, -1).astype(np.uint8)[pixels]
    if page.photometric == MIN_IS_WHITE and pixels.dtype.kind in "iu":
        pixels = np.iinfo(pixels.dtype).max - pixels
    if page.photometric == MIN_IS_WHITE and pixels.dtype.kind == "f":
        raise InputError(f"{path} counts down from white in fractions, which have no end; save it with black as 0")
    if page.planarconfig == 2 and pixels.ndim == 3:
        pixels = np.moveaxis(pixels, 0, -1)
    return np.asarray(pixels)


def _read_with_pillow(path: Path) -> Pixels:
    import PIL.Image

    with quiet():
        try:
            with PIL.Image.open(path) as picture:
                frames = getattr(picture, "n_frames", 1)
                if frames > 1:
                    raise InputError(f"{path} holds {frames} images; save one image a file")
                _check_header(path, *picture.size, picture.getexif().get(ORIENTATION, 1))
                return np.asarray(picture.convert("RGB") if picture.mode == "P" else picture)
        except InputError:
            raise
        except PIL.Image.DecompressionBombError:
            raise InputError(f"{path} declares more pixels than a series can have; export it again") from None
        except PIL.UnidentifiedImageError:
            raise InputError(f"{path} is not an image; TIFF, PNG and JPEG are read") from None
        except Exception as error:  # Pillow's decoders raise whatever they trip over
            raise InputError(f"{path} is a damaged image ({_brief(error)}); export it again") from None


def _grey(pixels: Pixels, path: Path) -> Pixels:
    """One channel of an image whose colour channels agree, without the alpha channel."""
    if pixels.ndim == 2:
        return pixels
    if pixels.ndim != 3 or pixels.shape[2] not in {2, 3, 4}:
        raise InputError(f"{path} has pixels of shape {pixels.shape}; save it as one grey image")
    colours = pixels[..., : 1 if pixels.shape[2] == 2 else 3]
    if (colours != colours[..., :1]).any():
        raise InputError(f"{path} is in colour; save it in grey, as the detector recorded it")
    return pixels[..., 0]


def _as_recorded(pixels: Pixels, path: Path) -> Pixels:
    """Native byte order, one of the three types that flow through a reconstruction."""
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.int32 and pixels.size and pixels.min() >= 0 and pixels.max() <= np.iinfo(np.uint16).max:
        pixels = pixels.astype(np.uint16)  # how some Pillow modes hand out 16 bit grey
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"{path} has pixels of type {pixels.dtype}; save it with 8 or 16 bits of grey")
    if pixels.dtype == np.float32 and (np.isinf(pixels).any() or np.isnan(pixels).all()):
        raise InputError(
            f"{path} has pixels that are infinite, or no numbers at all; save it with 8 or 16 bits of grey"
        )
    return pixels


def _brief(error: Exception) -> str:
    """First line of what a library said, short enough for a sentence."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:120].rstrip(".")
