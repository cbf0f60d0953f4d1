"""Pose of one view from points that are known, under the projection and the noise that the data have.

`onp` finds the orientation from scratch; this file refines it: perspective where there is any, the noise of the points,
the covariance of the answer, and the second answer where the sightings allow two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Mask, Optics
from semrecon.errors import InputError
from semrecon.geometry import centred_um, project
from semrecon.numerics.motion import rotation_angle_rad
from semrecon.numerics.robust import LEAST_SIGMA_PX
from semrecon.pose.onp import find_minima, moments

AMBIGUOUS = 9.0
"""An orientation is as good as another if its sum of squares is larger by less than this many variances (3 sigma)."""
DISTINCT_RAD = 1e-3
STEPS = 40
SETTLED = 1e-12
FREEDOM = 3
"""Fewest residuals beyond the five that the pose absorbs from which the noise, and with it a covariance, is told."""
SINGULAR = 1e-7
"""Least singular value over the largest below which a parameter is not determined."""


@dataclass(frozen=True)
class OrthographicPose:
    """Where the specimen stood in one view: ``X_cam = rotation @ X_world + translation``.

    Parameters
    ----------
    rotation
        R_cam_from_world, (3, 3).
    translation_um
        (3,), with t_z = 0: under parallel projection it cannot be observed, and under perspective it is held, because
        the pixel size is that of the plane through the world origin.
    residual_px
        Distance of each sighting from the projected point, (points,); NaN where either is missing.
    sigma_px
        Standard deviation of a sighting per coordinate: the one stated, or else the one that the residuals tell.
    covariance
        Of a turn (rad) about the camera's x, y and z axes, ``exp(w) R``, and of t_x, t_y (um), (5, 5); NaN if the
        points leave one of the five undetermined, as a plane seen face-on does its slope.
    proven
        True where the orientation is certain to be the best of all (see `onp`), before refinement.
    alternative
        A different orientation that the sightings cannot tell from this one, as for points on a plane; None if none.
    """

    rotation: Array
    translation_um: Array
    residual_px: Array
    sigma_px: float
    covariance: Array
    proven: bool
    alternative: OrthographicPose | None = None


@dataclass(frozen=True)
class Sightings:
    """Points (n, 3) in um, where a view sees them (n, 2) in px, and the noise of both.

    Parameters
    ----------
    covariance_um2
        Of each point, (n, 3, 3), or None: the points are exact.
    sigma_px
        Of the sightings, per coordinate; without covariances it sets no more than the unit.
    """

    xyz_um: Array
    xy_px: Array
    optics: Optics
    covariance_um2: Array | None = None
    sigma_px: float = 1.0

    def __len__(self) -> int:
        return len(self.xyz_um)

    def keep(self, mask: NDArray[Any]) -> Sightings:
        """Select by a boolean mask or an index array."""
        covariance = None if self.covariance_um2 is None else self.covariance_um2[mask]
        return replace(self, xyz_um=self.xyz_um[mask], xy_px=self.xy_px[mask], covariance_um2=covariance)

    @property
    def complete(self) -> Mask:
        """True where nothing is missing, (n,)."""
        finite = np.isfinite(self.xyz_um).all(axis=1) & np.isfinite(self.xy_px).all(axis=1)
        if self.covariance_um2 is not None:
            finite &= np.isfinite(self.covariance_um2).all(axis=(1, 2))
        return np.asarray(finite)

    def residuals_px(self, rotation: Array, translation_um: Array) -> Array:
        """Sighting minus projection, (n, 2)."""
        return self.xy_px - project(self.xyz_um, rotation, translation_um, self.optics)

    def distances_px(self, rotation: Array, translation_um: Array) -> Array:
        """Length of the residuals after the noise of the points is allowed for, (n,): plain length if there is none."""
        residual = self.residuals_px(rotation, translation_um)
        if self.covariance_um2 is None:
            return np.asarray(np.hypot(residual[:, 0], residual[:, 1]))
        return np.asarray(np.linalg.norm(self.whitened(residual[..., None], rotation)[..., 0], axis=1))

    def whitened(self, values: Array, rotation: Array) -> Array:
        """Apply the inverse root of each residual's covariance, in units of sigma_px, to values (n, 2, columns)."""
        if self.covariance_um2 is None:
            return values
        return np.linalg.solve(np.linalg.cholesky(self._spread(rotation)), values)

    def corrected_um(self, rotation: Array, translation_um: Array) -> Array:
        """Points moved to where they most likely are, given the sightings, (n, 3)."""
        if self.covariance_um2 is None:
            return self.xyz_um
        residual = self.residuals_px(rotation, translation_um)
        pull = np.linalg.solve(self._spread(rotation), residual[..., None])
        gain = self.covariance_um2 @ rotation[:2].T / (self.optics.pixel_size_um * self.sigma_px**2)
        return np.asarray(self.xyz_um + (gain @ pull)[..., 0])

    def _spread(self, rotation: Array) -> Array:
        """Covariance of each residual in units of sigma_px squared, (n, 2, 2); perspective would change it by k z."""
        assert self.covariance_um2 is not None
        seen = rotation[:2] @ self.covariance_um2 @ rotation[:2].T
        return np.asarray(np.eye(2) + seen / (self.optics.pixel_size_um * self.sigma_px) ** 2)


