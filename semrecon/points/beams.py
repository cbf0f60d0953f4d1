"""Intersection of beams, and distances from them: the loops over points and views that everything else waits for.

Two kernels, run over bands of points side by side (`point_bands`). They know the camera of `camera_model`: sightings
are mapped back to the ideal camera (``undo = (M T)^-1``) before they are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np

from semrecon.data import Array, Mask, Optics, Poses
from semrecon.numerics.normal_equations import RANK_TOLERANCE, multiply, pseudo_inverses
from semrecon.numerics.point_bands import in_bands


@dataclass(frozen=True)
class Views:
    """Cameras as the kernels take them.

    Parameters
    ----------
    rotations, translations_um
        R_cam_from_world (views, 3, 3) and t (views, 3).
    undo
        Maps a sighting, um from the image centre, to the ideal camera's, (views, 2, 2).
    centre_px, pixel_size_um, k
        Of the optics; k is the inverse working distance.
    """

    rotations: Array
    translations_um: Array
    undo: Array
    centre_px: Array
    pixel_size_um: float
    k: float


def views_of(poses: Poses, optics: Optics, undo: Array | None = None) -> Views:
    """Gather what the kernels need; without `undo` the cameras are ideal."""
    ideal = np.tile(np.eye(2), (len(poses), 1, 1)) if undo is None else undo
    rotations, translations = np.ascontiguousarray(poses.rotations), np.ascontiguousarray(poses.translations_um)
    return Views(
        rotations,
        translations,
        np.ascontiguousarray(ideal),
        optics.centre_px,
        float(optics.pixel_size_um),
        float(optics.inverse_working_distance),
    )


def newton_step(xy_px: Array, weights: Array, xyz_um: Array, views: Views) -> tuple[Array, Array, Mask]:
    """Take one Gauss-Newton step of every point: exact from anywhere for k = 0.

    Parameters
    ----------
    xy_px
        Sightings, (points, views, 2); not read where the weight is 0.
    weights
        Inverse variance of the sightings as the ideal camera has them, 1/px^2, (points, views).
    xyz_um
        Where the points stand, (points, 3).

    Returns
    -------
    New positions (points, 3), the (pseudo-)inverses of their normal matrices, um^2 (points, 3, 3), and whether a point
    is fixed in all three directions (points,).
    """
    moved, inverses = np.empty((len(xyz_um), 3)), np.empty((len(xyz_um), 3, 3))
    regular = np.empty(len(xyz_um), dtype=np.bool_)
    xy, w, xyz = (np.ascontiguousarray(a, dtype=np.float64) for a in (xy_px, weights, xyz_um))
    args = (views.rotations, views.translations_um, views.undo, views.centre_px, views.pixel_size_um, views.k)
    in_bands(lambda first, last: _step(xy, w, xyz, *args, moved, inverses, regular, first, last), len(xyz_um))
    fixed = regular.copy()
    rare = np.flatnonzero(~regular)
    if len(rare):  # the kernel left matrix and right-hand side there
        inverses[rare], ranks = pseudo_inverses(inverses[rare])
        moved[rare], fixed[rare] = multiply(inverses[rare], moved[rare]), ranks == 3
    return xyz_um + moved, inverses, fixed


def parallel_intersection(xy_px: Array, weights: Array, views: Views) -> tuple[Array, Array, Mask]:
    """Intersect the beams as if they were parallel, from nothing; answers like `newton_step`."""
    return newton_step(xy_px, weights, np.zeros((len(xy_px), 3)), replace(views, k=0.0))


def lengths_px(xy_px: Array, xyz_um: Array, views: Views) -> Array:
    """Distance of each sighting, mapped back to the ideal camera, from its reprojection, (points, views).

    NaN where a sighting or its point is missing.
    """
    xy, xyz = (np.ascontiguousarray(a, dtype=np.float64) for a in (xy_px, xyz_um))
    lengths = np.empty(xy.shape[:2])
    args = (views.rotations, views.translations_um, views.undo, views.centre_px, views.pixel_size_um, views.k)
    in_bands(lambda first, last: _lengths(xy, xyz, *args, lengths, first, last), len(xyz))
    return lengths


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _step(
    xy: Array,
    weights: Array,
    xyz: Array,
    rotations: Array,
    translations: Array,
    undo: Array,
    centre: Array,
    pixel: float,
    k: float,
    moved: Array,
    inverses: Array,
    regular: Mask,
    first: int,
    last: int,
) -> None:
    """Solve N step = b of the points in a band; N and b themselves are left where N may be singular."""
    row = np.empty((2, 3))
    n = np.empty((3, 3))
    b = np.empty(3)
    for i in range(first, last):
        n[:], b[:] = 0.0, 0.0
        for v in range(len(rotations)):
            w = weights[i, v] / pixel**2
            if not w > 0:
                continue
            r, t, u = rotations[v], translations[v], undo[v]
            cx = r[0, 0] * xyz[i, 0] + r[0, 1] * xyz[i, 1] + r[0, 2] * xyz[i, 2] + t[0]
            cy = r[1, 0] * xyz[i, 0] + r[1, 1] * xyz[i, 1] + r[1, 2] * xyz[i, 2] + t[1]
            cz = r[2, 0] * xyz[i, 0] + r[2, 1] * xyz[i, 1] + r[2, 2] * xyz[i, 2] + t[2]
            scale = 1 + k * cz
            mx, my = (xy[i, v, 0] - centre[0]) * pixel, (xy[i, v, 1] - centre[1]) * pixel
            fx, fy = cx / scale, cy / scale
            ex = u[0, 0] * mx + u[0, 1] * my - fx
            ey = u[1, 0] * mx + u[1, 1] * my - fy
            for a in range(3):
                row[0, a] = (r[0, a] - k * fx * r[2, a]) / scale
                row[1, a] = (r[1, a] - k * fy * r[2, a]) / scale
            for a in range(3):
                b[a] += w * (row[0, a] * ex + row[1, a] * ey)
                for c in range(a + 1):
                    n[a, c] += w * (row[0, a] * row[0, c] + row[1, a] * row[1, c])
        n[0, 1], n[0, 2], n[1, 2] = n[1, 0], n[2, 0], n[2, 1]
        regular[i] = _inverted(n, inverses[i])
        for a in range(3):
            moved[i, a] = b[a]
            if regular[i]:
                moved[i, a] = inverses[i, a, 0] * b[0] + inverses[i, a, 1] * b[1] + inverses[i, a, 2] * b[2]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _inverted(n: Array, inverse: Array) -> bool:
    """Invert by the adjugate where that is safe (as `normal_equations.pseudo_inverses` does), or else copy."""
    for a in range(3):
        p, q = (a + 1) % 3, (a + 2) % 3
        for c in range(3):
            s, t = (c + 1) % 3, (c + 2) % 3
            inverse[c, a] = n[p, s] * n[q, t] - n[p, t] * n[q, s]
    determinant = n[0, 0] * inverse[0, 0] + n[0, 1] * inverse[1, 0] + n[0, 2] * inverse[2, 0]
    if determinant > 100 * RANK_TOLERANCE * (n[0, 0] + n[1, 1] + n[2, 2]) ** 3:
        inverse /= determinant
        return True
    inverse[:] = n
    return False


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _lengths(
    xy: Array,
    xyz: Array,
    rotations: Array,
    translations: Array,
    undo: Array,
    centre: Array,
    pixel: float,
    k: float,
    lengths: Array,
    first: int,
    last: int,
) -> None:
    for i in range(first, last):
        for v in range(len(rotations)):
            r, t, u = rotations[v], translations[v], undo[v]
            cx = r[0, 0] * xyz[i, 0] + r[0, 1] * xyz[i, 1] + r[0, 2] * xyz[i, 2] + t[0]
            cy = r[1, 0] * xyz[i, 0] + r[1, 1] * xyz[i, 1] + r[1, 2] * xyz[i, 2] + t[1]
            cz = r[2, 0] * xyz[i, 0] + r[2, 1] * xyz[i, 1] + r[2, 2] * xyz[i, 2] + t[2]
            x, y = xy[i, v, 0] - centre[0], xy[i, v, 1] - centre[1]
            scale = pixel * (1 + k * cz)
            ex = u[0, 0] * x + u[0, 1] * y - cx / scale
            ey = u[1, 0] * x + u[1, 1] * y - cy / scale
            lengths[i, v] = np.sqrt(ex * ex + ey * ey)
