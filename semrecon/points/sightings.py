"""Wrong sightings of good tracks: leave out the one that disagrees, and keep the point.

A track of V sightings has 2 V numbers, three of which its point absorbs. When the rest is more than the noise explains,
one sighting may be to blame; it is, if the others agree without it and would not agree without any other. Where two
answers are possible (along the epipolar lines three views never say which of them is wrong) nothing is decided, and the
track is left to be dropped as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtr

from semrecon.data import Array, Mask, Optics, Poses, Tracks
from semrecon.numerics.robust import NoiseFit, fit_noise
from semrecon.points.triangulation import triangulate

PASSES = 3
"""Most sightings left out of one track."""
DOUBT = 2.0
"""Without another sighting the rest must be this many times as unlikely, in standard deviations, to rule it out."""


def without_wrong_sightings(tracks: Tracks, poses: Poses, optics: Optics, *, sigmas: float = 3.5) -> Tracks:
    """Take out single sightings that the rest of their tracks speaks against.

    Parameters
    ----------
    tracks
        Sightings, NaN where missing.
    poses
        One for each view, known well beside the noise.
    sigmas
        What is as unlikely as so many standard deviations is wrong.

    Returns
    -------
    Tracks of the same shape with further sightings missing; a track that no single sighting explains is untouched.
    """
    residual, views = _residual_px(tracks, poses, optics), tracks.seen.sum(axis=1)
    noise = fit_noise(residual, np.maximum(views, 2), sigmas=sigmas)
    if not np.isfinite(noise.sigma_px):
        return tracks
    found = tracks.xy_px.copy()
    suspect = np.flatnonzero(~noise.inliers & (views >= 3))
    repaired = _repaired(tracks.xy_px[suspect], poses, optics, noise, sigmas)
    found[suspect] = repaired
    return Tracks(found)


def _repaired(xy_px: Array, poses: Poses, optics: Optics, noise: NoiseFit, sigmas: float) -> Array:
    """Leave out one sighting a pass; a track is settled once the rest agrees, and given back whole if it never does."""
    current, settled = xy_px.copy(), np.zeros(len(xy_px), dtype=bool)
    for _ in range(PASSES):
        views = Tracks(current).seen.sum(axis=1)
        asked = np.flatnonzero(~settled & (views >= 3))
        if not len(asked):
            break
        square, limit, doubt = _without_each(current[asked], poses, optics, noise.sigma_px, sigmas)
        best = np.argmin(square, axis=1)
        rows = np.arange(len(asked))
        agrees = square[rows, best] <= limit
        others = square.copy()
        others[rows, best] = np.inf
        alone = others.min(axis=1) > doubt
        goes_on = ~agrees & (views[asked] >= 5)
        taken = (agrees & alone) | goes_on
        current[asked[taken], best[taken]] = np.nan
        settled[asked] |= ~goes_on
        current[asked[~taken]] = xy_px[asked[~taken]]
    agreeing = _agree(current, poses, optics, noise.sigma_px, sigmas)
    return np.where(agreeing[:, None, None], current, xy_px)


def _without_each(
    xy_px: Array, poses: Poses, optics: Optics, sigma_px: float, sigmas: float
) -> tuple[Array, Array, Array]:
    """Chi-square of every track without each of its views (tracks, views), with the limits for it (tracks,).

    Infinite where there is no sighting to leave out, or no point without it. The second limit is the one that another
    explanation has to exceed.
    """
    seen = Tracks(xy_px).seen
    views = seen.sum(axis=1) - 1
    square = np.full(seen.shape, np.inf)
    for view in range(seen.shape[1]):
        rows = np.flatnonzero(seen[:, view])
        left = xy_px[rows].copy()
        left[:, view] = np.nan
        residual = _residual_px(Tracks(left), poses, optics)
        square[rows, view] = np.where(np.isfinite(residual), views[rows] * (residual / sigma_px) ** 2, np.inf)
    return square, _limit(views, sigmas), _limit(views, DOUBT * sigmas)


def _agree(xy_px: Array, poses: Poses, optics: Optics, sigma_px: float, sigmas: float) -> Mask:
    views = Tracks(xy_px).seen.sum(axis=1)
    square = views * (_residual_px(Tracks(xy_px), poses, optics) / sigma_px) ** 2
    return np.asarray(square <= _limit(views, sigmas))


def _limit(views: NDArray[np.int64], sigmas: float) -> Array:
    """Chi-square that a point of so many views exceeds as rarely as a normal number so many deviations."""
    return np.asarray(chdtri(np.maximum(2 * views - 3, 1), 2 * ndtr(-sigmas)))


def _residual_px(tracks: Tracks, poses: Poses, optics: Optics) -> Array:
    return triangulate(tracks, poses, optics).residual_px
