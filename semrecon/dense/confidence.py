"""What a height is worth: whether it can be trusted, and its standard deviation.

Four parts make the variance. The noise of the images, through the normal equations: a window of standard deviation s
and a prior of strength w on second differences leave ``1 / (H (4 pi s^2 + 8 sqrt(w / H)))``, the second term being the
integral of ``1 / (H + w |k|^4)`` over all frequencies. What the model leaves out: brightness follows the normal, so
that it moves over the surface as the specimen tilts. That bias grows with the length over which the picture changes,
``contrast / slope``, whatever the tilts and the dose, and most where the picture changes slowly: texture is fine,
shading is not. Most of it is gone where heights with shading are trusted. Both grow where the views differ by more than
noise. Then the slope of the surface: brightness on what is steep follows no law that is known here, and what a window
holds lies at many heights. And last, how far a sweep at full size moved the heights: where two ways to find them
disagree, neither is known to be right. How much each part counts was found from simulated series of known surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Mask
from semrecon.dense.parallax import Equations, ParallaxOptions, bending, normal_equations, shared
from semrecon.dense.pictures import Level, noise_variance, pyramid
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.spline import Float, Spline
from semrecon.dense.sweep import WORST, Ladder, matching_costs

FINE = 1 / 64
"""Step to which heights are rounded where the views are compared at them, px."""
GRADIENT_OF_NOISE = 2.0
"""Square of the gradient that a spline through noise of one unit has along one direction, px^-2."""
LEAST_SIGNAL = 0.1
"""What is left of the squared gradient when that of the noise is taken off is at least so large a share of it."""
STEEP_PX = 2.0
"""Standard deviation of the blur of the heights before their slope is taken."""


@dataclass(frozen=True)
class ConfidenceOptions:
    """What is trusted.

    Parameters
    ----------
    least_score
        Correlation of the views in the window round a pixel below which its height is not trusted.
    sure_score
        Correlation from which a height stands even if the sweep from another view does not find it again: on smooth
        slopes shading moves the two apart.
    doubt
        Standard deviation of such a height in parts of what it would be otherwise.
    radius_px
        Half width of that window, in pixels of half the size.
    window_px
        Standard deviation of the window over which the model error is judged.
    noise
        Standard deviation in parts of what the noise of the images alone would bring: windows and prior correlate
        errors and bend the answer.
    length
        Model error in parts of the length over which the picture changes.
    shading
        The same, multiplied by the share of its gradient that is left after a blur of `slow_px`.
    slow_px
        Standard deviation of that blur.
    explained
        Share of the model error that is gone where heights with shading are trusted in full.
    excess
        Power of the misfit of the views, in units of noise, by which the variance grows.
    steep_px
        Standard deviation at slope 1, px; it grows with the square of the slope.
    redrawn
        Standard deviation in parts of how far the sweep at full size moved the heights ...
    redrawn_px
        ... in a window of this standard deviation.
    most_px
        A height whose standard deviation is greater than this is not a measurement, px of parallax ...
    most_share
        ... unless it is less than this share of the longer side of the picture.
    """

    least_score: float = 0.25
    sure_score: float = 0.8
    doubt: float = 1.5
    radius_px: int = 5
    window_px: float = 4.0
    noise: float = 0.931
    length: float = 0.819
    shading: float = 6.05
    slow_px: float = 3.0
    explained: float = 0.8
    excess: float = 2.0
    steep_px: float = 0.345
    redrawn: float = 0.633
    redrawn_px: float = 8.0
    most_px: float = 7.0
    most_share: float = 0.05


@dataclass(frozen=True)
class Confidence:
    """Trust in each height, (rows, columns).

    Parameters
    ----------
    trusted
        Seen, in agreement, and with something to see.
    sure
        The views agree so well that it need not be found again from another view.
    sigma_px
        One standard deviation, px of height.
    """

    trusted: Mask
    sure: Mask
    sigma_px: Array


def confidence(
    pictures: Sequence[Level],
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    by_shading: Float,
    redrawn: Array,
    parallax: ParallaxOptions,
    options: ConfidenceOptions,
) -> Confidence:
    """Judge heights of the full picture (rows, columns), px.

    Parameters
    ----------
    by_shading
        How far each height is one with shading, (rows, columns), 0 to 1.
    redrawn
        How far a sweep at full size moved it, (rows, columns), px.
    """
    equations = normal_equations(splines, lines, heights, noise_variance(0), parallax)
    sigma = standard_deviation(equations, heights, by_shading, redrawn, pictures[lines.reference], parallax, options)
    fastest = float(np.linalg.norm(lines.parallax(), axis=1).max())
    score = agreement(pictures, lines, heights, options.radius_px)
    trusted = score >= options.least_score
    most = max(options.most_px / fastest, options.most_share * max(heights.shape))
    trusted &= (sigma <= most) & (equations.freedom >= 1)
    trusted &= pictures[lines.reference].valid
    return Confidence(trusted, trusted & (score >= options.sure_score), sigma)


def standard_deviation(
    equations: Equations,
    heights: Array,
    by_shading: Float,
    redrawn: Array,
    picture: Level,
    parallax: ParallaxOptions,
    options: ConfidenceOptions,
) -> Array:
    """All four together, (rows, columns), px; infinite where the images say nothing.

    Parameters
    ----------
    by_shading, redrawn
        As for `confidence`.
    picture
        The reference view.
    """
    window = options.window_px
    views = shared(equations.freedom, window).astype(np.float64) + 1
    seen = np.maximum(shared(equations.slope, window).astype(np.float64), 1e-12)
    slope = np.maximum(seen - GRADIENT_OF_NOISE / views, LEAST_SIGNAL * seen)
    information = np.maximum(shared(equations.information, window).astype(np.float64), 1e-12) * slope / seen
    excess = np.maximum(shared(equations.misfit, window) / np.maximum(views - 1, 1e-6), 1.0)
    area = 4 * np.pi * parallax.window_px**2 + 8 / (np.sqrt(information) * bending(heights, parallax))
    changes = shared(equations.contrast, window) / slope
    slow = shared(squared_gradient(shared(picture.values, options.slow_px)), window) / slope
    left_out = np.asarray(options.length**2 + options.shading**2 * slow) * changes
    left_out *= (1 - options.explained * by_shading) ** 2
    variance = excess**options.excess * (options.noise**2 * excess / (information * area) + left_out)
    variance += (options.steep_px * squared_gradient(shared(heights, STEEP_PX))) ** 2
    variance += options.redrawn**2 * shared(redrawn**2, options.redrawn_px)
    return np.asarray(np.where((views > 1) & np.isfinite(variance), np.sqrt(variance), np.inf))


def squared_gradient(picture: NDArray[Any]) -> Array:
    """Square of the gradient by central differences, (rows, columns)."""
    down, across = np.gradient(picture)
    return np.asarray(down**2 + across**2, dtype=np.float64)


def agreement(pictures: Sequence[Level], lines: Sightlines, heights: Array, radius_px: int) -> Array:
    """Correlation of the views round each pixel at its height, (rows, columns), from pictures of half the size."""
    halves = [pyramid(picture, 1)[1] for picture in pictures]
    base = np.rint(heights[::2, ::2] / 2 / FINE).astype(np.int32)
    costs = matching_costs(
        halves, lines.at_level(1), Ladder(base, FINE, 1), radius_px=radius_px, noise=noise_variance(1)
    )
    score = np.repeat(np.repeat(1 - costs[..., 0] / WORST, 2, axis=0), 2, axis=1)
    return np.asarray(score[: heights.shape[0], : heights.shape[1]])
