"""Heights from a stage that only slides: slopes of the lines in epipolar-plane images, over all views at once.

A stage position s moves a point of height h by ``s / (1 - k h)``, k the inverse working distance. Stacked along the
path and sheared by s, the views show every point as a line whose slope is ``1 / (1 - k h) - 1``: nothing under
parallel projection, and little at any rate. Steps of a stage are many pixels, so lines cannot be followed from view to
view before the stack is sheared; it is sheared for a ladder of heights, and the one along which the grey values vary
least starts a least-squares fit of the slope, the structure tensor of the sheared stack in a window (Bolles, Baker,
Marimont 1987; Wanner and Goldluecke 2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from semrecon.data import Array, Mask, Poses, TiltSeries
from semrecon.dense.pictures import Level, prepared, pyramid
from semrecon.dense.sightlines import Sightlines, sightlines
from semrecon.dense.slope_trust import check_views, found_again, off_centre, seen_from, stated_sigma
from semrecon.dense.spline import Spline, sampled, spline_of
from semrecon.geometry import rotations_from_tilts


@dataclass(frozen=True)
class SlopeOptions:
    """How slopes are found.

    Parameters
    ----------
    reach
        Heights looked for, up and down, as a share of the width of the image.
    rung_px
        Greatest motion of a point from one rung of the ladder to the next, in pixels of half size.
    window_px
        Standard deviation of the window over which lines share a slope.
    coarse_window_px
        The same while the ladder is climbed, in pixels of half size.
    detail_px
        Shading coarser than this standard deviation does not count.
    rounds
        Steps of the fit.
    least_views
        Views that must see a point.
    occluded
        A view is left out of a window in which it differs from the reference view by so many times the mean-square
        difference that half of the views stay below: something stands in front of it there.
    check_rounds, agreement_px
        Steps of the fit when heights are looked for again from other views, and how far the two may be apart, in pixels
        of motion between the views.
    relief, aside
        What the window costs, see `stated_sigma`; both found from simulated grains.
    """

    reach: float = 0.7
    rung_px: float = 0.7
    window_px: float = 3.0
    coarse_window_px: float = 3.0
    detail_px: float = 8.0
    rounds: int = 8
    least_views: int = 3
    occluded: float = 3.0
    check_rounds: int = 2
    agreement_px: float = 1.0
    relief: float = 3.5
    aside: float = 2.8


@dataclass(frozen=True)
class Slopes:
    """Heights on the grid of the reference view, px, (rows, columns); NaN where too few views see a point.

    Parameters
    ----------
    heights, noise, sigma
        Along the beam, up is positive; one standard deviation from the scatter of the grey values alone, and one with
        what the window costs.
    aside_px
        How far from the pixel the middle of what the height rests on lies, px.
    found_again
        Whether other views along the path have the same height.
    contrast
        Share of the grey values' variance in the window that the views have in common, 0 to 1.
    stage_px
        Stage positions as the images have them, relative to the reference view, (views, 2).
    """

    heights: Array
    noise: Array
    sigma: Array
    aside_px: Array
    found_again: Mask
    contrast: Array
    stage_px: Array


@dataclass(frozen=True)
class _Fit:
    """One step and its standard deviation, px; what share of the variance views have in common; information a pixel."""

    step: Array
    noise: Array
    contrast: Array
    weight: Array


def stage_sightlines(series: TiltSeries, stage_um: Array) -> Sightlines:
    """Geometry of views of one tilt at stage positions (views, 2), um."""
    rotation = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[series.reference]
    shifts = np.pad(stage_um - stage_um[series.reference], ((0, 0), (0, 1)))
    poses = Poses(np.tile(rotation, (len(series), 1, 1)), shifts)
    return sightlines(poses, np.tile(np.eye(2), (len(series), 1, 1)), series.optics, series.reference)


def slopes(series: TiltSeries, stage_um: Array, options: SlopeOptions) -> Slopes:
    """Find the heights of all pixels: ladder at half size, then least squares at full size.

    The positions of the stage are corrected by what all pixels of a view have in common; a share that grows along the
    path moves all heights alike and stays unknown.
    """
    lines = stage_sightlines(series, stage_um)
    pictures = [_detail(prepared(view), options) for view in series.views]
    splines = [spline_of(picture) for picture in pictures]
    halves = [spline_of(pyramid(picture, 1)[1]) for picture in pictures]
    heights, lines = _climbed(splines, halves, lines, options, options.rounds, steady=True)
    found = _fit(splines, lines, heights, options)
    again = np.ones(heights.shape, dtype=np.bool_)
    for view in check_views(lines):
        theirs, _ = _climbed(splines, halves, seen_from(lines, view), options, options.check_rounds, steady=False)
        again &= found_again(heights, theirs, lines, view, options.agreement_px)
    settled = np.abs(found.step) * float(np.linalg.norm(lines.parallax(), axis=1).max()) < 0.1
    heights = np.where(settled, heights, np.nan)
    aside = off_centre(found.weight, options.window_px)
    sigma = stated_sigma(
        heights, found.noise, aside, window_px=options.window_px, relief=options.relief, aside=options.aside
    )
    return Slopes(heights, found.noise, sigma, aside, again, found.contrast, lines.matrices[:, :2, 3])


def _climbed(
    splines: Sequence[Spline],
    halves: Sequence[Spline],
    lines: Sightlines,
    options: SlopeOptions,
    rounds: int,
    *,
    steady: bool,
) -> tuple[Array, Sightlines]:
    """Heights (rows, columns) px on the grid of the reference, and the geometry with the stage put right."""
    shape = splines[lines.reference].coefficients.shape
    start = _ladder(halves, lines.at_level(1), halves[0].coefficients.shape, options)
    heights = 2 * np.repeat(np.repeat(start, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]
    for turn in range(rounds):
        heights = heights + _fit(splines, lines, heights, options).step
        if turn == rounds // 2:
            heights = np.where(np.isfinite(heights), ndimage.median_filter(heights, 5), np.nan)
        if steady and 0 < turn < rounds - 1:
            lines = _steadied(splines, lines, heights)
    return heights, lines


def _detail(level: Level, options: SlopeOptions) -> Level:
    """Take the coarse shading away."""
    smooth = ndimage.gaussian_filter(level.values, options.detail_px, mode="nearest")
    return replace(level, values=level.values - smooth)


def _ladder(splines: Sequence[Spline], lines: Sightlines, shape: tuple[int, ...], options: SlopeOptions) -> Array:
    """Shear the stack for one height after another; the least variance over the views wins, (rows, columns) px."""
    most = options.reach * shape[1]
    moves = float(np.linalg.norm(lines.parallax(), axis=1).max())
    count = 2 * int(np.ceil(most * moves / options.rung_px)) + 1
    best, least = np.full(shape, np.nan), np.full(shape, np.inf)
    for height in np.linspace(-most, most, max(count, 3)):
        values = np.stack([sampled(s, lines, v, np.full(shape, height)).values for v, s in enumerate(splines)])
        seen = np.isfinite(values)
        views = seen.sum(axis=0)
        mean = np.where(seen, values, 0.0).sum(axis=0) / np.maximum(views, 1)
        square = np.where(seen, (values - mean) ** 2, 0.0).sum(axis=0)
        enough = views >= options.least_views
        freedom = np.where(enough, views - 1.0, 0.0)
        share = _windowed(freedom, options.coarse_window_px)
        cost = _windowed(np.where(enough, square, 0.0), options.coarse_window_px) / np.maximum(share, 1e-6)
        better = enough & (cost < least)
        best[better], least[better] = height, cost[better]
    return np.where(np.isfinite(best), ndimage.median_filter(best, 5), np.nan)


def _fit(splines: Sequence[Spline], lines: Sightlines, heights: Array, options: SlopeOptions) -> _Fit:
    """Take one step of least squares on the slope that a window shares.

    The gradient is that of the mean of the views: the gradient of one noisy view goes with its own noise.
    """
    values, across, down = _sheared(splines, lines, heights)
    seen = _unhidden(values, lines.reference, options)
    views = seen.sum(axis=0)
    enough = views >= options.least_views
    mean, gx, gy = (_mean(one, seen) for one in (values, across, down))
    rest = np.where(seen, values - mean, 0.0)
    known = np.where(enough, heights, 0.0)
    motion = lines.k / (1 - lines.k * known) ** 2
    x, y = lines.matrices[:, 0, 3], lines.matrices[:, 1, 3]
    mx, my = (np.where(seen, one[:, None, None] - _mean_of(one, seen), 0.0) for one in (x, y))
    slope = motion * (gx * mx + gy * my)
    force, weight = (np.where(enough, one, 0.0) for one in ((slope * rest).sum(axis=0), (slope**2).sum(axis=0)))
    freedom = np.where(enough, views - 1.0, 0.0)
    scatter = np.where(enough, (rest**2).sum(axis=0), 0.0)
    strength = np.maximum(_windowed(weight, options.window_px), 1e-12)
    step = _windowed(weight * known - force, options.window_px) / strength - known
    moves = motion * np.hypot(np.ptp(x), np.ptp(y))
    noise = _windowed(scatter, options.window_px) / np.maximum(_windowed(freedom, options.window_px), 1e-9)
    spread = _windowed(weight, options.window_px / np.sqrt(2)) / (4 * np.pi * options.window_px**2)
    sigma = np.sqrt(noise * spread) / strength
    whole = _windowed(np.where(enough, mean**2, 0.0), options.window_px)
    share = _windowed(enough.astype(np.float64), options.window_px)
    common = whole / np.maximum(whole + noise * share, 1e-12)
    step = np.clip(step, -0.5 / moves, 0.5 / moves)
    step, sigma, common = (np.where(enough, one, np.nan) for one in (step, sigma, common))
    return _Fit(step, sigma, common, weight)


def _unhidden(values: Array, reference: int, options: SlopeOptions) -> Mask:
    """Where each view shows the same surface as the reference, (views, rows, columns)."""
    seen = np.isfinite(values)
    square = np.where(seen & seen[reference], values - values[reference], 0.0) ** 2
    apart = np.stack([_windowed(one.astype(np.float64), options.window_px) for one in square])
    share = np.stack([_windowed(one.astype(np.float64), options.window_px) for one in seen])
    apart = np.where(seen, apart / np.maximum(share, 1e-6), np.inf)
    apart[reference] = np.inf
    others = np.maximum(seen.sum(axis=0) - 1, 1)
    usual = np.take_along_axis(np.sort(apart, axis=0), ((others - 1) // 2)[None], axis=0)
    hidden = apart > options.occluded * usual
    hidden[reference] = False
    return np.asarray(seen & ~hidden)


def _steadied(splines: Sequence[Spline], lines: Sightlines, heights: Array) -> Sightlines:
    """Move every view but the reference by what all its pixels are off by, in the mean."""
    values, across, down = _sheared(splines, lines, heights)
    seen = np.isfinite(values) & (np.isfinite(values).sum(axis=0) >= 2)
    mean, gx, gy = (_mean(one, seen) for one in (values, across, down))
    matrices = lines.matrices.copy()
    for view in range(len(lines)):
        here = seen[view] & seen[lines.reference]
        if view == lines.reference or here.sum() < 100:
            continue
        design = np.column_stack([gx[here], gy[here]]).astype(np.float64)
        rest = (values[view] - mean)[here] - (values[lines.reference] - mean)[here]
        matrices[view, :2, 3] -= np.linalg.lstsq(design, rest.astype(np.float64), rcond=None)[0]
    return replace(lines, matrices=matrices)


def _sheared(splines: Sequence[Spline], lines: Sightlines, heights: Array) -> tuple[Array, Array, Array]:
    """Values and gradients of all views where they see the surface, (views, rows, columns) each."""
    found = [sampled(spline, lines, view, heights) for view, spline in enumerate(splines)]
    return tuple(  # type: ignore[return-value]
        np.stack([getattr(one, name) for one in found]) for name in ("values", "across", "down")
    )


def _mean(values: Array, seen: Mask) -> Array:
    return np.asarray(np.where(seen, values, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1))


def _mean_of(numbers: Array, seen: Mask) -> Array:
    """Mean of a number a view over the views that see each pixel, (rows, columns)."""
    return np.asarray(np.tensordot(numbers, seen, axes=1) / np.maximum(seen.sum(axis=0), 1))


def _windowed(values: Array, sigma_px: float) -> Array:
    return np.asarray(ndimage.gaussian_filter(values, sigma_px, mode="constant"))
