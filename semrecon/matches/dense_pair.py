"""Matches for every pixel of a pair: rectified, matched row by row, and brought back to the two views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semrecon.data import Array, TiltSeries
from semrecon.matches.correspondence import PairMatches, pair_geometry
from semrecon.matches.matching import Matches
from semrecon.matches.rectification import disparity_of, rectify, resampled
from semrecon.matches.semiglobal import SemiGlobalOptions, match_rows

MIDDLE_PERCENT = (1.0, 99.0)
"""Disparities of the features between which dense ones are looked for ..."""
MARGIN = 0.25
"""... and so many times their range beyond, on either side ..."""
MARGIN_PX = 4.0
"""... and so many px."""
SNAP_PX = 1e-6
"""Places nearer than this to a pixel centre are taken to be there."""


def dense_matches(series: TiltSeries, sparse: PairMatches, options: SemiGlobalOptions) -> tuple[PairMatches, Array]:
    """Match every pixel of the first view of a pair.

    Parameters
    ----------
    sparse
        Trusted matches of features; they tell the shift across the epipolar lines and the range of disparities.

    Returns
    -------
    Matches (pixels, in reading order) with a NaN second position where there is none, and the standard deviation of
    each disparity, px, (pixels,). All other numbers of the pair are those of the sparse matches.
    """
    epipolar, shape = pair_geometry(series, sparse.pair), series.optics.shape
    xy1, xy2 = sparse.matches.xy1_px, sparse.matches.xy2_px
    across = float(epipolar.offsets_px(xy1, xy2)[:, 0].mean())
    span = _span(disparity_of(rectify(epipolar, shape, across, (0.0, 0.0)), xy1, xy2))
    frames = rectify(epipolar, shape, across, span)
    first, second = (series.views[i] for i in sparse.pair)
    left = resampled(first, frames.left_from_first, frames.shape)
    right = resampled(second, frames.right_from_second, frames.shape)
    found = match_rows(left, right, int(np.ceil(span[1] - span[0])), options)
    rows, columns = (one.ravel() for one in np.indices(shape))
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    place = frames.to_left(pixels)
    disparity = interpolated(found.values_px, place)
    seen = frames.to_second(place - np.stack([disparity, np.zeros(len(disparity))], axis=1))
    number = np.arange(len(pixels))
    every = Matches(pixels, seen, number, number, np.full(len(pixels), np.nan))
    return replace(sparse, matches=every), interpolated(found.sigma_px, place)


def interpolated(values: Array, place: Array) -> Array:
    """Bilinear values at places (n, 2) as (column, row); NaN where a pixel that has weight is missing or outside."""
    place = np.where(np.abs(place - np.rint(place)) < SNAP_PX, np.rint(place), place)
    base = np.floor(place).astype(np.int64)
    part = place - base
    total = np.zeros(len(place))
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
            column, row = base[:, 0] + right, base[:, 1] + down
            inside = (column >= 0) & (row >= 0) & (column < values.shape[1]) & (row < values.shape[0])
            value = np.where(inside, values[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)
            total += np.where(weight > 0, weight * value, 0.0)
    return total


def _span(disparity_px: Array) -> tuple[float, float]:
    low, high = np.percentile(disparity_px, MIDDLE_PERCENT)
    margin = MARGIN * (high - low) + MARGIN_PX
    return float(low - margin), float(high + margin)
