"""How well a picture was predicted: correlation and residual in grey levels, over the pixels that have a prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semrecon.agreement.left_out_windows import smoothed
from semrecon.data import Array, Mask

LOCAL_PX = 3.0
"""Gaussian window (1 sigma) of the local correlation: small, so that it speaks of texture, not of light and dark."""
SLOW_SHARE, LEAST_SLOW_PX = 1 / 16, 12.0
"""Gaussian window of gain and offset of grey values, as a share of the longer side of the picture, and at least."""
LEAST_PIXELS = 100
MEDIAN_OF_NORMAL = 0.6745
"""Median absolute deviation of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Prediction:
    """The picture of a view left out, predicted from a surface and from the views used; all on the reference grid.

    Parameters
    ----------
    predicted
        Mean of what the views used see of each pixel of the surface, (rows, columns); NaN where nothing is predicted.
    true
        What the view left out sees there, in its own grey levels, (rows, columns).
    noise_predicted, noise_true
        Variance of the noise in both, (rows, columns).
    """

    predicted: Array
    true: Array
    noise_predicted: Array
    noise_true: Array

    @property
    def known(self) -> Mask:
        """Where there is a prediction to judge, (rows, columns)."""
        return np.asarray(np.isfinite(self.predicted) & np.isfinite(self.true))


@dataclass(frozen=True)
class Score:
    """Likeness of a predicted and a true picture. Grey levels are those of the true one; NaN where nothing is known.

    Parameters
    ----------
    share
        Part of the reference grid that was judged.
    ncc
        Correlation over all judged pixels, the light and dark of large forms included.
    local_ncc
        Correlation within a Gaussian window of 3 px, median over the judged pixels.
    rms_grey, median_grey
        Residual after slow gain and offset: root mean square, and median of its absolute value.
    noise_grey
        Root mean square that the noise of all pictures explains.
    rms_beyond_grey, median_beyond_grey
        Residuals with that noise taken off in squares; 0 where noise explains all.
    contrast_grey
        Root mean square residual of who predicts the slow brightness alone: the scale for `rms_grey`.
    """

    share: float
    ncc: float
    local_ncc: float
    rms_grey: float
    median_grey: float
    noise_grey: float
    rms_beyond_grey: float
    median_beyond_grey: float
    contrast_grey: float


def score(prediction: Prediction, among: Mask | None = None) -> Score:
    """Judge a prediction where it is known, or among pixels given of these, (rows, columns)."""
    known = prediction.known if among is None else prediction.known & among
    share = float(known.mean())
    if known.sum() < LEAST_PIXELS:
        return Score(share, *[np.nan] * 8)
    true, predicted = prediction.true, prediction.predicted
    local = local_correlation(predicted, true, known)[known]
    residual, gain, contrast = slow_residual(predicted, true, known)
    noise = prediction.noise_true[known] + gain[known] ** 2 * prediction.noise_predicted[known]
    noise_square, rms = float(noise.mean()), float(np.sqrt(np.mean(residual[known] ** 2)))
    median = float(np.median(np.abs(residual[known])))
    return Score(
        share=share,
        ncc=float(np.corrcoef(predicted[known], true[known])[0, 1]),
        local_ncc=float(np.median(local)),
        rms_grey=rms,
        median_grey=median,
        noise_grey=float(np.sqrt(noise_square)),
        rms_beyond_grey=float(np.sqrt(max(rms**2 - noise_square, 0.0))),
        median_beyond_grey=float(np.sqrt(max(median**2 - MEDIAN_OF_NORMAL**2 * noise_square, 0.0))),
        contrast_grey=float(np.sqrt(np.mean(contrast[known] ** 2))),
    )


def commonly_known(predictions: Sequence[Prediction]) -> Mask:
    """Pixels that all predictions of one view have, (rows, columns)."""
    return np.asarray(np.logical_and.reduce([one.known for one in predictions]))


def local_correlation(a: Array, b: Array, known: Mask) -> Array:
    """Correlation of two pictures in a Gaussian window about each pixel, (rows, columns); 0 where either is even."""
    a, b = (np.where(known, one - np.mean(one[known]), 0.0) for one in (a, b))
    mean_a, mean_b = (smoothed(one, known, LOCAL_PX) for one in (a, b))
    both = smoothed(a * b, known, LOCAL_PX) - mean_a * mean_b
    spread = _variance(a, mean_a, known, LOCAL_PX) * _variance(b, mean_b, known, LOCAL_PX)
    floor = 1e-9 * float(a[known].var() * b[known].var())
    return np.where(known & (spread > floor), both / np.sqrt(np.maximum(spread, max(floor, 1e-300))), 0.0)


def slow_residual(predicted: Array, true: Array, known: Mask) -> tuple[Array, Array, Array]:
    """Take the best slow gain (not negative) and offset of a prediction off the truth.

    Returns
    -------
    Residual, gain and the residual of the slow brightness alone, (rows, columns) each.
    """
    window = slow_window_px(known.shape)
    p, t = (np.where(known, one - np.mean(one[known]), 0.0) for one in (predicted, true))
    mean_p, mean_t = (smoothed(one, known, window) for one in (p, t))
    both = smoothed(p * t, known, window) - mean_p * mean_t
    variance = _variance(p, mean_p, known, window)
    gain = np.maximum(both, 0.0) / np.maximum(variance, 1e-9 * max(float(p[known].var()), 1e-300))
    contrast = t - mean_t
    return contrast - gain * (p - mean_p), gain, contrast


def slow_window_px(shape: tuple[int, ...]) -> float:
    """Window of slow gain and offset for a picture of (rows, columns)."""
    return max(LEAST_SLOW_PX, SLOW_SHARE * max(shape))


def _variance(values: Array, mean: Array, known: Mask, window: float) -> Array:
    return np.maximum(smoothed(values**2, known, window) - mean**2, 0.0)
