"""Orientation of a view from known points under parallel projection: the orthographic-n-point problem.

With centred points x_i and sightings m_i the task is ``min sum |m_i - A x_i|^2`` over 2 x 3 matrices with orthonormal
rows, the first two rows of R (an unbalanced orthogonal Procrustes problem; Steger 2018, "Algorithms for the
Orthographic-n-Point Problem"). All it needs are two sums, ``S = sum x x^T`` and ``C = sum x m^T``, so that a search
from many starts costs the same for three points as for a million.

What is guaranteed: where the largest eigenvalue of the multiplier ``L = A S A^T - C^T A^T`` is not above the smallest
of S, the Lagrangian is convex and the minimum is the global one (`Minima.proven`). Exact sightings always pass, and
noisy ones do while the noise is small against the relief. Elsewhere the answer is the best of all minima that the
starts lead to, among them both lifts of the planar solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semrecon.data import Array
from semrecon.errors import MethodError

LEAST_SPREAD = 1e-12
"""Second principal moment over the first below which points count as lying on one line."""
STEPS = 60
SETTLED_RAD = 1e-13
ROUNDING = 1e-14
"""A step may raise the normalised cost by this much: less is rounding, not a worse orientation."""
PROOF_TOLERANCE = 1e-9
GENERIC = Rotation.from_rotvec([0.31, -0.22, 0.17]).as_matrix()
"""Turns the starts away from all symmetries of S, where saddle points lie."""


@dataclass(frozen=True)
class Moments:
    """Second moments about the mean of the points, divided by the trace of S, so that the points have unit size.

    Parameters
    ----------
    points
        S, (3, 3), of trace 1.
    mixed
        C, points by sightings, (3, 2).
    axes
        Principal axes of S as columns, from the widest to the thinnest, right-handed, (3, 3).
    spread
        Eigenvalues of S in the same order, (3,).
    """

    points: Array
    mixed: Array
    axes: Array
    spread: Array


@dataclass(frozen=True)
class Minima:
    """Orientations that nothing near them beats, best first.

    Parameters
    ----------
    rotations
        (minima, 3, 3); the starts that lead to the same orientation are not merged.
    costs
        Half the sum of squared distances over the trace of S, less a constant, (minima,).
    proven
        True where the first is certain to be the global minimum (up to rounding).
    """

    rotations: Array
    costs: Array
    proven: bool


def moments(xyz_um: Array, m_um: Array, weights: Array | None = None) -> Moments:
    """Sum up points (n, 3) and sightings (n, 2), both in um, with weights (n,).

    Raises
    ------
    MethodError
        There are fewer than three points, or all lie on one line.
    """
    if len(xyz_um) < 3:
        raise MethodError(f"the orientation of a view needs at least 3 points, not {len(xyz_um)}")
    weights = np.ones(len(xyz_um)) if weights is None else weights
    x, m = (a - np.average(a, axis=0, weights=weights) for a in (xyz_um, m_um))
    s, c = (weights[:, None] * x).T @ x, (weights[:, None] * x).T @ m
    spread, axes = np.linalg.eigh(s)
    if spread[1] <= LEAST_SPREAD * spread[2] or spread[2] == 0:
        raise MethodError("the points lie on one line, about which a view turns freely; give points that span a plane")
    axes = axes[:, ::-1] * [1, 1, np.sign(np.linalg.det(axes[:, ::-1]))]
    size = float(spread.sum())
    return Moments(s / size, c / size, axes, spread[::-1] / size)


def find_minima(sums: Moments) -> Minima:
    """Descend from many orientations, and from the mirror image of the best in the plane of the points."""
    rotations, costs = _descend(_starts(sums), sums)
    best = rotations[np.argmin(costs)]
    mirrored, mirrored_costs = _descend(mirror(best, sums)[None], sums)
    rotations, costs = np.concatenate([rotations, mirrored]), np.concatenate([costs, mirrored_costs])
    order = np.argsort(costs, kind="stable")
    return Minima(rotations[order], costs[order], _is_proven(rotations[order[0]], sums))


def mirror(rotation: Array, sums: Moments) -> Array:
    """Orientation that shows points of a plane at the same places, (3, 3): the other side of the two-fold ambiguity."""
    normal = sums.axes[:, 2]
    return completed(rotation[:2] - 2 * np.outer(rotation[:2] @ normal, normal))


def completed(rows: Array) -> Array:
    """Proper rotations (..., 3, 3) from their first two rows (..., 2, 3)."""
    return np.concatenate([rows, np.cross(rows[..., :1, :], rows[..., 1:, :])], axis=-2)


def planar_lifts(sums: Moments) -> Array:
    """Both orientations by the points' main plane alone, (2, 3, 3); exact for exact sightings of a plane.

    The affine map of the plane, a, must be the left 2 x 2 of orthonormal rows (A | b): its larger singular value is
    then 1, the smaller the cosine of the slope, and b closes the rows with either sign.
    """
    a = (sums.mixed.T @ sums.axes[:, :2]) / sums.spread[:2]
    u, values, vt = np.linalg.svd(a)
    cosine = min(float(values[1]), 1.0)
    a, b = u @ np.diag([1.0, cosine]) @ vt, u[:, 1:] * np.sqrt(1 - cosine**2)
    return completed(np.stack([np.hstack([a, sign * b]) for sign in (1, -1)]) @ sums.axes.T)


def _starts(sums: Moments) -> Array:
    """Both planar lifts, the affine solution made orthonormal, and the 24 turns of a cube beside the principal axes."""
    u, _, vt = np.linalg.svd(sums.mixed.T @ np.linalg.pinv(sums.points, rcond=1e-10), full_matrices=False)
    cube = Rotation.create_group("O").as_matrix() @ GENERIC @ sums.axes.T
    return np.concatenate([planar_lifts(sums), completed(u @ vt)[None], cube])


def _descend(rotations: Array, sums: Moments) -> tuple[Array, Array]:
    """Newton's method on SO(3), all starts at once, damped, with negative curvature turned about.

    The turn w is that of ``exp(w) R``, in camera axes; a step that raises the cost is not taken.
    """
    costs, damping, size = _costs(rotations, sums), np.full(len(rotations), 1e-3), np.inf
    for _ in range(STEPS):
        gradient, hessian = _slopes(rotations, sums)
        curvature, axes = np.linalg.eigh(hessian)
        along = (gradient[:, None] @ axes)[:, 0] / (np.abs(curvature) + damping[:, None])
        turn = (axes @ along[..., None])[..., 0]
        turned = Rotation.from_rotvec(turn).as_matrix() @ rotations
        better = (lower := _costs(turned, sums)) <= costs + ROUNDING
        rotations, costs = np.where(better[:, None, None], turned, rotations), np.where(better, lower, costs)
        damping = np.clip(np.where(better, damping / 30, damping * 10), 1e-15, 1e3)
        size = float(np.abs(turn).max())
        if size <= SETTLED_RAD:
            break
    return rotations, costs


def _costs(rotations: Array, sums: Moments) -> Array:
    rows = rotations[:, :2]
    return np.asarray((rows * (rows @ sums.points / 2 - sums.mixed.T)).sum(axis=(1, 2)))


def _slopes(rotations: Array, sums: Moments) -> tuple[Array, Array]:
    """Descent direction (b, 3) and Hessian (b, 3, 3) of the cost by the turn; exact, the residuals' curvature included.

    With y = R x, residual r and ``M = sum y r^T``: the turn w moves y by ``w x y + w x (w x y) / 2``.
    """
    g = rotations @ sums.points @ rotations.transpose(0, 2, 1)
    m = rotations @ sums.mixed - g[:, :, :2]
    gradient = np.stack([-m[:, 2, 1], m[:, 2, 0], m[:, 0, 1] - m[:, 1, 0]], axis=1)
    h = np.zeros_like(g)
    h[:, 0, 0] = h[:, 1, 1] = g[:, 2, 2]
    h[:, 2, 2] = g[:, 0, 0] + g[:, 1, 1]
    h[:, 0, 2] = h[:, 2, 0] = -g[:, 0, 2]
    h[:, 1, 2] = h[:, 2, 1] = -g[:, 1, 2]
    bent = np.concatenate([m, np.zeros((len(m), 3, 1))], axis=2)
    h += (m[:, 0, 0] + m[:, 1, 1])[:, None, None] * np.eye(3) - (bent + bent.transpose(0, 2, 1)) / 2
    return gradient, h


def _is_proven(rotation: Array, sums: Moments) -> bool:
    """Weak duality: no multiplier may exceed the smallest moment of the points."""
    rows = rotation[:2]
    multiplier = rows @ sums.points @ rows.T - sums.mixed.T @ rows.T
    largest = np.linalg.eigvalsh((multiplier + multiplier.T) / 2)[1]
    return bool(largest <= sums.spread[2] + PROOF_TOLERANCE)
