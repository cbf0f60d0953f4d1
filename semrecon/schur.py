"""Normal equations of a bundle adjustment, with the points eliminated exactly (Schur complement).

For cameras c and points X_i the normal equations read ``[[U, W], [W^T, H]]``, H block-diagonal (3 x 3 a point). What
stays is ``S = U - sum_i W_i H_i^-1 W_i^T`` of 5 views + 1 unknowns, however many the points; and back again a step of
the cameras moves point i by ``-H_i^-1 W_i^T step``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semrecon.camera_model import LOCAL, Cameras, sightings_and_derivatives
from semrecon.data import Array, Optics, Tracks
from semrecon.geometry import centred_um
from semrecon.normal_equations import multiply, pseudo_inverses

BLOCK = 512
"""Points at a time: bounds memory, and keeps the working set near the caches."""


@dataclass(frozen=True)
class Reduced:
    """Reduced normal equations of the cameras.

    Parameters
    ----------
    matrix, right
        S and its right-hand side in the order of `Cameras.vector`, (n, n) and (n,).
    depth
        Mean motion of the points along the beam, its sign turned, for a unit of each parameter, (n,): a step at right
        angles to it leaves the depth of the whole where it is.
    """

    matrix: Array
    right: Array
    depth: Array


def reduced_equations(
    tracks: Tracks, weights: Array, xyz_um: Array, cameras: Cameras, optics: Optics, beam: Array
) -> Reduced:
    """Eliminate the points.

    Parameters
    ----------
    tracks
        Positions as measured.
    weights
        Inverse variance of each sighting, 1/um^2, (tracks, views), 0 where it does not count.
    xyz_um
        (tracks, 3), finite where a weight is positive.
    beam
        Unit vector in the world along which the depth of the whole is held, (3,).
    """
    n = LOCAL * len(cameras) + 1
    matrix, right, depth = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for part in blocks(weights):
        coupling, inverses, by_camera, residual = linearised(tracks, weights, xyz_um, cameras, optics, part)
        weighted, g_points = weights[part][..., None, None] * by_camera[0], by_camera[1]
        solved = coupling @ inverses
        _add_cameras(matrix, right, by_camera[0], weighted, residual)
        matrix -= np.tensordot(solved, coupling, axes=([0, 2], [0, 2]))
        right -= np.einsum("ina,ia->n", solved, g_points)
        depth += np.einsum("ina,a->n", solved, beam)
    return Reduced((matrix + matrix.T) / 2, right, depth / max(len(xyz_um), 1))


def blocks(weights: Array) -> Iterator[np.ndarray]:
    """Rows of the points that count, some at a time."""
    used = np.flatnonzero((weights > 0).any(axis=1))
    return (used[i : i + BLOCK] for i in range(0, len(used), BLOCK))


def linearised(
    tracks: Tracks, weights: Array, xyz_um: Array, cameras: Cameras, optics: Optics, part: np.ndarray
) -> tuple[Array, Array, tuple[Array, Array], Array]:
    """W_i (points, n, 3), H_i^-1, (derivatives by the cameras, right-hand sides of the points), residuals in um."""
    w = weights[part]
    seen, by_point, by_camera = sightings_and_derivatives(xyz_um[part], cameras, optics.inverse_working_distance)
    measured = centred_um(tracks.xy_px[part], optics)
    residual = np.where((w > 0)[..., None], measured - seen, 0.0)
    weighted = w[..., None, None] * by_point
    rows = weighted.reshape(len(part), -1, 3)
    inverses, _ = pseudo_inverses(np.swapaxes(rows, 1, 2) @ by_point.reshape(len(part), -1, 3))
    local = np.swapaxes(by_camera, 2, 3) @ weighted
    own = local[:, :, :LOCAL].reshape(len(part), -1, 3)
    coupling = np.concatenate([own, local[:, :, LOCAL:].sum(axis=1)], axis=1)
    g_points = multiply(np.swapaxes(rows, 1, 2), residual.reshape(len(part), -1))
    return coupling, inverses, (by_camera, g_points), residual


def _add_cameras(matrix: Array, right: Array, by_camera: Array, weighted: Array, residual: Array) -> None:
    """Add U and the right-hand side of the cameras: six by six a view, the axis shared by all."""
    for view in range(by_camera.shape[1]):
        index = np.append(np.arange(view * LOCAL, (view + 1) * LOCAL), len(matrix) - 1)
        left = weighted[:, view].reshape(-1, LOCAL + 1)
        matrix[np.ix_(index, index)] += left.T @ by_camera[:, view].reshape(-1, LOCAL + 1)
        right[index] += left.T @ residual[:, view].ravel()
