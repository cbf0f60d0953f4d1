"""The loop over points and views of a bundle adjustment: linearise the sightings, eliminate the points."""

from __future__ import annotations

import numba
import numpy as np

from semrecon.adjustment.camera_model import LOCAL
from semrecon.data import Array
from semrecon.numerics.normal_equations import RANK_TOLERANCE

EXTRA = 2
"""Columns of Y after those of the parameters."""


CHUNK = 64
"""Points whose Y is added up while it is in the cache."""


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def reduce_band(
    xy: Array,
    weights: Array,
    xyz: Array,
    rotations: Array,
    by_tilt: Array,
    by_axis: Array,
    translations: Array,
    distortions: Array,
    beam: Array,
    centre: Array,
    pixel: float,
    k: float,
    first: int,
    last: int,
) -> tuple[Array, Array, Array]:
    """Eliminate the points of a band; takes what `eliminate` takes.

    Returns
    -------
    U (views, 6, 6), its right-hand side (views, 6), and the lower triangle of Y^T Y, (n + EXTRA, n + EXTRA).
    """
    views = len(rotations)
    own, right = np.zeros((views, LOCAL + 1, LOCAL + 1)), np.zeros((views, LOCAL + 1))
    columns = views * LOCAL + 1 + EXTRA
    coupling, roots = np.zeros((3 * CHUNK, columns)), np.zeros((CHUNK, 3, 3))
    products = np.zeros((columns, columns))
    for start in range(first, last, CHUNK):
        stop = min(start + CHUNK, last)
        eliminate(
            xy[start:stop],
            weights[start:stop],
            xyz[start:stop],
            rotations,
            by_tilt,
            by_axis,
            translations,
            distortions,
            beam,
            centre,
            pixel,
            k,
            own,
            right,
            coupling,
            roots,
            0,
            stop - start,
        )
        for view in range(views):
            _add_view(coupling, weights[start:stop], view, products)
        for row in range(views * LOCAL, columns):
            _add_row(coupling, stop - start, row, products)
    return own, right, products


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[untyped-decorator]
def _add_view(coupling: Array, weights: Array, view: int, products: Array) -> None:
    """Add Y^T Y in the five rows of a view up to their diagonal block; points that the view does not see have none."""
    top = view * LOCAL
    p0, p1, p2, p3, p4 = products[top], products[top + 1], products[top + 2], products[top + 3], products[top + 4]
    for i in range(len(weights)):
        if not weights[i, view] > 0:
            continue
        x, y, z = coupling[3 * i], coupling[3 * i + 1], coupling[3 * i + 2]
        x0, x1, x2, x3, x4 = x[top], x[top + 1], x[top + 2], x[top + 3], x[top + 4]
        y0, y1, y2, y3, y4 = y[top], y[top + 1], y[top + 2], y[top + 3], y[top + 4]
        z0, z1, z2, z3, z4 = z[top], z[top + 1], z[top + 2], z[top + 3], z[top + 4]
        for b in range(top + LOCAL):
            p0[b] += x0 * x[b] + y0 * y[b] + z0 * z[b]
            p1[b] += x1 * x[b] + y1 * y[b] + z1 * z[b]
            p2[b] += x2 * x[b] + y2 * y[b] + z2 * z[b]
            p3[b] += x3 * x[b] + y3 * y[b] + z3 * z[b]
            p4[b] += x4 * x[b] + y4 * y[b] + z4 * z[b]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[untyped-decorator]
