"""Plane sweep: how well all views agree on each of a ladder of heights, for every pixel.

Each rung is a whole surface, a base that may vary from pixel to pixel plus a multiple of one step. All views are drawn
onto it and compared with the reference view by zero-mean normalised cross-correlation, in which the noise of the
images counts as difference, so that a place without texture agrees with nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array
from semrecon.dense.bands import each
from semrecon.dense.pictures import Level, shrunk
from semrecon.dense.sightlines import Sightlines, place

Float = NDArray[np.float32]
Costs = NDArray[np.uint8]
Rungs = NDArray[np.int32]

UNKNOWN = 170
"""Cost where no view can tell: that of a correlation of a third."""
WORST = 255


@dataclass(frozen=True)
class Ladder:
    """Heights to be tried: ``(base + i) * step`` for i = 0 ... rungs - 1, px.

    Parameters
    ----------
    base
        Lowest rung of each pixel, in whole steps, (rows, columns).
    step
        Height of a step, px.
    rungs
        How many.
    """

    base: Rungs
    step: float
    rungs: int

    def height(self, rung: Array) -> Array:
        """Heights of (fractional) rungs, (rows, columns)."""
        return np.asarray((self.base + rung) * self.step)


def matching_costs(
    levels: Sequence[Level], lines: Sightlines, ladder: Ladder, *, radius_px: int, noise: float
) -> Costs:
    """Compare all views on every rung.

    Parameters
    ----------
    levels
        Every view at one size.
    radius_px
        Half width of the square window.
    noise
        Variance of the noise of a pixel.

    Returns
    -------
    (rows, columns, rungs): 0 is perfect agreement, 255 none at all. Of all the views' correlations the better half
    and one more count, so that a view from which the place is hidden does not spoil it.
    """
    reference = levels[lines.reference]
    target = np.where(shrunk(reference.valid), reference.values, np.nan).astype(np.float32)
    others = [view for view in range(len(levels)) if view != lines.reference]
    valid = {view: shrunk(levels[view].valid) for view in others}
    costs = np.empty((*target.shape, ladder.rungs), dtype=np.uint8)

    def one_rung(rung: int) -> None:
        scores = np.empty((len(others), *target.shape), dtype=np.float32)
        drawn = np.empty(target.shape, dtype=np.float32)
        for n, view in enumerate(others):
            draw(levels[view].values, valid[view], lines.of(view), ladder.base, rung, ladder.step, drawn)
            correlate(target, drawn, radius_px, noise, scores[n])
        _combine(scores, costs, rung)

    each(range(ladder.rungs), one_rung)
    return costs


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def draw(
    image: Float, valid: NDArray[np.bool_], geometry: Array, base: Rungs, rung: int, step: float, out: Float
) -> None:
    """Draw a view onto a rung by bilinear interpolation; NaN where it does not show it."""
    rows, columns = image.shape
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            u, v = place(geometry, float(x), float(y), (base[y, x] + rung) * step)
            out[y, x] = np.nan
            if u >= 0 and v >= 0 and u < columns - 1 and v < rows - 1:
                i, j = int(u), int(v)
                if valid[j, i] and valid[j + 1, i + 1]:
                    a, b = np.float32(u - i), np.float32(v - j)
                    top = image[j, i] + a * (image[j, i + 1] - image[j, i])
                    low = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
                    out[y, x] = top + b * (low - top)


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})  # type: ignore[untyped-decorator]
def correlate(first: Float, second: Float, radius: int, noise: float, out: Float) -> None:
    """Correlate two pictures in square windows; NaN where less than half of a window is known to both.

    ``cov / sqrt((var_1 + noise) (var_2 + noise))`` over the pixels that both know.
    """
    rows, columns = first.shape
    sums = np.zeros((6, columns + 2 * radius + 1))  # with a margin of nothing on both sides
    least = (2 * radius + 1) ** 2 / 2
    for y in range(-radius, rows):
        if y + radius < rows:
            _gather(first[y + radius], second[y + radius], 1.0, sums[:, radius + 1 :])
        if y - radius - 1 >= 0:
            _gather(first[y - radius - 1], second[y - radius - 1], -1.0, sums[:, radius + 1 :])
        if y < 0:
            continue
        n = a = b = aa = bb = ab = 0.0
        for k in range(1, 2 * radius + 1):
            n, a, b = n + sums[0, k], a + sums[1, k], b + sums[2, k]
            aa, bb, ab = aa + sums[3, k], bb + sums[4, k], ab + sums[5, k]
        for x in range(columns):
            k, j = x + 2 * radius + 1, x
            k = min(k, columns + 2 * radius)
            n, a, b = n + sums[0, k] - sums[0, j], a + sums[1, k] - sums[1, j], b + sums[2, k] - sums[2, j]
            aa, bb, ab = aa + sums[3, k] - sums[3, j], bb + sums[4, k] - sums[4, j], ab + sums[5, k] - sums[5, j]
            if n < least or np.isnan(first[y, x]):
                out[y, x] = np.nan
                continue
            share = 1.0 / n
            spread = max((aa - a * a * share) * share, 0.0) + noise
            other = max((bb - b * b * share) * share, 0.0) + noise
            out[y, x] = (ab - a * b * share) * share / np.sqrt(spread * other)


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _gather(first: Float, second: Float, sign: float, sums: Array) -> None:
    """Add a row to the sums over columns, or take it away again."""
    for x in range(first.shape[0]):
        p, q = float(first[x]), float(second[x])
        known = sign if p + q == p + q else 0.0
        p, q = (p, q) if known != 0.0 else (0.0, 0.0)
        sums[0, x] += known
        sums[1, x] += known * p
        sums[2, x] += known * q
        sums[3, x] += known * p * p
        sums[4, x] += known * q * q
        sums[5, x] += known * p * q


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _combine(scores: Float, costs: Costs, rung: int) -> None:
    """Cost of one rung from the correlations of the views: the mean of the best ``n // 2 + 1``, none below zero."""
    views, rows, columns = scores.shape
    known = np.empty(views)
    for y in range(rows):
        for x in range(columns):
            n = 0
            for view in range(views):
                score = scores[view, y, x]
                if np.isnan(score):
                    continue
                k = n
                while k > 0 and known[k - 1] < score:
                    known[k] = known[k - 1]
                    k -= 1
                known[k] = score
                n += 1
            if n == 0:
                costs[y, x, rung] = UNKNOWN
                continue
            total, used = 0.0, n // 2 + 1
            for k in range(used):
                total += max(known[k], 0.0)
            costs[y, x, rung] = np.uint8(WORST * (1 - min(total / used, 1.0)))
