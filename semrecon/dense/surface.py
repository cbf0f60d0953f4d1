"""From coarse to fine: a wide sweep at a small size, narrow ones about it at larger sizes, then parallax."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.dense.aggregation import aggregated, best_rung
from semrecon.dense.parallax import ParallaxOptions, refined
from semrecon.dense.pictures import Level, noise_variance, pyramid
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.spline import spline_of
from semrecon.dense.sweep import Ladder, matching_costs

MOST_RUNGS = 320
WIDER = 3
"""How often a ladder is lengthened because pixels choose its ends."""
AT_END = 0.01
"""Share of the pixels at the ends of the ladder from which it is lengthened ..."""
TALLEST = 0.6
"""... but not to heights beyond so many times the longer side of the picture."""


@dataclass(frozen=True)
class SweepOptions:
    """How heights are first found.

    Parameters
    ----------
    sweep_pixels
        The wide sweep is made at the largest size that has at most so many pixels.
    step_px
        Parallax between neighbouring rungs in the view that moves most, px.
    radius_px
        Half width of the window of comparison.
    small, large
        Price of a change of height by one step and by more, where 255 is the cost of no likeness at all.
    reach_px
        Parallax of the narrow sweeps on either side, px.
    """

    sweep_pixels: int = 300_000
    step_px: float = 0.5
    radius_px: int = 3
    small: int = 12
    large: int = 90
    reach_px: float = 3.0


def coarsest_level(pixels: int, options: SweepOptions) -> int:
    """How often a picture is halved for the wide sweep."""
    return max(0, math.ceil(math.log(max(pixels / options.sweep_pixels, 1.0), 4.0)))


def step_height(lines: Sightlines, options: SweepOptions) -> float:
    """Height between rungs, px: that of `step_px` of parallax in the view that moves most."""
    fastest = float(np.linalg.norm(lines.parallax(), axis=1).max())
    return options.step_px / max(fastest, 1e-9)


def wide_sweep(
    levels: Sequence[Level],
    lines: Sightlines,
    span_px: tuple[float, float],
    noise: float,
    options: SweepOptions,
    plane: Array | None = None,
) -> Array:
    """Find heights (rows, columns), px, between the two of `span_px`, or beyond where pixels ask for it.

    Parameters
    ----------
    plane
        Heights from which the span counts, (rows, columns), px; 0 by default.
    """
    # a span too long for the ladder is searched in coarser steps, never cut off
    step = max(step_height(lines, options), (span_px[1] - span_px[0]) / (MOST_RUNGS - 2))
    ground = np.zeros(levels[0].values.shape, np.int32) if plane is None else np.rint(plane / step).astype(np.int32)
    low, high = math.floor(span_px[0] / step), math.ceil(span_px[1] / step)
    for attempt in range(WIDER + 1):
        rungs = min(max(high - low + 1, 8), MOST_RUNGS)
        ladder = Ladder(ground + np.int32(low), step, rungs)
        heights, at_end, sure = _swept(levels, lines, ladder, noise, options)
        more_low, more_high = (float((at_end == end)[sure].mean()) if sure.any() else 0.0 for end in (-1, 1))
        if attempt == WIDER or rungs == MOST_RUNGS or max(more_low, more_high) < AT_END:
            break
        tallest = math.ceil(TALLEST * max(ground.shape) / step)
        low = max(low - rungs // 2, min(low, -tallest)) if more_low >= AT_END else low
        high = min(high + rungs // 2, max(high, tallest)) if more_high >= AT_END else high
    return heights


def narrow_sweep(
    levels: Sequence[Level], lines: Sightlines, heights: Array, noise: float, options: SweepOptions
) -> Array:
    """Look again near the heights that are known (rows, columns), px."""
    step = step_height(lines, options)
    half = round(options.reach_px / options.step_px)
    base = np.rint(ndimage.median_filter(heights, 5) / step).astype(np.int32) - half
    return _swept(levels, lines, Ladder(base, step, 2 * half + 1), noise, options)[0]


def enlarged(heights: Array, shape: tuple[int, int]) -> Array:
    """Heights at the next larger size, px of that size: pixel i stands on pixel 2 i."""
    rows, columns = np.arange(shape[0]) / 2, np.arange(shape[1]) / 2
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(2 * ndimage.map_coordinates(heights, grid, order=1, mode="nearest"))


def coarse_to_fine(
    pictures: Sequence[Level],
    lines: Sightlines,
    span_px: tuple[float, float],
    sweep: SweepOptions,
    parallax: ParallaxOptions,
) -> Array:
    """Find the heights of all pixels of the reference view.

    Parameters
    ----------
    pictures
        All views, prepared.
    span_px
        Where heights are looked for first.

    Returns
    -------
    (rows, columns), px of the full picture, a number everywhere: what can be trusted is found out afterwards.
    """
    depth = coarsest_level(pictures[0].values.size, sweep)
    pyramids = [pyramid(picture, depth) for picture in pictures]
    heights: Array | None = None
    for level in range(depth, -1, -1):
        levels, at_level = [one[level] for one in pyramids], lines.at_level(level)
        noise = noise_variance(level)
        if heights is None:
            span = span_px[0] / 2**level, span_px[1] / 2**level
            heights = wide_sweep(levels, at_level, span, noise, sweep)
        else:
            heights = enlarged(heights, levels[0].values.shape)
            if level > 0:
                heights = narrow_sweep(levels, at_level, heights, noise, sweep)
        heights = refined([spline_of(one) for one in levels], at_level, heights, noise, parallax)
    assert heights is not None
    return heights


def _swept(
    levels: Sequence[Level], lines: Sightlines, ladder: Ladder, noise: float, options: SweepOptions
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Heights, which end of the ladder a pixel is at (-1, 0, 1), and where the views agree well."""
    costs = matching_costs(levels, lines, ladder, radius_px=options.radius_px, noise=noise)
    sums = aggregated(costs, ladder.base, small=options.small, large=options.large)
    rung, _ = best_rung(sums)
    nearest = np.rint(rung).astype(np.int64)[..., None]
    sure = np.take_along_axis(costs, nearest, axis=2)[..., 0] < 100
    end = np.where(rung >= ladder.rungs - 1, 1, np.where(rung <= 0, -1, 0))
    return ladder.height(rung), end, sure
