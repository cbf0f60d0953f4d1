"""The left-right check: heights found from another view must be those found from the reference view.

Where nothing can be recognised, each sweep invents a surface of its own, and the two do not agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from semrecon.data import Array, Mask
from semrecon.dense.pictures import Level
from semrecon.dense.sightlines import Sightlines, elevation, place
from semrecon.dense.surface import SweepOptions, swept
from semrecon.dense.visibility import visible

CHECK_PIXELS = 300_000
"""The two are compared at the largest size that has at most so many pixels."""
TOLERANCE_PX = 2.0
"""Parallax, in pixels of that size, by which the two may differ."""
AROUND = 1
"""The other height may be that of a neighbour so many pixels away: edges are never in the same place."""


def confirmed(
    pictures: Sequence[Level],
    lines: Sightlines,
    other_lines: Sightlines,
    heights: Array,
    span_px: tuple[float, float],
    options: SweepOptions,
) -> Mask:
    """Tell which heights a sweep from another view finds again, (rows, columns); what it cannot see counts as found.

    Parameters
    ----------
    lines, other_lines
        The same cameras, seen from the reference view and from the other one.
    heights
        Of the reference view's full picture, (rows, columns), px.
    span_px
        Where they lie.
    """
    depth = math.ceil(math.log(max(heights.size / CHECK_PIXELS, 1.0), 4.0))
    small, own = heights[:: 2**depth, :: 2**depth] / 2**depth, lines.at_level(depth)
    plane = level_plane(other_lines, lines.reference, heights.shape)
    found = swept(pictures, other_lines, span_px, options, finest=depth, plane=plane)
    fastest = float(np.linalg.norm(own.parallax(), axis=1).max())
    view = other_lines.reference
    same = np.ones(small.shape, dtype=np.bool_)
    _compare(small, found, own.of(view), TOLERANCE_PX / fastest, same)
    same |= ~visible(small, own, view)
    for _ in range(depth):
        same = np.repeat(np.repeat(same, 2, axis=0), 2, axis=1)
    return np.asarray(same[: heights.shape[0], : heights.shape[1]])


def level_plane(lines: Sightlines, view: int, shape: tuple[int, ...]) -> Array:
    """Heights along the beam of `lines.reference` of the plane that lies level in another view, (rows, columns), px."""
    row = lines.matrices[view, 2]
    y, x = np.indices(shape)
    return np.asarray((row[0] * (x - lines.centre_px[0]) + row[1] * (y - lines.centre_px[1])) / row[2])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _compare(heights: Array, found: Array, geometry: Array, tolerance: float, same: Mask) -> None:
    rows, columns = found.shape
    for y in range(rows):
        for x in range(columns):
            u, v = place(geometry, float(x), float(y), heights[y, x])
            i, j = int(np.rint(u)), int(np.rint(v))
            if not (0 <= i < columns and 0 <= j < rows):
                continue
            height, near = elevation(geometry, float(x), float(y), heights[y, x]), np.inf
            for b in range(max(j - AROUND, 0), min(j + AROUND + 1, rows)):
                for a in range(max(i - AROUND, 0), min(i + AROUND + 1, columns)):
                    near = min(near, abs(found[b, a] - height))
            same[y, x] = near <= tolerance
