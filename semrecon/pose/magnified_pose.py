"""Pose of a view from points, with its noise and its magnification found from the sightings themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semrecon.data import Array, Mask, Optics
from semrecon.errors import MethodError
from semrecon.numerics.robust import LEAST_SIGMA_PX
from semrecon.pose.resection import ransac_pose
from semrecon.pose.view_pose import OrthographicPose, Sightings, orthographic_pose

THRESHOLD_PX = 3.0
"""Of the first search, when the noise is not yet known: what its points' noise does not explain."""
REJECT_SIGMAS = 3.5
ROUNDS, STEPS = 5, 4
SURE_SIGMAS, LEAST_MISMATCH = 4.0, 2e-3
"""A magnification is put right where it differs from 1 by so many sigmas and by so much."""
FAR = 0.02
"""Sizes of features that differ by more are a second start."""


@dataclass(frozen=True)
class MagnifiedPose:
    """A pose, the grid that it goes with, and the sightings (points,) that support it.

    `magnification` is what the sightings say, against the stated pixel size, with its standard deviation; `optics` has
    it put right only where it differs from 1 for sure.
    """

    pose: OrthographicPose
    optics: Optics
    inliers: Mask
    magnification: float
    magnification_sigma: float
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Fit:
    pose: OrthographicPose
    optics: Optics
    inliers: Mask
    log_step: float
    log_sigma: float


def fit_pose(
    xyz_um: Array,
    xy_px: Array,
    covariance_um2: Array,
    optics: Optics,
    size_ratio: float,
    rng: np.random.Generator,
    trials: int = 400,
) -> MagnifiedPose:
    """Fit pose, noise and magnification to sightings, some of which are wrong.

    Parameters
    ----------
    xyz_um, xy_px, covariance_um2
        Points (n, 3), sightings (n, 2) and the points' covariances (n, 3, 3); unknown ones (NaN) count as exact.
    optics
        As stated.
    size_ratio
        How much larger features are in this view than where they were seen before: a second start, if far from 1.

    Raises
    ------
    MethodError
        No pose has four sightings that agree, or the points lie on one line.
    """
    known = np.isfinite(covariance_um2).all()
    given = Sightings(xyz_um, xy_px, optics, covariance_um2 if known else None)
    starts = [optics]
    if abs(np.log(size_ratio)) > FAR:
        starts.append(replace(optics, pixel_size_um=optics.pixel_size_um / size_ratio))
    fits = [fit for start in starts if (fit := _started(replace(given, optics=start), rng, trials)) is not None]
    if not fits:
        raise MethodError(
            f"no four of {len(xyz_um)} sightings agree on a pose; is this the same place of the specimen?"
        )
    free = _freed(given, max(fits, key=lambda fit: int(fit.inliers.sum())))
    log = float(np.log(optics.pixel_size_um / free.optics.pixel_size_um)) + free.log_step
    sure = abs(log) > max(SURE_SIGMAS * free.log_sigma, LEAST_MISMATCH)
    final = free if sure else _settled(given, optics, free.inliers, free.pose.sigma_px)
    magnification = float(np.exp(log))
    sigma = magnification * free.log_sigma
    return MagnifiedPose(
        final.pose, final.optics, final.inliers, magnification, sigma, _warnings(final, len(xyz_um), log, sigma, sure)
    )


def _started(given: Sightings, rng: np.random.Generator, trials: int) -> _Fit | None:
    """Search over all orientations; None where nothing agrees."""
    try:
        found = ransac_pose(
            given.xyz_um,
            given.xy_px,
            given.optics,
            rng,
            THRESHOLD_PX,
            sigma_px=1.0,
            covariance_um2=given.covariance_um2,
            trials=trials,
        )
        return _settled(given, given.optics, found.inliers, 1.0)
    except MethodError:
        return None


def _freed(given: Sightings, fit: _Fit) -> _Fit:
    """Let the magnification follow the sightings until it stays: as the pose, a few steps do."""
    for _ in range(STEPS):
        if abs(fit.log_step) <= 0.1 * fit.log_sigma:
            break
        optics = replace(fit.optics, pixel_size_um=fit.optics.pixel_size_um / float(np.exp(fit.log_step)))
        fit = _settled(given, optics, fit.inliers, fit.pose.sigma_px)
    return fit


def _settled(given: Sightings, optics: Optics, inliers: Mask, sigma_px: float) -> _Fit:
    """Refine the pose and the noise on the sightings that agree, until these stay the same."""
    for _ in range(ROUNDS):
        kept = replace(given, optics=optics, sigma_px=sigma_px).keep(inliers)
        covariance = kept.covariance_um2
        pose = orthographic_pose(kept.xyz_um, kept.xy_px, optics, sigma_px=sigma_px, covariance_um2=covariance)
        length = replace(given, optics=optics, sigma_px=sigma_px).distances_px(pose.rotation, pose.translation_um)
        freedom = max(2 * int(inliers.sum()) - 5, 1)
        previous, before = inliers, sigma_px
        sigma_px = max(float(np.sqrt((length[inliers] ** 2).sum() / freedom)), LEAST_SIGMA_PX)
        inliers = length <= REJECT_SIGMAS * sigma_px
        if inliers.sum() < 4:
            raise MethodError(f"no four of {len(given)} sightings agree on a pose")
        if (inliers == previous).all() and abs(sigma_px / before - 1) < 1e-2:
            break
    everywhere = replace(given, optics=optics, sigma_px=sigma_px)
    seen = np.where(inliers[:, None], given.xy_px, np.nan)
    pose = orthographic_pose(given.xyz_um, seen, optics, sigma_px=sigma_px, covariance_um2=given.covariance_um2)
    return _Fit(pose, optics, inliers, *_magnification_step(everywhere.keep(inliers), pose))


def _magnification_step(given: Sightings, pose: OrthographicPose) -> tuple[float, float]:
    """Gauss-Newton step of the log magnification with the pose free beside it, and its standard deviation."""
    points = given.corrected_um(pose.rotation, pose.translation_um)
    x, y, z = (points @ pose.rotation.T).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    column = np.stack([x + pose.translation_um[0], y + pose.translation_um[1]])
    moves = np.stack([[zero, z, -y, one, zero, column[0]], [-z, zero, x, zero, one, column[1]]])
    image = moves.transpose(2, 0, 1) / given.optics.pixel_size_um
    design = given.whitened(image, pose.rotation).reshape(-1, 6)
    residual = given.residuals_px(pose.rotation, pose.translation_um)[..., None]
    right = given.whitened(residual, pose.rotation).reshape(-1)
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv((design / size).T @ (design / size), hermitian=True)
    step = inverse @ ((design / size).T @ right) / size
    return float(step[5]), float(given.sigma_px * np.sqrt(inverse[5, 5]) / size[5])


def _warnings(fit: _Fit, sightings: int, log: float, sigma: float, sure: bool) -> tuple[str, ...]:
    """Say what a user should doubt."""
    said = []
    if sure:
        said.append(
            f"its magnification is {np.expm1(log):+.2%} (sigma {sigma:.2%}) off that of the stated pixel size; the "
            f"pose was found with {fit.optics.pixel_size_um:.6g} um a pixel"
        )
    if fit.pose.alternative is not None:
        said.append("its points lie so nearly on a plane that a second orientation fits them alike")
    if not np.isfinite(fit.pose.covariance).all():
        said.append("it sees a plane face-on, so that its slope is undetermined and without covariance")
    if fit.inliers.sum() < sightings / 2:
        said.append(f"only {int(fit.inliers.sum())} of {sightings} sightings agree on its pose")
    return tuple(said)
