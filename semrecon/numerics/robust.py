"""Robust estimates: what most of the matches agree on, and which of them disagree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri, ndtr

from semrecon.data import Array, Mask


@dataclass(frozen=True)
class OffsetFit:
    """A constant that most of the values share.

    Parameters
    ----------
    offset
        The constant, in the unit of the values.
    inliers
        True where a value agrees within the threshold, (n,).
    score
        MSAC score, between 0 (nothing agrees) and 1 (all agree exactly).
    sigma
        Standard deviation of the inliers; NaN where there are fewer than two.
    """

    offset: float
    inliers: Mask
    score: float
    sigma: float


def fit_offset(values: Array, threshold: float, rng: np.random.Generator, *, trials: int = 500) -> OffsetFit:
    """Find the constant that most values agree on: MSAC (Torr & Zisserman 2000) with one unknown.

    Each hypothesis is one of the values; the loss is the squared residual, capped at the threshold's. The winner is
    refined by the mean of its inliers until they stay the same.

    Parameters
    ----------
    values
        (n,) with n >= 1.
    threshold
        Greatest residual of an inlier, in the unit of the values.
    trials
        Most hypotheses to try; with fewer values each of them is tried.
    """
    hypotheses = values if len(values) <= trials else rng.choice(values, trials, replace=False)
    losses = np.array([_msac_loss(values - hypothesis, threshold) for hypothesis in hypotheses])
    offset = float(hypotheses[np.argmin(losses)])
    for _ in range(20):
        inliers = np.abs(values - offset) <= threshold
        refined = float(values[inliers].mean())
        if refined == offset or _msac_loss(values - refined, threshold) > _msac_loss(values - offset, threshold):
            break
        offset = refined
    inliers = np.abs(values - offset) <= threshold
    sigma = float(values[inliers].std(ddof=1)) if inliers.sum() > 1 else float("nan")
    return OffsetFit(offset, inliers, 1 - _msac_loss(values - offset, threshold) / (len(values) * threshold**2), sigma)


def _msac_loss(residuals: Array, threshold: float) -> float:
    return float(np.minimum(residuals**2, threshold**2).sum())


def consistent_with_neighbours(
    xy_px: Array, disparity_px: Array, *, neighbours: int = 10, tolerance: float = 4.0, floor_px: float = 2.0
) -> Mask:
    """Tell which matches have a disparity like those around them.

    Two views cannot see an error along the epipolar line: it becomes a wrong depth without any residual. A surface
    is mostly continuous, so that a wrong match stands out against its neighbours.

    Parameters
    ----------
    xy_px
        Places in the first view, (n, 2).
    disparity_px
        Offsets along the epipolar line, (n,).
    neighbours
        How many of the nearest matches to ask; with fewer matches than that, none is refused.
    tolerance
        Greatest difference from the neighbours' median, in their standard deviations (1.4826 MAD).
    floor_px
        A difference below this is never refused.

    Returns
    -------
    (n,) True where the match may stay.
    """
    if len(xy_px) <= neighbours:
        return np.ones(len(xy_px), dtype=bool)
    _, nearest = cKDTree(xy_px).query(xy_px, k=neighbours + 1)
    others = disparity_px[nearest[:, 1:]]
    median = np.median(others, axis=1)
    spread = 1.4826 * np.median(np.abs(others - median[:, None]), axis=1)
    return np.asarray(np.abs(disparity_px - median) <= np.maximum(tolerance * spread, floor_px))


LEAST_SIGMA_PX = 1e-6
"""Floor of the noise of a sighting: exact data would make every rounding error an outlier."""
ENOUGH = 30
"""So many points of three views or more tell the noise along the epipolar lines, too."""


@dataclass(frozen=True)
class NoiseFit:
    """Noise of a sighting, and the points that it explains.

    Parameters
    ----------
    sigma_px
        Standard deviation of a sighting per coordinate, of the inliers.
    inliers
        True where the residual of a point is not larger than that noise would make it, (points,).
    """

    sigma_px: float
    inliers: Mask


def fit_noise(residual_px: Array, views: NDArray[np.int64], *, sigmas: float = 3.5) -> NoiseFit:
    """Find the noise of the sightings from what is left after triangulation, and the points beyond it.

    A point seen in V views has 2 V numbers, 3 of which it absorbs, so that V residual^2 / sigma^2 is chi-square with
    2 V - 3 degrees of freedom. The median over the points gives a first sigma that wrong matches do not move. Where
    there are enough points of three views or more, only these are asked: two views show the noise across the epipolar
    lines alone.

    Parameters
    ----------
    residual_px
        Root-mean-square reprojection error of each point, (points,), as `data.PointCloud` has it; NaN is no inlier.
    views
        How many views see it, (points,), each 2 at least.
    sigmas
        What is as unlikely as so many standard deviations of a normal number is an outlier.
    """
    freedom, square = 2 * views - 3, views * residual_px**2
    asked = np.isfinite(square)
    if (asked & (views > 2)).sum() >= ENOUGH:
        asked &= views > 2
    if not asked.any():
        return NoiseFit(float("nan"), np.zeros(len(square), dtype=bool))
    first = max(float(np.median(square[asked] / chdtri(freedom[asked], 0.5))), LEAST_SIGMA_PX**2)
    inliers = np.asarray(square <= first * chdtri(freedom, 2 * ndtr(-sigmas)))
    used = inliers & asked
    return NoiseFit(max(float(np.sqrt(square[used].sum() / freedom[used].sum())), LEAST_SIGMA_PX), inliers)