def orthographic_pose(
    xyz_um: Array,
    xy_px: Array,
    optics: Optics,
    *,
    sigma_px: float | None = None,
    covariance_um2: Array | None = None,
) -> OrthographicPose:
    """Find the pose that brings known points closest to their sightings, of all orientations there are.

    Parameters
    ----------
    xyz_um, xy_px
        (points, 3) in the world and (points, 2) in the view; rows with NaN are left out.
    optics
        Its pixel size is the known scale; k != 0 is taken into account by refinement.
    sigma_px
        Standard deviation of a sighting per coordinate; None takes it from the residuals.
    covariance_um2
        Noise of the points, (points, 3, 3); needs `sigma_px`. It weights each sighting by what its point is worth
        along either direction, and moves the points within their noise, so that a noisy relief is not taken as flat.

    Raises
    ------
    InputError
        Shapes do not fit, or a standard deviation is missing or not positive.
    MethodError
        Fewer than three complete points, or all of them on one line.

    Notes
    -----
    Steger (2018) for the problem and its two-fold ambiguity on planes; the search is in `onp`. With noisy points the
    cost is ``sum r^T (sigma^2 I + A Cov A^T / pixel^2)^-1 r``, that of a bundle adjustment in which points and this
    pose are free.
    """
    given = checked(xyz_um, xy_px, optics, sigma_px, covariance_um2)
    complete = given.complete
    kept = given.keep(complete)
    found = find_minima(moments(kept.xyz_um, centred_um(kept.xy_px, optics), _weights(kept)))
    best = _refined(found.rotations[0], kept)
    sigma = sigma_px or _noise(kept, *best)
    other = _alternative(found.rotations[1:], best, kept, sigma)
    pose = _pose(*best, given, complete, sigma, found.proven, sigma_px is not None)
    return (
        pose
        if other is None
        else replace(pose, alternative=_pose(*other, given, complete, sigma, False, sigma_px is not None))
    )


def checked(
    xyz_um: Array, xy_px: Array, optics: Optics, sigma_px: float | None, covariance_um2: Array | None
) -> Sightings:
    """Put points and sightings together, or say in a sentence why they do not belong together (`InputError`)."""
    n = len(xyz_um)
    if xyz_um.shape != (n, 3) or xy_px.shape != (n, 2):
        raise InputError(f"a pose needs points (n, 3) and sightings (n, 2), not {xyz_um.shape} and {xy_px.shape}")
    if covariance_um2 is not None and covariance_um2.shape != (n, 3, 3):
        raise InputError(f"the covariances of {n} points must be of shape {(n, 3, 3)}, not {covariance_um2.shape}")
    if covariance_um2 is not None and sigma_px is None:
        raise InputError("points with covariances need sigma_px, the noise of a sighting, to be weighed against it")
    if sigma_px is not None and not (np.isfinite(sigma_px) and sigma_px > 0):
        raise InputError(f"sigma_px must be a positive number of pixels, not {sigma_px}")
    return Sightings(xyz_um, xy_px, optics, covariance_um2, sigma_px or 1.0)


def _weights(given: Sightings) -> Array | None:
    """Weight of each sighting before the orientation is known: the mean variance of its point over all directions."""
    if given.covariance_um2 is None:
        return None
    variance = np.trace(given.covariance_um2, axis1=1, axis2=2) / 3
    return np.asarray(1 / (1 + variance / (given.optics.pixel_size_um * given.sigma_px) ** 2))


