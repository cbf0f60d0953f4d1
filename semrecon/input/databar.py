"""The data bar at the bottom of a micrograph: a plain band with letters, which matches itself in every view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Image

Mask = NDArray[np.bool_]

SAME = 0.06
"""Grey values this close, as a part of the image's range, are one; JPEG frays a plain band by about this."""
PLAIN, RULED, WRITTEN, PICTURE = 0.95, 0.97, 0.4, 0.3
"""Part of a row in the colour of the paper: plain rows have more, a ruled line as much of another colour, rows with
letters still this much, and rows of the picture less."""
CONTRAST = 0.3
"""Least difference of ink and paper, as a part of the image's range."""
ONE_COLOUR = 0.1
"""Least part of the ink in its full colour; the edges of small letters are grey."""
LEAST_PX, LARGEST_SHARE = 12, 0.3
STRAY_PX = 2
"""Rows of the picture that some instruments leave below the bar."""
EDGE_PX = 3
INK = (0.003, 0.45)
"""Ink on a data bar, as a part of its pixels: less is no writing, more is a picture."""


def find_data_bar(image: Image) -> int | None:
    """Count the rows to crop off the bottom, so that no data bar is left.

    A bar is certain where a band at the bottom has plain paper, begins with a jump (a ruled line, or plain rows below
    rows of the picture), and carries ink of one colour in strong contrast. Dark and saturated pictures fail one of
    these.

    Parameters
    ----------
    image
        (rows, columns).

    Returns
    -------
    Rows, or None where no bar is certain.
    """
    levels = _levels(image)
    if levels is None or levels.shape[0] < 4 * LEAST_PX:
        return None
    paper = _paper(levels)
    paper_share = (np.abs(levels - paper) <= SAME).mean(axis=1)
    ruled = _ruled(levels, paper)
    top = _top(paper_share, ruled)
    height = levels.shape[0] - top
    if not LEAST_PX <= height <= LARGEST_SHARE * image.shape[0]:
        return None
    certain = _begins_with_a_jump(paper_share, ruled, top) and _is_written(levels, paper, ruled, top)
    return height if certain else None


def common_data_bar(images: Sequence[Image]) -> tuple[int | None, str]:
    """Find the data bar of a series.

    Returns
    -------
    Rows to crop off all images, None where not all have the same bar; and a sentence where only some have one or they
    differ.
    """
    rows = [find_data_bar(image) for image in images]
    found = [height for height in rows if height is not None]
    if len(found) == len(rows) and found and max(found) - min(found) <= STRAY_PX:
        return max(found), ""
    if not found:
        return None, ""
    told = ", ".join("none" if height is None else str(height) for height in rows)
    return None, f"the images do not agree on a data bar (rows: {told}), so none is cropped; give --crop-bottom"


def _levels(image: Image) -> Array | None:
    """Grey values from 0 to 1 over the part that a bar may fill and some rows above; None for a blank image."""
    low, high = float(image.min()), float(image.max())
    if not high > low:
        return None
    lower = image[int(len(image) * (1 - LARGEST_SHARE)) - 4 * LEAST_PX :] if len(image) > 16 * LEAST_PX else image
    return np.asarray((lower.astype(np.float64) - low) / (high - low))


def _paper(levels: Array) -> float:
    """Commonest grey value of the last rows."""
    counts, edges = np.histogram(levels[-LEAST_PX - STRAY_PX : -STRAY_PX], bins=64, range=(0, 1))
    first = int(counts.argmax())
    last = levels[-LEAST_PX - STRAY_PX : -STRAY_PX]
    return float(np.median(last[(last >= edges[first]) & (last <= edges[first + 1])]))


def _ruled(levels: Array, paper: float) -> Mask:
    """Rows that are a line from side to side, in another colour than the paper, (rows,) bool."""
    middle = np.median(levels, axis=1)
    one_colour = (np.abs(levels - middle[:, None]) <= SAME / 2).mean(axis=1) >= RULED
    return np.asarray(one_colour & (np.abs(middle - paper) >= CONTRAST))


def _top(paper_share: Array, ruled: Mask) -> int:
    """First row of the band that ends at the bottom."""
    banded = (paper_share >= WRITTEN) | ruled
    row = len(banded)
    while row > len(banded) - STRAY_PX and not banded[row - 1]:
        row -= 1
    while row > 0 and banded[row - 1]:
        row -= 1
    return row


def _begins_with_a_jump(paper_share: Array, ruled: Mask, top: int) -> bool:
    """Either a ruled line opens the band, or plain paper lies directly below rows of the picture."""
    if top == 0:
        return False
    opening = slice(top, top + EDGE_PX)
    above = paper_share[max(0, top - 2 * EDGE_PX) : top]
    jumps = bool(np.median(above) <= PICTURE and np.median(paper_share[opening]) >= PLAIN)
    return bool(ruled[opening].any()) or jumps


def _is_written(levels: Array, paper: float, ruled: Mask, top: int) -> bool:
    """Letters: ink of one colour on plain paper, not in all rows."""
    band = levels[top : len(levels) - STRAY_PX][~ruled[top : len(levels) - STRAY_PX]]
    if len(band) < LEAST_PX // 2:
        return False
    away = np.abs(band - paper)
    inked = away >= CONTRAST
    one_colour = np.abs(away - away.max()) <= 2 * SAME
    plain_rows = ((away <= SAME).mean(axis=1) >= PLAIN).mean()
    return bool(INK[0] <= inked.mean() <= INK[1] and plain_rows >= 0.1 and one_colour.sum() >= ONE_COLOUR * inked.sum())
