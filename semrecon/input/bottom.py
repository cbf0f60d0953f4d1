"""Rows at the bottom of a series' images that are no picture: the data bar, and lines that the scan left dead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semrecon.data import Image
from semrecon.input.databar import common_data_bar

MOST_DEAD_PX = 3
FLAT = 0.2
"""A dead line varies less than this part of what lines of the picture do."""
JUMP = 3.0
"""A line that differs from the one above by this many times the usual is no neighbour of it."""


@dataclass(frozen=True)
class Bottom:
    """What to do with the bottom of all images.

    Parameters
    ----------
    crop_px
        Rows to crop.
    said
        Sentences that say what is cropped or could be.
    """

    crop_px: int = 0
    said: tuple[str, ...] = ()


def bottom_of(images: Sequence[Image], stated_px: int | None = None, *, keep: bool = False) -> Bottom:
    """Decide how many rows to crop off all images.

    Parameters
    ----------
    images
        (rows, columns) each.
    stated_px
        Rows of the data bar as the metadata has them; the picture decides.
    keep
        Only say what could be cropped: whoever wrote a `series.toml` chose its images, and their channels and truth go
        with them row by row.
    """
    rows, said = common_data_bar(images)
    if rows is not None:
        return _data_bar(rows, stated_px, keep)
    sentences = [said] if said else []
    if stated_px and not said:
        sentences.append(
            f"the metadata states a data bar of {stated_px} rows that the images do not show; "
            f"--crop-bottom {stated_px} crops one"
        )
    dead = max((dead_rows(image) for image in images), default=0)
    if dead:
        ending = f"give --crop-bottom {dead}" if keep else "and cropped; --crop-bottom 0 keeps them"
        sentences.append(f"the last {dead} rows of the images are dead lines, {ending}")
    return Bottom(0 if keep else dead, tuple(sentences))


def _data_bar(rows: int, stated_px: int | None, keep: bool) -> Bottom:
    if keep:
        return Bottom(
            0,
            (f"the images end in a data bar of {rows} rows, which matches itself; give --crop-bottom {rows}",),
        )
    against = f", though the metadata states {stated_px}" if stated_px is not None and stated_px != rows else ""
    return Bottom(rows, (f"a data bar of {rows} rows was found{against}, and cropped; --crop-bottom 0 keeps it",))


def dead_rows(image: Image) -> int:
    """Count rows at the bottom that hold no picture: a flat last row, and those that blend into it."""
    if len(image) < 8 * MOST_DEAD_PX:
        return 0
    end = image[-8 * MOST_DEAD_PX :].astype(np.float64)
    spread, jumps = end.std(axis=1), np.abs(np.diff(end, axis=0)).mean(axis=1)
    usual = float(np.median(jumps))
    if not (spread[-1] + usual > 0 and spread[-1] < FLAT * np.median(spread) and jumps[-1] > JUMP * usual):
        return 0
    far = np.flatnonzero(jumps[-MOST_DEAD_PX:] > JUMP * usual)
    return int(MOST_DEAD_PX - far[0])
