"""Affine epipolar geometry: what matches alone say of two views under parallel projection.

Whatever the pose and the surface, every match (x, y) - (x', y') obeys one linear equation
(Shapiro, Zisserman, Brady 1995)

    a x + b y + c x' + d y' + e = 0.

(a, b) is across the epipolar lines of the first view, (c, d) across those of the second. For a stage that only tilts,
both are along the tilt axis; a rotation in the plane turns one against the other, a magnification makes them unequal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semrecon.data import Array, Mask
from semrecon.errors import MethodError


@dataclass(frozen=True)
class EpipolarOptions:
    """How the equation is found.

    Parameters
    ----------
    threshold_px
        Greatest residual of an inlier while hypotheses are compared (MSAC), in the noise of one coordinate.
    trials
        Hypotheses of four matches each.
    sigmas
        Greatest residual of an inlier at the end, in standard deviations.
    most_turn_deg, most_magnification
        Greatest rotation in the plane and mismatch of magnification between the views of a hypothesis.
    least
        Fewest inliers.
    least_contrast
        Smallest standard deviation of the parallax, in those of its noise: below, an affine map explains all matches.
    blocks
        The image is cut into so many blocks each way for the jackknife.
    """

    threshold_px: float = 2.0
    trials: int = 1500
    sigmas: float = 3.0
    most_turn_deg: float = 10.0
    most_magnification: float = 0.1
    least: int = 20
    least_contrast: float = 3.0
    blocks: int = 5


@dataclass(frozen=True)
class AffineEpipolar:
    """The equation of two views, and how well it is known.

    Parameters
    ----------
    normal
        Unit vector (a, b, c, d), with (c, d) nearly the opposite of (a, b).
    offset_px
        e.
    inliers
        Matches that obey it, (n,).
    sigma_px
        Noise of one coordinate of a match.
    parallax_px
        Standard deviation of what no affine map explains, along the lines.
    covariance
        Of the unit vector, (4, 4).
    """

    normal: Array
    offset_px: float
    inliers: Mask
    sigma_px: float
    parallax_px: float
    covariance: Array

    @property
    def axes_deg(self) -> Array:
        """Direction across the lines of each view as `tilt_axis_deg` counts (clockwise from up), (2,), mod 180."""
        a, b, c, d = self.normal
        return np.rad2deg([np.arctan2(a, -b), np.arctan2(-c, d)])

    @property
    def axes_covariance_deg2(self) -> Array:
        """Covariance of `axes_deg`, (2, 2), to first order."""
        a, b, c, d = self.normal
        jacobian = np.zeros((2, 4))
        jacobian[0, :2] = np.array([-b, a]) / (a**2 + b**2)
        jacobian[1, 2:] = np.array([-d, c]) / (c**2 + d**2)
        return np.asarray(np.rad2deg(1) ** 2 * jacobian @ self.covariance @ jacobian.T)


def fit_affine_epipolar(
    xy1_px: Array, xy2_px: Array, rng: np.random.Generator, options: EpipolarOptions = EpipolarOptions()
) -> AffineEpipolar:
    """Find the equation that most matches obey: MSAC over samples of four, then total least squares of the inliers.

    Parameters
    ----------
    xy1_px, xy2_px
        Matches, each (n, 2).

    Raises
    ------
    MethodError
        Where too few matches agree, or an affine map explains all of them: every direction would do then.
    """
    joint = np.concatenate([xy1_px, xy2_px], axis=1)
    if len(joint) < options.least:
        raise MethodError(f"{len(joint)} matches are too few for epipolar lines; {options.least} are needed")
    normal, offset = _hypothesis(joint, rng, options)
    inliers = np.abs(joint @ normal + offset) <= options.threshold_px
    for _ in range(20):
        if inliers.sum() < options.least:
            break
        fit = _least_squares(joint, inliers)
        again = np.abs(joint @ fit.normal + fit.offset_px) <= min(options.sigmas * fit.sigma_px, options.threshold_px)
        if (again == inliers).all():
            break
        inliers = again
    if inliers.sum() < options.least:
        raise MethodError(f"only {int(inliers.sum())} of {len(joint)} matches agree on epipolar lines")
    fit = _with_parallax(_least_squares(joint, inliers), options)
    return replace(fit, covariance=np.maximum(1.0, _widening(joint, fit, options.blocks)) * fit.covariance)


def _with_parallax(fit: AffineEpipolar, options: EpipolarOptions) -> AffineEpipolar:
    if fit.parallax_px < options.least_contrast * np.sqrt(2) * fit.sigma_px:
        raise MethodError(
            f"an affine map explains the matches to {fit.sigma_px:.2f} px: there is no parallax that would show the "
            "direction of epipolar lines (a plane has none; neither have views of one tilt)"
        )
    return fit


def _hypothesis(joint: Array, rng: np.random.Generator, options: EpipolarOptions) -> tuple[Array, float]:
    """Compare equations through four matches each by their capped squared residuals; those of no microscope are out."""
    sample = joint[rng.integers(0, len(joint), (options.trials, 4))]
    normals = np.linalg.svd(sample[:, 1:] - sample[:, :1])[2][:, 3]
    offsets = -np.einsum("ti,ti->t", normals, sample[:, 0])
    possible = _possible(normals, options)
    if not possible.any():
        raise MethodError(f"the {len(joint)} matches agree on no epipolar lines that a tilt would give")
    normals, offsets = normals[possible], offsets[possible]
    losses = [
        np.minimum((joint @ normal + offset) ** 2, options.threshold_px**2).sum()
        for normal, offset in zip(normals, offsets, strict=True)
    ]
    best = int(np.argmin(losses))
    return normals[best], float(offsets[best])


def _possible(normals: Array, options: EpipolarOptions) -> Mask:
    """Tell which normals (n, 4) stand for views of nearly one magnification and orientation."""
    first, second = normals[:, :2], -normals[:, 2:]
    product = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    cosine = np.einsum("ni,ni->n", first, second) / np.maximum(product, 1e-12)
    ratio = np.linalg.norm(first, axis=1) / np.maximum(np.linalg.norm(second, axis=1), 1e-12)
    level = np.abs(np.log(np.maximum(ratio, 1e-12))) <= np.log1p(options.most_magnification)
    return np.asarray(level & (cosine >= np.cos(np.deg2rad(options.most_turn_deg))))


def _least_squares(joint: Array, inliers: Mask) -> AffineEpipolar:
    """Fit the plane in four dimensions; its normal is the direction of least variance.

    The covariance is the one of the eigenvectors of a sample covariance (Anderson 1963): along the k-th it is
    l_k l_4 / (n (l_k - l_4)^2).
    """
    used = joint[inliers]
    centre = used.mean(axis=0)
    _, singular, axes = np.linalg.svd(used - centre, full_matrices=False)
    variance = singular**2 / max(len(used) - 4, 1)
    normal, noise = axes[3], max(float(variance[3]), 1e-12)
    gap = np.maximum(variance[:3] - noise, 1e-12)
    spread = variance[:3] * noise / (len(used) * gap**2)
    along = np.abs((used - np.median(used, axis=0)) @ axes[2])  # a few wrong matches far away are no parallax
    parallax = float(np.sqrt(2 * max((1.4826 * np.median(along)) ** 2 - noise, 0.0)))
    covariance = np.asarray((axes[:3].T * spread) @ axes[:3])
    return AffineEpipolar(normal, float(-normal @ centre), inliers, float(np.sqrt(noise)), parallax, covariance)


def _widening(joint: Array, fit: AffineEpipolar, blocks: int) -> float:
    """Factor by which neighbours that err alike widen the covariance, from that of the jackknife."""
    formal = float(np.trace(fit.covariance))
    return float(np.trace(_jackknife(joint, fit, blocks))) / formal if formal > 0 else 1.0


def _jackknife(joint: Array, fit: AffineEpipolar, blocks: int) -> Array:
    """Covariance of the normal (4, 4), by leaving out one block of the image at a time.

    Errors of matches near each other are alike (shading travels with the tilt, scan lines swing together), so that many
    matches are worth fewer; blocks of them are nearly independent (Kuensch 1989).
    """
    place = joint[:, :2]
    low, high = place.min(axis=0), place.max(axis=0)
    cell = np.minimum((blocks * (place - low) / np.maximum(high - low, 1e-9)).astype(int), blocks - 1)
    block = cell[:, 0] * blocks + cell[:, 1]
    used = [b for b in np.unique(block[fit.inliers]) if (fit.inliers & (block != b)).sum() > 8]
    if len(used) < 2:
        return np.zeros((4, 4))
    normals = np.array([_least_squares(joint, fit.inliers & (block != b)).normal for b in used])
    normals *= np.sign(normals @ fit.normal)[:, None]
    away = normals - normals.mean(axis=0)
    return np.asarray((len(used) - 1) / len(used) * away.T @ away)
