"""From coarse to fine: a wide sweep at a small size, narrow ones about it at larger sizes, then parallax."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.dense.aggregation import aggregated, best_rung
from semrecon.dense.parallax import ParallaxOptions, refined, shared
from semrecon.dense.pictures import Level, noise_variance, pyramid
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.spline import Spline, spline_of
from semrecon.dense.sweep import Ladder, matching_costs
from semrecon.dense.tilt_tones import gentle

MOST_RUNGS = 320
WIDER = 3
"""How often a ladder is lengthened because pixels choose its ends."""
AT_END = 0.01
"""Share of the pixels at the ends of the ladder from which it is lengthened ..."""
TALLEST = 0.6
"""... but not to heights beyond so many times the longer side of the picture."""

MUCH_PARALLAX = 0.2
"""Parallax per height from which windows that do not lie along the surface are unlike even on gentle slopes."""
LEAST_PIXELS = 4_000
"""Pictures with fewer pixels than that are not halved for the sake of parallax or size."""
SPIKE_PX = 5
"""Width of the median that takes spikes off heights before windows are laid along them ..."""
ALONG_PX = 1.0
"""... and standard deviation of the blur that follows."""

FIRMER = 8, 2
"""Prices of small and of large changes at full size, in those of smaller pictures: there is more noise."""
WALL = 1.0
"""Slope at which half of what a wall is drawn anew to is taken ..."""
NEAR_WALL_PX = 3
"""... and so far from it."""


@dataclass(frozen=True)
class SweepOptions:
    """How heights are first found.

    Parameters
    ----------
    sweep_pixels
        The wide sweep is made at the largest size that has at most so many pixels: noise and windows that do not lie
        along the surface spoil larger ones.
    step_px
        Parallax between neighbouring rungs in the view that moves most, px.
    radius_px
        Half width of the window of comparison.
    small, large
        Price of a change of height by one step and by more, where 255 is the cost of no likeness at all.
    reach_px
        Parallax of the narrow sweeps on either side, px.
    again
        How many narrow sweeps follow the wide one at its size, and draw walls anew at full size; in between there is
        one at each size.
    """

    sweep_pixels: int = 300_000
    step_px: float = 0.5
    radius_px: int = 3
    small: int = 12
    large: int = 90
    reach_px: float = 3.0
    again: int = 2


def halvings(pixels: int, options: SweepOptions) -> int:
    """How often a picture is halved until it has at most `sweep_pixels` pixels."""
    return math.ceil(math.log(max(pixels / options.sweep_pixels, 1.0), 4.0))


def coarsest_level(pixels: int, lines: Sightlines, options: SweepOptions) -> int:
    """How often a picture is halved for the wide sweep: for its size, and once more for each doubling of parallax.

    A slope squeezes what a view shows of it by the parallax times the slope; the likeness of a window that does not
    yet lie along it lasts longest in small pictures, where few pixels hold much form and little noise.
    """
    for_size = halvings(pixels, options)
    fastest = float(np.linalg.norm(lines.parallax(), axis=1).max())
    for_parallax = math.ceil(math.log2(max(fastest / MUCH_PARALLAX, 1.0)))
    most = math.floor(math.log(max(pixels / LEAST_PIXELS, 1.0), 4.0))
    return min(for_size + for_parallax, most)


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
    """Look again near the heights that are known (rows, columns), px, in windows that lie along the surface."""
    step = step_height(lines, options)
    half = round(options.reach_px / options.step_px)
    base = np.rint(without_spikes(heights) / step).astype(np.int32) - half
    return _swept(levels, lines, Ladder(base, step, 2 * half + 1), noise, options)[0]


def without_spikes(heights: Array) -> Array:
    """Smooth heights (rows, columns), px, so that windows laid along them are stretched and sheared as the surface."""
    return np.asarray(ndimage.gaussian_filter(ndimage.median_filter(heights, SPIKE_PX), ALONG_PX))


def enlarged(heights: Array, shape: tuple[int, int]) -> Array:
    """Heights at the next larger size, px of that size: pixel i stands on pixel 2 i."""
    rows, columns = np.arange(shape[0]) / 2, np.arange(shape[1]) / 2
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(2 * ndimage.map_coordinates(heights, grid, order=1, mode="nearest"))


def swept(
    pictures: Sequence[Level],
    lines: Sightlines,
    span_px: tuple[float, float],
    options: SweepOptions,
    *,
    finest: int = 0,
    plane: Array | None = None,
) -> Array:
    """Find heights by a wide sweep and narrow ones about it.

    Parameters
    ----------
    pictures
        All views, prepared.
    span_px
        Where heights are looked for first.
    finest
        How often the picture is halved for the last sweep.
    plane
        Heights from which the span counts, (rows, columns) of the full picture, px; 0 by default.

    Returns
    -------
    (rows, columns) of the picture halved `finest` times, px of that size.
    """
    depth = max(coarsest_level(pictures[0].values.size, lines, options), finest)
    pyramids = [pyramid(picture, depth) for picture in pictures]
    span, ground = (span_px[0] / 2**depth, span_px[1] / 2**depth), None
    if plane is not None:
        ground = plane[:: 2**depth, :: 2**depth] / 2**depth
    small, at_depth, noise = [one[depth] for one in pyramids], lines.at_level(depth), noise_variance(depth)
    heights = wide_sweep(small, at_depth, span, noise, options, ground)
    for _ in range(options.again):
        heights = narrow_sweep(small, at_depth, heights, noise, options)
    for level in range(depth - 1, finest - 1, -1):
        levels = [one[level] for one in pyramids]
        heights = enlarged(heights, levels[0].values.shape)
        heights = narrow_sweep(levels, lines.at_level(level), heights, noise_variance(level), options)
    return heights


def coarse_to_fine(
    pictures: Sequence[Level],
    lines: Sightlines,
    span_px: tuple[float, float],
    sweep: SweepOptions,
    parallax: ParallaxOptions,
) -> tuple[Array, Array]:
    """Find the heights of all pixels of the reference view, and how far the last sweep moved them.

    Sweeps end at the size that has at most `sweep_pixels` pixels; from there on heights are refined at every size. At
    the full size of large pictures noise makes a sweep worse than the heights it starts from, but for walls.

    Parameters
    ----------
    pictures
        All views, prepared.
    span_px
        Where heights are looked for first.

    Returns
    -------
    Heights (rows, columns), px of the full picture, a number everywhere: what can be trusted is found out afterwards.
    And by how much `with_walls` changed them.
    """
    first = halvings(pictures[0].values.size, sweep)
    heights = swept(pictures, lines, span_px, sweep, finest=first)
    pyramids = [pyramid(picture, first) for picture in pictures]
    for level in range(first, -1, -1):
        levels, at_level, noise = [one[level] for one in pyramids], lines.at_level(level), noise_variance(level)
        if level < first:
            heights = enlarged(heights, levels[0].values.shape)
            if level > 0:
                heights = narrow_sweep(levels, at_level, heights, noise, sweep)
        splines = [spline_of(one) for one in levels]
        heights = refined(splines, at_level, heights, noise, parallax)
    upright = with_walls(pictures, splines, lines, heights, sweep, parallax)
    return upright, upright - heights


def with_walls(
    pictures: Sequence[Level],
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    sweep: SweepOptions,
    parallax: ParallaxOptions,
) -> Array:
    """Draw steep places anew from a sweep at full size, (rows, columns), px.

    What is halved smears walls over many pixels, and no refinement that wants smooth heights makes them upright again.
    The new heights are taken where they or the old ones are steep, and close by; elsewhere the old are better.

    Parameters
    ----------
    pictures, splines
        All views at full size.
    heights
        So far, (rows, columns), px.
    """
    import cv2

    small, large = FIRMER
    firm = replace(sweep, small=small * sweep.small, large=large * sweep.large)
    found = heights
    for _ in range(sweep.again):
        found = narrow_sweep(pictures, lines, found, 1.0, firm)
    found = refined(splines, lines, found, 1.0, parallax)
    steep = np.asarray(1 - np.minimum(gentle(heights, WALL), gentle(found, WALL)))
    around = np.ones((2 * NEAR_WALL_PX + 1, 2 * NEAR_WALL_PX + 1), np.uint8)
    near = shared(cv2.dilate(steep, around), NEAR_WALL_PX / 2)
    return np.asarray(heights + near * (found - heights))


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
