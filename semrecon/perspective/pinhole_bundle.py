"""Bundle adjustment of pinhole cameras and points, with the points eliminated (Triggs et al. 2000)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from semrecon.data import Array
from semrecon.perspective.pinhole import Pinholes

START, LEAST, MOST = 1e-3, 1e-9, 1e6
"""Damping of Levenberg and Marquardt: at first, and the range in which it moves."""
FAR = 100.0
"""Residual in units of `robust_px` that stands for a point behind a camera."""
SETTLED, EXACT = 1e-5, 1e-12
"""Gain below which the steps end, as a share of the cost and for each point."""


def bundle(
    xy_px: Array, xyz: Array, cameras: Pinholes, *, robust_px: float = 1.0, rounds: int = 30
) -> tuple[Array, Pinholes]:
    """Move placed cameras and points until sightings are met best: Cauchy loss, Levenberg-Marquardt.

    Frame and unit are free; the damping holds them. Focal length and principal point stay.

    Parameters
    ----------
    xy_px
        Sightings, (n, views, 2), NaN where missing.
    xyz
        Start, (n, 3), finite.
    robust_px
        Residual from which a sighting counts less.

    Returns
    -------
    Points and cameras, moved to the centroid of the points as origin.
    """
    origin = xyz.mean(axis=0)
    xyz, cameras = xyz - origin, replace(cameras, translations=cameras.translations + cameras.rotations @ origin)
    damping, cost = START, _cost(xy_px, xyz, cameras, robust_px)
    for _ in range(rounds):
        moved_xyz, moved = _step(xy_px, xyz, cameras, robust_px, damping)
        new = _cost(xy_px, moved_xyz, moved, robust_px)
        if not new < cost:
            damping *= 10
            if damping > MOST:
                break
            continue
        gain, xyz, cameras, cost = cost - new, moved_xyz, moved, new
        damping = max(damping / 5, LEAST)
        if gain <= SETTLED * cost + EXACT * len(xyz):
            break
    return xyz, cameras


def _residual(xy_px: Array, xyz: Array, cameras: Pinholes) -> Array:
    """Sighting minus projection, (n, views, 2); 0 where there is none."""
    away = xy_px - cameras.project(xyz)
    seen = np.asarray(np.isfinite(away).all(axis=2))
    return np.where(seen[..., None], away, 0.0)


def robust_cost(xy_px: Array, xyz: Array, cameras: Pinholes, robust_px: float) -> float:
    """Cauchy loss of all sightings (n, views, 2) in placed views; those of a point not in front count `FAR`."""
    square = (_residual(xy_px, xyz, cameras) ** 2).sum(axis=2) / robust_px**2
    depth = cameras.in_camera(xyz)[:, cameras.placed, 2]
    square[~(depth > 0).all(axis=1)] = FAR**2
    return float(np.log1p(square)[np.isfinite(xy_px).all(axis=2) & cameras.placed].sum())


def _cost(xy_px: Array, xyz: Array, cameras: Pinholes, robust_px: float) -> float:
    ahead = (cameras.in_camera(xyz)[:, cameras.placed, 2] > 0).all()
    return robust_cost(xy_px, xyz, cameras, robust_px) if ahead else float("inf")


def _step(xy_px: Array, xyz: Array, cameras: Pinholes, robust_px: float, damping: float) -> tuple[Array, Pinholes]:
    """One step: reduced equations of the cameras, then the points (Schur complement)."""
    away = _residual(xy_px, xyz, cameras)
    seen = np.isfinite(xy_px).all(axis=2) & cameras.placed
    root = np.where(seen, 1 / np.sqrt(robust_px**2 + (away**2).sum(axis=2)), 0.0)[..., None]
    by_camera, by_point = (one * root[..., None] for one in _jacobians(xyz, cameras))
    away, (points, views) = away * root, seen.shape
    rows = by_point.reshape(points, 2 * views, 3)
    inverse = np.linalg.inv(_damped(np.swapaxes(rows, 1, 2) @ rows, damping))
    coupling = (np.swapaxes(by_camera, 2, 3) @ by_point).reshape(points, 6 * views, 3)
    force = (away.reshape(points, 1, -1) @ rows)[:, 0]
    carried = coupling @ inverse
    matrix = -np.tensordot(carried, coupling, axes=((0, 2), (0, 2)))
    right = np.einsum("nvci,nvc->vi", by_camera, away).ravel() - np.tensordot(carried, force, axes=((0, 2), (0, 1)))
    for view in range(views):
        own, part = by_camera[:, view].reshape(-1, 6), slice(6 * view, 6 * view + 6)
        matrix[part, part] += _damped(own.T @ own, damping)
    step = np.linalg.lstsq(matrix, right, rcond=None)[0]
    moves = (inverse @ (force - np.einsum("nij,i->nj", coupling, step))[..., None])[..., 0]
    step = step.reshape(views, 6)
    turned = Rotation.from_rotvec(step[:, :3]).as_matrix() @ cameras.rotations
    return xyz + moves, replace(cameras, rotations=turned, translations=cameras.translations + step[:, 3:])


def _jacobians(xyz: Array, cameras: Pinholes) -> tuple[Array, Array]:
    """Differentiate the projections by cameras (n, views, 2, 6) and points (n, views, 2, 3); 0 for absent views.

    A camera turns about the origin of the points: ``d X_cam = omega x (R X) + d t``.
    """
    camera = cameras.in_camera(xyz)
    x, y, z = np.moveaxis(np.where(np.isfinite(camera), camera, 1.0), 2, 0)
    flat = np.zeros((*x.shape, 2, 3))
    flat[..., 0, 0] = flat[..., 1, 1] = cameras.focal_px / z
    flat[..., 0, 2], flat[..., 1, 2] = -cameras.focal_px * x / z**2, -cameras.focal_px * y / z**2
    rotations = np.where(np.isfinite(cameras.rotations), cameras.rotations, 0.0)
    turned = np.einsum("vij,nj->nvi", rotations, xyz)
    by_turn = np.cross(turned[..., None, :], flat)  # flat . (omega x turned) = omega . (turned x flat)
    return np.concatenate([by_turn, flat], axis=3), flat @ rotations


def _damped(matrix: Array, damping: float) -> Array:
    """Enlarge the diagonal of (..., n, n) by a share of itself, so that units do not matter."""
    size = matrix.shape[-1]
    diagonal = np.einsum("...ii->...i", matrix)
    floor = 1e-12 * diagonal.max(axis=-1, keepdims=True) + 1e-300
    return np.asarray(matrix + (damping * diagonal + floor)[..., None] * np.eye(size))
