"""Normal equations of a bundle adjustment, with the points eliminated exactly (Schur complement).

For cameras c and points X_i the normal equations read ``[[U, W], [W^T, H]]``, H block-diagonal (3 x 3 a point). What
stays is ``S = U - sum_i W_i H_i^-1 W_i^T`` of 5 views + 1 unknowns, however many the points; and back again a step of
the cameras moves point i by ``-H_i^-1 W_i^T step``.

With ``H_i^-1 = L_i L_i^T`` and ``Y_i = W_i L_i`` the sum is ``Y Y^T``, whose right-hand side comes along as further
columns of Y. The loops are those of `schur_kernel`; here they are shared out and their answers put together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.adjustment.camera_model import LOCAL, Cameras, rotation_derivatives
from semrecon.adjustment.schur_kernel import EXTRA, eliminate, reduce_band
from semrecon.data import Array, Optics, Tracks
from semrecon.numerics.point_bands import in_bands

BAND = 1024
"""Points in a band of `reduced_equations`."""
BLOCK = 4096
"""Points at a time in `camera_share`: bounds memory."""


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
    used = np.flatnonzero((weights > 0).any(axis=1))
    given = _given(tracks, weights, xyz_um, cameras, optics, beam, used)
    size = LOCAL * len(cameras) + 1
    matrix, right, lower = np.zeros((size, size)), np.zeros(size), np.zeros((size + EXTRA, size + EXTRA))
    for own, own_right, products in in_bands(lambda first, last: reduce_band(*given, first, last), len(used), BAND):
        _add_cameras(matrix, right, own, own_right)
        lower += products
    eliminated = np.tril(lower[:size, :size])
    matrix -= eliminated + eliminated.T - np.diag(np.diag(eliminated))
    depth = lower[size + 1, :size] / max(len(xyz_um), 1)
    return Reduced((matrix + matrix.T) / 2, right - lower[size, :size], depth)


def camera_share(
    tracks: Tracks, weights: Array, xyz_um: Array, cameras: Cameras, optics: Optics, covariance: Array
) -> Array:
    """Covariance of every point by that of the cameras, ``H^-1 W^T C W H^-1``, um^2, (tracks, 3, 3).

    Takes what `reduced_equations` takes, and the covariance of the cameras (n, n); 0 for a point that does not count.
    """
    share = np.zeros((len(xyz_um), 3, 3))
    used = np.flatnonzero((weights > 0).any(axis=1))
    for part in (used[i : i + BLOCK] for i in range(0, len(used), BLOCK)):
        rows, roots = _rows(_given(tracks, weights, xyz_um, cameras, optics, np.zeros(3), part), len(part))
        spread = (rows @ covariance).reshape(len(part), 3, -1) @ np.swapaxes(rows.reshape(len(part), 3, -1), 1, 2)
        share[part] = roots @ spread @ np.swapaxes(roots, 1, 2)
    return share


def _given(
    tracks: Tracks, weights: Array, xyz_um: Array, cameras: Cameras, optics: Optics, beam: Array, part: np.ndarray
) -> tuple[Any, ...]:
    """Arguments of the kernels, but for those they write."""
    poses, derivatives = cameras.poses, rotation_derivatives(cameras)
    views = (poses.rotations, *derivatives, poses.translations_um, cameras.distortions)
    arrays = (tracks.xy_px[part], weights[part], xyz_um[part], *views, beam, optics.centre_px)
    scales = float(optics.pixel_size_um), float(optics.inverse_working_distance)
    return *(np.ascontiguousarray(a, dtype=np.float64) for a in arrays), *scales


def _rows(given: tuple[Any, ...], points: int) -> tuple[Array, Array]:
    """Y without its further columns, (3 points, n), and L, (points, 3, 3), of all points."""
    views = len(given[3])
    coupling, roots = np.empty((3 * points, LOCAL * views + 1 + EXTRA)), np.empty((points, 3, 3))

    def band(first: int, last: int) -> None:
        own, right = np.zeros((views, LOCAL + 1, LOCAL + 1)), np.zeros((views, LOCAL + 1))
        eliminate(*given, own, right, coupling, roots, first, last)

    in_bands(band, points)
    return coupling[:, :-EXTRA], roots


def _add_cameras(matrix: Array, right: Array, own: Array, own_right: Array) -> None:
    """Add U and the right-hand side of the cameras: six by six a view, the axis shared by all."""
    for view in range(len(own)):
        index = np.append(np.arange(view * LOCAL, (view + 1) * LOCAL), len(matrix) - 1)
        matrix[np.ix_(index, index)] += own[view]
        right[index] += own_right[view]