def _refined(rotation: Array, given: Sightings) -> tuple[Array, Array]:
    """Rotation and translation of least cost near a rotation: Gauss-Newton, damped, with the points corrected."""
    shift = given.xyz_um @ rotation[:2].T
    weights = _weights(given)
    t = np.append(np.average(centred_um(given.xy_px, given.optics) - shift, axis=0, weights=weights), 0.0)
    if given.covariance_um2 is None and not given.optics.inverse_working_distance:
        return rotation, t
    cost, damping = _cost(rotation, t, given), 1e-6
    for _ in range(STEPS):
        step = _step(rotation, t, given, damping)
        turned, moved = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, t + np.append(step[3:], 0.0)
        lower = _cost(turned, moved, given)
        if better := lower <= cost:
            rotation, t, cost = turned, moved, lower
        damping = max(damping / 30, 1e-15) if better else damping * 30
        if np.abs(step[:3]).max() <= SETTLED:
            break
    return rotation, t


def _cost(rotation: Array, translation_um: Array, given: Sightings) -> float:
    return float((given.distances_px(rotation, translation_um) ** 2).sum())


def _step(rotation: Array, translation_um: Array, given: Sightings, damping: float) -> Array:
    """Turn (rad) and shift (um), (5,): Levenberg's step, scaled so that all columns weigh the same."""
    jacobian = _jacobian(rotation, translation_um, given)
    residual = given.whitened(given.residuals_px(rotation, translation_um)[..., None], rotation).reshape(-1)
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1.0
    scaled = jacobian / size
    return np.asarray(np.linalg.solve(scaled.T @ scaled + damping * np.eye(5), scaled.T @ residual) / size)


def _jacobian(rotation: Array, translation_um: Array, given: Sightings) -> Array:
    """Differentiate the whitened projections by (turn, t_x, t_y), (2 n, 5), at the corrected points."""
    turned = given.corrected_um(rotation, translation_um) @ rotation.T
    cam, k = turned + translation_um, given.optics.inverse_working_distance
    zero, one = np.zeros(len(cam)), np.ones(len(cam))
    x, y, z = turned.T
    moves = np.stack([[zero, z, -y, one, zero], [-z, zero, x, zero, one], [y, -x, zero, zero, zero]])
    scale = 1 + k * cam[:, 2]
    image = (moves[:2] - k * cam[:, :2].T[:, None] * moves[2] / scale) / (scale * given.optics.pixel_size_um)
    return given.whitened(image.transpose(2, 0, 1), rotation).reshape(-1, 5)


def _noise(given: Sightings, rotation: Array, translation_um: Array) -> float:
    """Estimate the noise per coordinate from the residuals: 2 n numbers, five of which the pose absorbs."""
    return float(max(np.sqrt(_cost(rotation, translation_um, given) / (2 * len(given) - 5)), LEAST_SIGMA_PX))


def _alternative(
    rotations: Array, best: tuple[Array, Array], given: Sightings, sigma_px: float
) -> tuple[Array, Array] | None:
    """Find the best of the other minima, if it is another orientation and not clearly worse."""
    others = [one for one in rotations if rotation_angle_rad(one @ best[0].T) > DISTINCT_RAD]
    if not others:
        return None
    other = _refined(others[0], given)
    same = rotation_angle_rad(other[0] @ best[0].T) <= DISTINCT_RAD
    worse = _cost(*other, given) - _cost(*best, given)
    return None if same or worse > AMBIGUOUS * sigma_px**2 else other


def _pose(
    rotation: Array, translation_um: Array, given: Sightings, complete: Mask, sigma_px: float, proven: bool, known: bool
) -> OrthographicPose:
    length = np.linalg.norm(given.residuals_px(rotation, translation_um), axis=1)
    residual = np.where(complete, length, np.nan)
    jacobian = _jacobian(rotation, translation_um, given.keep(complete))
    covariance = sigma_px**2 * _inverse(jacobian) if known or len(jacobian) - 5 >= FREEDOM else np.full((5, 5), np.nan)
    return OrthographicPose(rotation, translation_um, residual, sigma_px, covariance, proven)


def _inverse(jacobian: Array) -> Array:
    """``(J^T J)^-1``, (5, 5), NaN if a parameter has no weight beside the others (lengths in units of the scene)."""
    size = np.linalg.norm(jacobian, axis=0)
    size[:3], size[3:] = size[:3].max(), size[3:].max()
    _, values, vt = np.linalg.svd(jacobian / size, full_matrices=False)
    if values[-1] <= SINGULAR * values[0]:
        return np.full((5, 5), np.nan)
    return np.asarray((vt.T / values**2) @ vt / np.outer(size, size))
