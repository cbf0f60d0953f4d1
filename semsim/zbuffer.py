"""Orthographic rasteriser: the fast way to the surface under a regular pixel grid in parallel projection.

Each triangle is drawn row by row, between the two of its edges that the row crosses (Pineda's half-planes are the
usual alternative; spans need no test a pixel). All in float64: the depth of a pixel is that of the triangle's plane.

A row crosses an edge if it lies in ``[y_low, y_high)``, and a pixel belongs to the span if it lies in
``[x_left, x_right)``. The crossing is worked out from the edge's end of lower y, so that both triangles of an edge find
the same number: a pixel on the edge belongs to exactly one of them, and no pixel falls between.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose
from semsim.raycast import linear_beam

Index = NDArray[np.int32]


def rasterise(mesh: Mesh, microscope: Microscope, pose: Pose) -> tuple[Array, Index]:
    """Draw one view; whatever lies nearest to the gun is seen, whichever way it faces.

    Returns
    -------
    depth_um, face
        (rows, columns) X_cam_z, NaN for a miss, and the triangle there, -1 for a miss. Where triangles lie at the very
        same depth, the first of them.

    Raises
    ------
    InputError
        The projection is not parallel.
    """
    if microscope.working_distance_um is not None:
        raise InputError("backend zbuffer draws parallel projection only; with working_distance_um use raycast")
    corners = image_coordinates(microscope, pose, mesh.vertices_um)
    span, (rows, columns) = np.empty((2, len(mesh.faces)), dtype=np.int32), microscope.shape
    in_bands(
        len(mesh.faces), lambda start, stop: row_spans(start, stop, corners, mesh.faces, 0, rows, 0, columns, span)
    )
    depth, face = np.empty(microscope.shape), np.empty(microscope.shape, dtype=np.int32)
    in_bands(len(depth), lambda top, bottom: _draw_band(top, bottom, corners, mesh.faces, span, depth, face))
    return depth, face


def image_coordinates(microscope: Microscope, pose: Pose, xyz_um: Array) -> Array:
    """Column, row and X_cam_z of world points (n, 3) in parallel projection: `linear_beam` turned round."""
    origin, direction = linear_beam(microscope, pose)
    image_from_world = np.linalg.inv(np.stack([origin[1], origin[2], direction[0]]))
    image = np.empty((len(xyz_um), 3))
    in_bands(len(image), lambda start, stop: _turn(start, stop, xyz_um, origin[0], image_from_world, image))
    return image


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _turn(
    start: int, stop: int, xyz: Array, origin: Array, matrix: Array, image: Array
) -> None:  # pragma: no cover - compiled
    """Multiply so narrow a matrix here: a BLAS that shares it among threads of its own takes longer."""
    for i in range(start, stop):
        for j in range(3):
            image[i, j] = 0.0
            for k in range(3):
                image[i, j] += (xyz[i, k] - origin[k]) * matrix[k, j]


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def row_spans(
    start: int,
    stop: int,
    corners: Array,
    faces: Index,
    first_row: int,
    end_row: int,
    first_column: int,
    end_column: int,
    span: Index,
) -> None:  # pragma: no cover - compiled
    """First row and the row after the last that each triangle meets inside the box; none: both the same."""
    for f in range(start, stop):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        left = np.ceil(min(corners[a, 0], corners[b, 0], corners[c, 0]))
        right = np.ceil(max(corners[a, 0], corners[b, 0], corners[c, 0]))
        span[0, f] = span[1, f] = first_row
        if left < right and left < end_column and right > first_column:
            low = np.ceil(min(corners[a, 1], corners[b, 1], corners[c, 1]))
            high = np.ceil(max(corners[a, 1], corners[b, 1], corners[c, 1]))
            if low < high and low < end_row and high > first_row:
                span[0, f], span[1, f] = max(low, first_row), min(high, end_row)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _draw_band(
    top: int, bottom: int, corners: Array, faces: Index, span: Index, depth: Array, face: Index
) -> None:  # pragma: no cover - compiled
    depth[top:bottom] = np.inf
    face[top:bottom] = -1
    for f in range(len(faces)):
        first, end = max(top, span[0, f]), min(bottom, span[1, f])
        if first < end:
            _draw(f, first, end, corners, faces, depth, face)
    for row in range(top, bottom):
        for column in range(depth.shape[1]):
            if face[row, column] < 0:
                depth[row, column] = np.nan


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _draw(
    f: int, first: int, end: int, corners: Array, faces: Index, depth: Array, face: Index
) -> None:  # pragma: no cover - compiled
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    if corners[b, 1] < corners[a, 1]:
        a, b = b, a
    if corners[c, 1] < corners[b, 1]:
        b, c = c, b
    if corners[b, 1] < corners[a, 1]:
        a, b = b, a
    xa, ya, da = corners[a, 0], corners[a, 1], corners[a, 2]
    xb, yb, db = corners[b, 0], corners[b, 1], corners[b, 2]
    xc, yc, dc = corners[c, 0], corners[c, 1], corners[c, 2]
    slope_ab, slope_bc, slope_ac = (xb - xa) / (yb - ya), (xc - xb) / (yc - yb), (xc - xa) / (yc - ya)
    twice_area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    across = ((db - da) * (yc - ya) - (dc - da) * (yb - ya)) / twice_area
    down = ((dc - da) * (xb - xa) - (db - da) * (xc - xa)) / twice_area
    # Only rounding can lead a pixel of a sliver out of the triangle's own range; the bound keeps it there.
    nearest, farthest = min(da, db, dc), max(da, db, dc)
    for row in range(first, end):
        long = xa + (row - ya) * slope_ac
        short = xa + (row - ya) * slope_ab if row < yb else xb + (row - yb) * slope_bc
        left, right = max(0, int(np.ceil(min(long, short)))), min(depth.shape[1], int(np.ceil(max(long, short))))
        if left >= right:
            continue
        depths, triangles = depth[row, left:right], face[row, left:right]
        start = da + across * (left - xa) + down * (row - ya)
        for i in range(right - left):
            here = start + across * i
            here = nearest if here < nearest else (farthest if here > farthest else here)
            if here < depths[i]:
                depths[i] = here
                triangles[i] = f
