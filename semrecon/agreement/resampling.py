"""A surface as another view would see it: triangles drawn on a pixel grid, the highest one where several overlap."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semrecon.data import Array

SNAP_PX = 1e-7
"""Positions nearer than this to a pixel centre are taken to be there, lest rounding open the rim of a hole."""


def draw_grid(xy_px: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Draw the cells of a distorted grid, two triangles each; a cell with one corner missing keeps the other three.

    Parameters
    ----------
    xy_px
        Where each node of the grid falls, (rows, columns, 2) as (column, row).
    values
        (rows, columns, channels); the first channel is the height by which the highest surface wins. A node is missing
        where its position or its height is NaN.
    shape
        (rows, columns) of the result.

    Returns
    -------
    (channels, rows, columns), NaN where nothing was drawn.
    """
    out = np.full((values.shape[-1], *shape), np.nan)
    _draw_grid(_snapped(xy_px), np.ascontiguousarray(values), out)
    return out


def draw_faces(xy_px: Array, faces: NDArray[np.int64], values: Array, shape: tuple[int, int]) -> Array:
    """Draw triangles (faces, 3) of points, xy_px (points, 2), values (points, channels), as `draw_grid` does cells."""
    out = np.full((values.shape[-1], *shape), np.nan)
    _draw_faces(_snapped(xy_px), faces, np.ascontiguousarray(values), out)
    return out


def _snapped(xy_px: Array) -> Array:
    nearest = np.rint(xy_px)
    return np.ascontiguousarray(np.where(np.abs(xy_px - nearest) < SNAP_PX, nearest, xy_px))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _draw(p: Array, q: Array, r: Array, vp: Array, vq: Array, vr: Array, out: Array) -> None:
    """Draw one triangle: the signs of three cross products relative to the pixel tell whether its centre is inside."""
    channels, rows, columns = out.shape
    first_row = max(0, int(np.ceil(min(p[1], q[1], r[1]))))
    last_row = min(rows - 1, int(np.floor(max(p[1], q[1], r[1]))))
    first = max(0, int(np.ceil(min(p[0], q[0], r[0]))))
    last = min(columns - 1, int(np.floor(max(p[0], q[0], r[0]))))
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            ax, ay = p[0] - column, p[1] - row
            bx, by = q[0] - column, q[1] - row
            cx, cy = r[0] - column, r[1] - row
            u, v, w = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
            area = u + v + w
            if area == 0 or not ((u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0)):
                continue
            u, v, w = u / area, v / area, w / area
            height = u * vp[0] + v * vq[0] + w * vr[0]
            if out[0, row, column] >= height:
                continue
            out[0, row, column] = height
            for channel in range(1, channels):
                out[channel, row, column] = u * vp[channel] + v * vq[channel] + w * vr[channel]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _draw_faces(xy_px: Array, faces: NDArray[np.int64], values: Array, out: Array) -> None:
    for f in range(len(faces)):
        i, j, k = faces[f]
        total = xy_px[i].sum() + xy_px[j].sum() + xy_px[k].sum() + values[i, 0] + values[j, 0] + values[k, 0]
        if np.isfinite(total):
            _draw(xy_px[i], xy_px[j], xy_px[k], values[i], values[j], values[k], out)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _draw_grid(xy_px: Array, values: Array, out: Array) -> None:
    """Triangles 0-1-2 and 0-2-3 around each cell; of a cell with one corner missing the other three."""
    rows, columns = xy_px.shape[:2]
    corner_row, corner_column = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
    known = np.empty(4, dtype=np.bool_)
    for row in range(rows - 1):
        for column in range(columns - 1):
            missing, count = -1, 0
            for c in range(4):
                i, j = row + corner_row[c], column + corner_column[c]
                known[c] = np.isfinite(values[i, j, 0]) and np.isfinite(xy_px[i, j, 0]) and np.isfinite(xy_px[i, j, 1])
                if known[c]:
                    count += 1
                else:
                    missing = c
            if count < 3:
                continue
            for half in range(2):
                # with a corner missing, one triangle of the three after it
                a, b, c = (
                    (0, 1 + half, 2 + half) if count == 4 else ((missing + 1) % 4, (missing + 2) % 4, (missing + 3) % 4)
                )
                if count == 3 and half == 1:
                    break
                ia, ja = row + corner_row[a], column + corner_column[a]
                ib, jb = row + corner_row[b], column + corner_column[b]
                ic, jc = row + corner_row[c], column + corner_column[c]
                _draw(xy_px[ia, ja], xy_px[ib, jb], xy_px[ic, jc], values[ia, ja], values[ib, jb], values[ic, jc], out)
