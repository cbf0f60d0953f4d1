"""Semi-global aggregation (Hirschmueller 2008) of matching costs along eight paths, on ladders with a base a pixel.

Along each path ``L(p, i) = C(p, i) + min(L(q, j), L(q, j +- 1) + P1, min L(q) + P2) - min L(q)`` with q the pixel
before p and j the rung of q at the height of rung i of p.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array
from semrecon.dense.bands import each
from semrecon.dense.sweep import Costs, Rungs

Sums = NDArray[np.uint16]


def aggregated(costs: Costs, base: Rungs, *, small: int, large: int) -> Sums:
    """Sum the path costs of eight directions, (rows, columns, rungs).

    Parameters
    ----------
    base
        Lowest rung of each pixel in whole steps, (rows, columns).
    small, large
        P1 and P2: price of a change of the height by one step, and by more.
    """
    sums = [np.zeros(costs.shape, dtype=np.uint16) for _ in range(2)]
    half = slice(None, None, -1)
    # the four upward paths are the downward ones of the picture turned by half a turn
    views = [(costs, base, sums[0]), (costs[half, half], base[half, half], sums[1][half, half])]
    each(views, lambda part: _downward(*part, small, large))
    sums[0] += sums[1]
    return sums[0]


def best_rung(sums: Sums) -> tuple[Array, NDArray[np.bool_]]:
    """Rung of the lowest cost with a parabola through its neighbours, and whether it is at an end of the ladder."""
    found, at_end = np.empty(sums.shape[:2]), np.empty(sums.shape[:2], dtype=np.bool_)
    _lowest(sums, found, at_end)
    return found, at_end


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _downward(costs: Costs, base: Rungs, sums: Sums, small: int, large: int) -> None:
    """Add the paths from the left, the upper left, above and the upper right."""
    rows, columns, rungs = costs.shape
    last = np.zeros((3, columns, rungs), dtype=np.int32)
    this = np.zeros((3, columns, rungs), dtype=np.int32)
    left, now = np.zeros(rungs, dtype=np.int32), np.zeros(rungs, dtype=np.int32)
    for y in range(rows):
        for x in range(columns):
            if x > 0:
                _follow(costs[y, x], left, base[y, x] - base[y, x - 1], small, large, now)
            else:
                _begin(costs[y, x], now)
            _add(sums[y, x], now)
            left[:] = now
            for path in range(3):
                from_x = x + path - 1
                if y > 0 and 0 <= from_x < columns:
                    shift = base[y, x] - base[y - 1, from_x]
                    _follow(costs[y, x], last[path, from_x], shift, small, large, this[path, x])
                else:
                    _begin(costs[y, x], this[path, x])
                _add(sums[y, x], this[path, x])
        last, this = this, last


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _begin(cost: Costs, now: NDArray[np.int32]) -> None:
    for i in range(now.shape[0]):
        now[i] = cost[i]


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _add(total: Sums, now: NDArray[np.int32]) -> None:
    for i in range(now.shape[0]):
        total[i] += np.uint16(now[i])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _follow(cost: Costs, before: NDArray[np.int32], shift: int, small: int, large: int, now: NDArray[np.int32]) -> None:
    rungs = now.shape[0]
    lowest = before[0]
    for i in range(1, rungs):
        lowest = min(lowest, before[i])
    for i in range(rungs):
        j = i + shift
        best = lowest + large
        if 0 <= j < rungs:
            best = min(best, before[j])
        if 0 <= j - 1 < rungs:
            best = min(best, before[j - 1] + small)
        if 0 <= j + 1 < rungs:
            best = min(best, before[j + 1] + small)
        now[i] = cost[i] + best - lowest


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _lowest(sums: Sums, found: Array, at_end: NDArray[np.bool_]) -> None:
    rows, columns, rungs = sums.shape
    for y in range(rows):
        for x in range(columns):
            best = 0
            for i in range(1, rungs):
                if sums[y, x, i] < sums[y, x, best]:
                    best = i
            found[y, x], at_end[y, x] = best, best == 0 or best == rungs - 1
            if 0 < best < rungs - 1:
                low, mid, high = float(sums[y, x, best - 1]), float(sums[y, x, best]), float(sums[y, x, best + 1])
                bend = low - 2 * mid + high
                if bend > 0:
                    found[y, x] += 0.5 * (low - high) / bend
