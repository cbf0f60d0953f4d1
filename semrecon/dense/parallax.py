"""Sub-pixel heights by Gauss-Newton on all views at once, parallax alone.

What a pixel shows is unknown but common to all views once local brightness and contrast are made alike. With J_v what
view v shows, e_v its motion by height and G the gradient of the picture, a change of height by dz turns J_v into
``J_v + (G . e_v) dz``; the common picture drops out and leaves, over the views that see the pixel::

    H  = sum_v w_v (G . (e_v - e))^2
    b  = - sum_v w_v (G . (e_v - e)) (J_v - J)        e, J: weighted means over the views

G is the mean of the warped views' gradients: that of one noisy view correlates with its own noise, which biases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array
from semrecon.dense.bands import each, in_bands
from semrecon.dense.sightlines import Sightlines, motion
from semrecon.dense.smoothness import edge_weights, solved
from semrecon.dense.spline import Float, Spline, sampled
from semrecon.dense.visibility import visible

CAUCHY = 2.385
SOLVER_STEPS = 25
LOOSE = 4.0
"""The prior is so many times weaker than the measured bending says: detail finer than its reach bends more."""


@dataclass(frozen=True)
class ParallaxOptions:
    """How the heights are refined.

    Parameters
    ----------
    rounds
        Gauss-Newton steps at each size.
    window_px
        Standard deviation of the window over which neighbours share their data.
    likeness_px
        Standard deviation of the window in which brightness and contrast of the views are made alike.
    bend_px
        Prior of the second difference of heights: the least and the greatest standard deviation, px, for images with a
        noise of one unit. In between it is what the surface shows over `bend_reach_px` (`bending`).
    bend_reach_px
        Distance over which the bending of the surface is measured.
    edge
        Second difference from which a bend is taken for an edge, in standard deviations of the prior.
    """

    rounds: int = 6
    window_px: float = 1.0
    likeness_px: float = 8.0
    bend_px: tuple[float, float] = (0.1, 2.0)
    bend_reach_px: int = 6
    edge: float = 1.5


@dataclass(frozen=True)
class Equations:
    """What the images say of each pixel's height, (rows, columns) each.

    Parameters
    ----------
    information, right
        H and b: the images ask for a change of b / H.
    misfit
        Sum of the weighted squared differences from the mean picture.
    freedom
        Sum of the weights less one: views in excess.
    contrast, slope
        Square of the deviation of the mean picture from its surroundings, and of its derivative by parallax, px^-2.
    """

    information: Float
    right: Float
    misfit: Float
    freedom: Float
    contrast: Float
    slope: Float


def refined(
    splines: Sequence[Spline], lines: Sightlines, heights: Array, noise: float, options: ParallaxOptions
) -> Array:
    """Refine heights (rows, columns), px, at one size."""
    for _ in range(options.rounds):
        equations = normal_equations(splines, lines, heights, noise, options)
        information = shared(equations.information, options.window_px).astype(np.float64)
        right = shared(equations.right, options.window_px) + information * heights
        bend = bending(heights, options)
        weights = edge_weights(heights, options.edge * bend) / bend**2
        step = solved(information, right, weights, heights, SOLVER_STEPS) - heights
        heights = heights + within_reach(step, lines)
    return heights


def within_reach(change: Array, lines: Sightlines) -> Array:
    """Bound a change of heights (rows, columns), px: the linearisation holds for part of a pixel."""
    limit = 0.7 / max(float(np.abs(lines.parallax()).max()), 1e-6)
    return np.clip(change, -limit, limit)


def bending(heights: Array, options: ParallaxOptions) -> Array:
    """Read from the heights how far second differences may go: one standard deviation, (rows, columns), px.

    Over a distance s the second difference of a rough surface grows about as ``s**1.5``, while that of noise does not
    grow. So a smooth surface is told from a rough one, and noise is not taken for relief.
    """
    reach, (least, most) = options.bend_reach_px, options.bend_px
    padded = np.pad(heights, reach, mode="reflect", reflect_type="odd")
    inner, low, high = slice(reach, -reach), slice(None, -2 * reach), slice(2 * reach, None)
    across = padded[inner, low] - 2 * heights + padded[inner, high]
    down = padded[low, inner] - 2 * heights + padded[high, inner]
    bent = shared((across**2 + down**2) / 2, float(reach)).astype(np.float64)
    return np.asarray(np.clip(LOOSE * np.sqrt(bent) / reach**1.5, least, most))


def normal_equations(
    splines: Sequence[Spline], lines: Sightlines, heights: Array, noise: float, options: ParallaxOptions
) -> Equations:
    """Compare all views at the present heights.

    Parameters
    ----------
    noise
        Variance of the noise of a pixel.
    """
    values, gradient = drawn(splines, lines, heights)
    alike(values, noise, options.likeness_px)
    out = np.zeros((6, *heights.shape), dtype=np.float32)
    geometry = np.array([lines.of(view) for view in range(len(splines))])
    in_bands(
        len(heights), lambda start, stop: _accumulate(values, gradient, geometry, heights, noise, out, start, stop)
    )
    return Equations(*out)


def drawn(splines: Sequence[Spline], lines: Sightlines, heights: Array) -> tuple[Float, Float]:
    """Draw all views onto the surface; NaN where a view does not see it.

    Returns
    -------
    Values (views, rows, columns), and the mean of their gradients by column and row of the view (2, rows, columns).
    """
    values = np.empty((len(splines), *heights.shape), dtype=np.float32)
    gradients = np.empty((len(splines), 2, *heights.shape), dtype=np.float32)

    def one(view: int) -> None:
        samples = sampled(splines[view], lines, view, heights)
        values[view] = np.where(visible(heights, lines, view), samples.values, np.nan)
        known = np.isfinite(values[view])
        gradients[view] = np.where(known, samples.across, 0), np.where(known, samples.down, 0)

    each(range(len(splines)), one)
    counts = np.isfinite(values).sum(axis=0, dtype=np.float32)
    return values, np.asarray(gradients.sum(axis=0) / np.maximum(counts, 1))


def mean_of(values: Float) -> tuple[Float, Float]:
    """Mean of the views (views, rows, columns) that see a place, 0 where none does, and their number."""
    seen = np.isfinite(values)
    counts = seen.sum(axis=0, dtype=np.float32)
    total = np.where(seen, values, 0).sum(axis=0, dtype=np.float32)
    return np.asarray(total / np.maximum(counts, 1)), np.asarray(counts)


def alike(values: Float, noise: float, sigma_px: float) -> None:
    """Give all views, in place, local mean zero and the local contrast of their mean, (views, rows, columns)."""
    variance = np.empty_like(values)
    seen = np.isfinite(values).all(axis=0)

    def one(view: int) -> None:
        picture = values[view]
        known = np.asarray(seen if seen.any() else np.isfinite(picture), dtype=np.float32)
        own = np.isfinite(picture)
        share = np.maximum(shared(known, sigma_px), 1e-3)
        plain = np.where(own, picture, 0.0).astype(np.float32)
        level = shared(np.where(known > 0, plain, 0), sigma_px) / share
        picture -= level
        variance[view] = shared(np.where(known > 0, np.nan_to_num(picture) ** 2, 0), sigma_px) / share

    each(range(len(values)), one)
    variance = np.maximum(variance - noise, 0.0) + noise
    common = np.asarray(np.sqrt(variance).mean(axis=0))
    values *= common / np.sqrt(variance)


def shared(picture: NDArray[Any], sigma_px: float) -> Float:
    """Blur by a Gaussian window."""
    import cv2

    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT_101))


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _accumulate(
    values: Float,
    gradient: Float,
    geometry: Array,
    heights: Array,
    noise: float,
    out: Float,
    start: int,
    stop: int,
) -> None:
    views, _, columns = values.shape
    ex, ey, weight = np.empty(views), np.empty(views), np.empty(views)
    deviation = np.sqrt(noise)
    for y in range(start, stop):
        for x in range(columns):
            n, centre = 0, 0.0
            for view in range(views):
                weight[view] = 0.0
                if not np.isnan(values[view, y, x]):
                    ex[view], ey[view] = motion(geometry[view], float(x), float(y), heights[y, x])
                    n, centre = n + 1, centre + values[view, y, x]
            if n < 2:
                continue
            centre /= n
            total = mean = mx = my = 0.0
            for view in range(views):
                value = values[view, y, x]
                if np.isnan(value):
                    continue
                ratio = (value - centre) / (CAUCHY * 1.5 * deviation)
                weight[view] = 1 / (1 + ratio * ratio)
                total += weight[view]
                mean += weight[view] * value
                mx += weight[view] * ex[view]
                my += weight[view] * ey[view]
            mean, mx, my = mean / total, mx / total, my / total
            gx, gy = gradient[0, y, x], gradient[1, y, x]
            information = right = misfit = spread = 0.0
            for view in range(views):
                if weight[view] == 0:
                    continue
                slope = gx * (ex[view] - mx) + gy * (ey[view] - my)
                difference = values[view, y, x] - mean
                information += weight[view] * slope * slope
                right -= weight[view] * slope * difference
                misfit += weight[view] * difference * difference
                spread += weight[view] * ((ex[view] - mx) ** 2 + (ey[view] - my) ** 2)
            out[0, y, x], out[1, y, x] = information / noise, right / noise
            out[2, y, x], out[3, y, x] = misfit / noise, n - 1
            out[4, y, x] = mean * mean
            out[5, y, x] = information / max(spread, 1e-12)