def _add_row(coupling: Array, points: int, row: int, products: Array) -> None:
    """Add one row of Y^T Y up to the diagonal."""
    into = products[row]
    for i in range(points):
        x, y, z = coupling[3 * i], coupling[3 * i + 1], coupling[3 * i + 2]
        x0, y0, z0 = x[row], y[row], z[row]
        for b in range(row + 1):
            into[b] += x0 * x[b] + y0 * y[b] + z0 * z[b]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def eliminate(
    xy: Array,
    weights: Array,
    xyz: Array,
    rotations: Array,
    by_tilt: Array,
    by_axis: Array,
    translations: Array,
    distortions: Array,
    beam: Array,
    centre: Array,
    pixel: float,
    k: float,
    own: Array,
    right: Array,
    coupling: Array,
    roots: Array,
    first: int,
    last: int,
) -> None:
    """Add up U and its right-hand side over the points of a band, and write their rows of Y and L (see `schur`).

    Parameters
    ----------
    xy, weights, xyz
        Sightings as measured, px (points, views, 2), inverse variances 1/um^2 (points, views), points um (points, 3).
    rotations, by_tilt, by_axis, translations, distortions
        Of every view: R and its two derivatives (views, 3, 3), t (views, 3), M T (views, 2, 2).
    own, right
        (views, 6, 6) and (views, 6), added to.
    coupling, roots
        (3 points, 5 views + 1 + EXTRA) and (points, 3, 3), written.
    """
    views = len(rotations)
    axis = views * LOCAL
    point, camera = np.empty((2, 3)), np.empty((2, LOCAL + 1))
    mixed, h, g = np.empty((axis + 1, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(first, last):
        mixed[:], h[:], g[:] = 0.0, 0.0, 0.0
        for v in range(views):
            w = weights[i, v]
            if not w > 0:
                continue
            sx, sy = derivatives(
                xyz[i], rotations[v], by_tilt[v], by_axis[v], translations[v], distortions[v], k, point, camera
            )
            ex, ey = (xy[i, v, 0] - centre[0]) * pixel - sx, (xy[i, v, 1] - centre[1]) * pixel - sy
            for a in range(3):
                g[a] += w * (point[0, a] * ex + point[1, a] * ey)
                for c in range(3):
                    h[a, c] += w * (point[0, a] * point[0, c] + point[1, a] * point[1, c])
            for a in range(LOCAL + 1):
                wx, wy = w * camera[0, a], w * camera[1, a]
                right[v, a] += wx * ex + wy * ey
                for c in range(LOCAL + 1):
                    own[v, a, c] += wx * camera[0, c] + wy * camera[1, c]
                row = axis if a == LOCAL else v * LOCAL + a
                for c in range(3):
                    mixed[row, c] += wx * point[0, c] + wy * point[1, c]
        _root_of_inverse(h, roots[i])
        for c in range(3):
            y = coupling[3 * i + c]
            l0, l1, l2 = roots[i, 0, c], roots[i, 1, c], roots[i, 2, c]
            for row in range(axis + 1):
                y[row] = mixed[row, 0] * l0 + mixed[row, 1] * l1 + mixed[row, 2] * l2
            y[axis + 1] = g[0] * l0 + g[1] * l1 + g[2] * l2
            y[axis + 2] = beam[0] * l0 + beam[1] * l1 + beam[2] * l2


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def derivatives(
    x: Array,
    r: Array,
    by_tilt: Array,
    by_axis: Array,
    t: Array,
    d: Array,
    k: float,
    point: Array,
    camera: Array,
) -> tuple[float, float]:
    """Sighting of one point in one view, um, and its derivatives: `camera_model.sightings_and_derivatives`."""
    cz = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[2]
    scale = 1 + k * cz
    fx = (r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[0]) / scale
    fy = (r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[1]) / scale
    sx, sy = d[0, 0] * fx + d[0, 1] * fy, d[1, 0] * fx + d[1, 1] * fy
    tilt0 = tilt1 = tilt2 = axis0 = axis1 = axis2 = 0.0
    for a in range(3):
        tilt0 += by_tilt[0, a] * x[a]
        tilt1 += by_tilt[1, a] * x[a]
        tilt2 += by_tilt[2, a] * x[a]
        axis0 += by_axis[0, a] * x[a]
        axis1 += by_axis[1, a] * x[a]
        axis2 += by_axis[2, a] * x[a]
    for e in range(2):
        i0, i1 = d[e, 0] / scale, d[e, 1] / scale
        i2 = -k * (i0 * fx + i1 * fy)
        for a in range(3):
            point[e, a] = i0 * r[0, a] + i1 * r[1, a] + i2 * r[2, a]
        camera[e, 0], camera[e, 1] = i0, i1
        camera[e, 2] = i0 * tilt0 + i1 * tilt1 + i2 * tilt2
        camera[e, 5] = i0 * axis0 + i1 * axis1 + i2 * axis2
    camera[0, 3], camera[1, 3] = sx, sy
    camera[0, 4], camera[1, 4] = -sy, sx
    return sx, sy


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _root_of_inverse(h: Array, root: Array) -> None:
    """L of ``H^-1 = L L^T``: by Cholesky where H is regular, on its range where it is not (`normal_equations`)."""
    trace = h[0, 0] + h[1, 1] + h[2, 2]
    determinant = (
        h[0, 0] * (h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1])
        - h[0, 1] * (h[1, 0] * h[2, 2] - h[1, 2] * h[2, 0])
        + h[0, 2] * (h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0])
    )
    root[:] = 0.0
    if determinant > 100 * RANK_TOLERANCE * trace**3:
        a = np.sqrt(h[0, 0])
        b, c = h[1, 0] / a, h[2, 0] / a
        d = np.sqrt(h[1, 1] - b * b)
        e = (h[2, 1] - b * c) / d
        f = np.sqrt(h[2, 2] - c * c - e * e)
        root[0, 0], root[1, 1], root[2, 2] = 1 / a, 1 / d, 1 / f  # the transpose of the inverse of the factor
        root[0, 1] = -b / (a * d)
        root[1, 2] = -e / (d * f)
        root[0, 2] = (b * e - c * d) / (a * d * f)
        return
    values, vectors = np.linalg.eigh(h)
    for c in range(3):
        if values[c] > RANK_TOLERANCE * values[2] and values[c] > 0:
            for a in range(3):
                root[a, c] = vectors[a, c] / np.sqrt(values[c])
