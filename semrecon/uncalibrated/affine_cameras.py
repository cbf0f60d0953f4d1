"""Affine cameras of all views, and the least-squares problem of cameras and points with the points eliminated.

``xy_v = P_v X + t_v`` with any P_v (2 x 3): bilinear in cameras and points. For given cameras the points follow by
linear least squares, so that what stays is a problem of 8 unknowns a view, however many the points (Wiberg 1976; the
Schur complement of a bundle adjustment). Any other camera whose P and t are functions of fewer numbers is solved by the
same equations, through the derivatives of P and t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array, Tracks
from semrecon.numerics.normal_equations import multiply, normal_matrices, pseudo_inverses, right_sides

LOCAL = 8
"""Numbers of one camera: the two rows of (P | t)."""
BLOCK = 1024
"""Points at a time: bounds memory."""


@dataclass(frozen=True)
class AffineCameras:
    """Affine cameras in px: `matrices` P_v (views, 2, 3) and `offsets` t_v (views, 2)."""

    matrices: Array
    offsets: Array

    def __len__(self) -> int:
        return len(self.matrices)

    @property
    def vector(self) -> Array:
        """All numbers in a row, the rows of (P | t) of each view, (8 views,)."""
        return np.concatenate([self.matrices, self.offsets[..., None]], axis=2).ravel()

    @classmethod
    def from_vector(cls, vector: Array) -> AffineCameras:
        """Cameras from `vector`."""
        rows = vector.reshape(-1, 2, 4)
        return cls(rows[..., :3], rows[..., 3])


def intersect(xy_px: Array, weights: Array, cameras: AffineCameras) -> tuple[Array, Array]:
    """Points (tracks, 3) by weighted least squares, and the rank of each (tracks,).

    Parameters
    ----------
    xy_px, weights
        (tracks, views, 2), anything where the weight (tracks, views) is 0.
    """
    inverses, ranks = pseudo_inverses(normal_matrices(weights, cameras.matrices))
    offsets = np.where(weights[..., None] > 0, xy_px - cameras.offsets, 0.0)
    return multiply(inverses, right_sides(weights, cameras.matrices, offsets)), np.asarray(ranks)


def misses_px(xy_px: Array, points: Array, cameras: AffineCameras) -> Array:
    """Measured minus predicted positions, (tracks, views, 2); NaN where there is no sighting."""
    predicted = (points @ cameras.matrices.reshape(-1, 3).T).reshape(len(points), len(cameras), 2)
    return np.asarray(xy_px - predicted - cameras.offsets)


def loss(xy_px: Array, weights: Array, cameras: AffineCameras) -> float:
    """Weighted sum of squared misses, px^2, with the best points."""
    points, _ = intersect(xy_px, weights, cameras)
    squares = (misses_px(xy_px, points, cameras) ** 2).sum(axis=2)
    return float(np.where(weights > 0, weights * squares, 0.0).sum())


def reduced_equations(xy_px: Array, weights: Array, cameras: AffineCameras) -> tuple[Array, Array]:
    """Eliminate the points from the normal equations: (8 views, 8 views) and the right-hand side (8 views,)."""
    size = LOCAL * len(cameras)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for start in range(0, len(xy_px), BLOCK):
        part, w = xy_px[start : start + BLOCK], weights[start : start + BLOCK]
        points, _ = intersect(part, w, cameras)
        inverses, _ = pseudo_inverses(normal_matrices(w, cameras.matrices))
        misses = np.where(w[..., None] > 0, misses_px(part, points, cameras), 0.0)
        design = np.column_stack([points, np.ones(len(points))])
        # derivative of row r of view v by its own four numbers is the design; by the point it is row r of P_v
        own = np.einsum("ia,iv,ib->vab", design, w, design, optimize=True)
        for v in range(len(cameras)):
            for r in (2 * v, 2 * v + 1):
                matrix[4 * r : 4 * r + 4, 4 * r : 4 * r + 4] += own[v]
        rows = np.einsum("iv,vrk->ivrk", w, cameras.matrices)
        coupling = (rows[:, :, :, None, :] * design[:, None, None, :, None]).reshape(len(part), size, 3)
        matrix -= np.tensordot(coupling @ inverses, coupling, axes=([0, 2], [0, 2]))
        right += np.einsum("iv,ivr,ia->vra", w, misses, design, optimize=True).ravel()
    return (matrix + matrix.T) / 2, right


def weights_of(tracks: Tracks) -> Array:
    """One for each sighting of tracks that two views or more see, (tracks, views)."""
    seen = tracks.seen
    return np.where(seen & (seen.sum(axis=1) >= 2)[:, None], 1.0, 0.0)
