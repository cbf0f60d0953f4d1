"""What each view sees of the surface: the height map is drawn into the view, and whatever lies behind is hidden."""

from __future__ import annotations

import numba
import numpy as np

from semrecon.data import Array, Mask
from semrecon.dense.sightlines import Sightlines, elevation, place

TOLERANCE_PX = 1.5
"""Height by which something must stand in front, beside what the slope of the surface brings about in a pixel."""
TURNED = 0.2
"""A patch that a view sees at less than this share of its area in the reference view is too oblique to compare."""


def visible(heights: Array, lines: Sightlines, view: int) -> Mask:
    """Tell which pixels of the reference grid a view sees, (rows, columns).

    Parameters
    ----------
    heights
        (rows, columns), px; finite.
    """
    seen = np.ones(heights.shape, dtype=np.bool_)
    if view != lines.reference:
        _visible(heights, lines.of(view), seen, np.full(heights.shape, -np.inf), TOLERANCE_PX, TURNED)
    return seen


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _visible(heights: Array, geometry: Array, seen: Mask, front: Array, tolerance: float, turned: float) -> None:
    rows, columns = heights.shape
    for y in range(rows):
        for x in range(columns):
            u, v = place(geometry, float(x), float(y), heights[y, x])
            i, j = int(np.rint(u)), int(np.rint(v))
            if 0 <= i < columns and 0 <= j < rows:
                front[j, i] = max(front[j, i], elevation(geometry, float(x), float(y), heights[y, x]))
    for y in range(rows):
        for x in range(columns):
            u, v = place(geometry, float(x), float(y), heights[y, x])
            i, j = int(np.rint(u)), int(np.rint(v))
            if not (0 <= i < columns and 0 <= j < rows):
                seen[y, x] = False
                continue
            x1, y1 = min(x + 1, columns - 1), min(y + 1, rows - 1)
            x0, y0 = max(x - 1, 0), max(y - 1, 0)
            ux1, vx1 = place(geometry, float(x1), float(y), heights[y, x1])
            ux0, vx0 = place(geometry, float(x0), float(y), heights[y, x0])
            uy1, vy1 = place(geometry, float(x), float(y1), heights[y1, x])
            uy0, vy0 = place(geometry, float(x), float(y0), heights[y0, x])
            area = ((ux1 - ux0) * (vy1 - vy0) - (uy1 - uy0) * (vx1 - vx0)) / max((x1 - x0) * (y1 - y0), 1)
            slope = max(abs(heights[y, x1] - heights[y, x0]), abs(heights[y1, x] - heights[y0, x]))
            behind = front[j, i] - elevation(geometry, float(x), float(y), heights[y, x])
            seen[y, x] = area > turned and behind < tolerance + slope
