"""A layered height map of the specimen: where along upright lines there is material, overhangs and all.

The lines stand on a lattice of the world, not of a view: whoever looks from wherever finds the same numbers. A depth
map with several layers is an old idea (Shade et al. 1998); here a layer is a solid from its top to its bottom, found by
counting how often a line has entered the mesh and left it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.mesh import Array, Mesh
from semsim.zbuffer import Index, row_spans

MOST_LINES = 1 << 25
"""A larger lattice is made coarser: this many lines already take some hundreds of megabytes."""


@dataclass(frozen=True, eq=False)
class Layers:
    """Solids along the upright lines of a lattice.

    Parameters
    ----------
    step_um
        Spacing of the lines: line (row, column) stands at world x, y of (column, row) times this.
    first
        Row and column of the first line; rows count along world y, columns along world x.
    shape
        Rows and columns of lines.
    start
        (lines + 1,) where the solids of each line, row by row, begin in `ends_um`.
    ends_um
        (solids, 2) world z of top and bottom, the highest of a line first; the bottom is -inf where there is none.
    """

    step_um: float
    first: tuple[int, int]
    shape: tuple[int, int]
    start: Index
    ends_um: Array


def layers(mesh: Mesh, low_um: Array, high_um: Array, step_um: float) -> Layers:
    """Find all solids of a mesh over a box of the plane.

    A line from above first enters the mesh, whichever way its triangles turn there; from then on triangles that turn
    alike are entered and the others left, until it is outside. Solids that overlap become one. What is entered and
    never left, as is an open sheet, reaches down without end.

    Parameters
    ----------
    low_um, high_um
        (2,) corners of the box, world x and y; what lies outside the mesh's own box is left out.
    step_um
        Spacing of the lines; doubled until there are no more than `MOST_LINES`.
    """
    low = np.maximum(low_um, mesh.vertices_um[:, :2].min(axis=0))
    high = np.minimum(high_um, mesh.vertices_um[:, :2].max(axis=0))
    while np.prod(np.maximum(high - low, 0.0) / step_um + 1) > MOST_LINES:
        step_um *= 2
    column, row = np.ceil(low / step_um).astype(int)
    columns, rows = np.maximum(np.floor(high / step_um).astype(int) + 1 - (column, row), 0)
    box = (int(row), int(row + rows), int(column), int(column + columns))
    corners = mesh.vertices_um / (step_um, step_um, 1.0)
    span = np.empty((2, len(mesh.faces)), dtype=np.int32)
    in_bands(len(mesh.faces), lambda i, j: row_spans(i, j, corners, mesh.faces, *box, span))
    parts: dict[int, tuple[Index, Array]] = {}

    def fill(top: int, bottom: int) -> None:
        parts[top] = _solids(box[0] + top, box[0] + bottom, box[2], box[3], corners, mesh.faces, span)

    in_bands(int(rows), fill)
    number = np.concatenate([np.empty(0, np.int32), *(parts[top][0] for top in sorted(parts))])
    ends = np.concatenate([np.empty((0, 2)), *(parts[top][1] for top in sorted(parts))])
    parts.clear()
    start = np.zeros(len(number) + 1, dtype=np.int32)
    np.cumsum(number, out=start[1:])
    return Layers(step_um, (box[0], box[2]), (int(rows), int(columns)), start, ends)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _solids(
    first_row: int, end_row: int, first_column: int, end_column: int, corners: Array, faces: Index, span: Index
) -> tuple[Index, Array]:  # pragma: no cover - compiled
    """Count the solids of each line of some rows, and put the ends of them all one after the other."""
    columns = end_column - first_column
    number = np.zeros((end_row - first_row) * columns, dtype=np.int32)
    nowhere, upward = np.empty(0), np.empty(0, dtype=np.bool_)
    for f in range(len(faces)):
        first, end = max(first_row, span[0, f]), min(end_row, span[1, f])
        if first < end:
            _cross(f, first, end, first_row, first_column, columns, corners, faces, number, nowhere, upward)
    after = np.cumsum(number)
    crossings = after[-1] if len(after) > 0 else 0
    height, upward = np.empty(crossings), np.empty(crossings, dtype=np.bool_)
    at = (after - number).astype(np.int32)
    for f in range(len(faces)):
        first, end = max(first_row, span[0, f]), min(end_row, span[1, f])
        if first < end:
            _cross(f, first, end, first_row, first_column, columns, corners, faces, at, height, upward)
    ends = np.empty((crossings, 2))
    solids = 0
    for line in range(len(number)):
        end = after[line]
        begin = end - number[line]
        _sort_downwards(height[begin:end], upward[begin:end])
        number[line] = -solids
        depth = 0
        entering = True
        for i in range(begin, end):
            if depth == 0:
                entering = upward[i]
                ends[solids, 0], ends[solids, 1] = height[i], -np.inf
                solids += 1
            depth += 1 if upward[i] == entering else -1
            if depth == 0:
                ends[solids - 1, 1] = height[i]
        number[line] += solids
    return number, ends[:solids].copy()


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _cross(
    f: int,
    first: int,
    end: int,
    first_row: int,
    first_column: int,
    columns: int,
    corners: Array,
    faces: Index,
    at: Index,
    height: Array,
    upward: NDArray[np.bool_],
) -> None:  # pragma: no cover - compiled
    """Move `at` on for every line that crosses a triangle, and put down height and side if there is room for them.

    Lines on an edge belong to one of its two triangles, by the rules of `semsim.zbuffer`.
    """
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    turned = False
    if corners[b, 1] < corners[a, 1]:
        a, b, turned = b, a, not turned
    if corners[c, 1] < corners[b, 1]:
        b, c, turned = c, b, not turned
    if corners[b, 1] < corners[a, 1]:
        a, b, turned = b, a, not turned
    xa, ya, za = corners[a, 0], corners[a, 1], corners[a, 2]
    xb, yb, zb = corners[b, 0], corners[b, 1], corners[b, 2]
    xc, yc, zc = corners[c, 0], corners[c, 1], corners[c, 2]
    slope_ab, slope_bc, slope_ac = (xb - xa) / (yb - ya), (xc - xb) / (yc - yb), (xc - xa) / (yc - ya)
    twice_area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    right_up = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / twice_area
    ahead_up = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / twice_area
    lowest, highest = min(za, zb, zc), max(za, zb, zc)
    for row in range(first, end):
        long = xa + (row - ya) * slope_ac
        short = xa + (row - ya) * slope_ab if row < yb else xb + (row - yb) * slope_bc
        left = max(first_column, int(np.ceil(min(long, short))))
        right = min(first_column + columns, int(np.ceil(max(long, short))))
        for column in range(left, right):
            line = (row - first_row) * columns + column - first_column
            if len(height) > 0:
                here = za + right_up * (column - xa) + ahead_up * (row - ya)
                height[at[line]] = min(max(here, lowest), highest)
                upward[at[line]] = (twice_area > 0.0) != turned
            at[line] += 1


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _sort_downwards(height: Array, upward: NDArray[np.bool_]) -> None:  # pragma: no cover - compiled
    """Sort by insertion: lines rarely cross more than a few triangles."""
    for i in range(1, len(height)):
        key, side, k = height[i], upward[i], i
        while k > 0 and height[k - 1] < key:
            height[k], upward[k] = height[k - 1], upward[k - 1]
            k -= 1
        height[k], upward[k] = key, side
