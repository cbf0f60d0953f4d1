"""The loop over pixels and views of `tones`: what the views differ by, less brightness and height of every pixel."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.adjustment.camera_model import LOCAL
from semrecon.adjustment.schur_kernel import derivatives
from semrecon.data import Array

CAUCHY = 2.385 * 1.5
"""Deviation from the mean of the views at which one of them counts half, in units of the noise."""
LEAST_VIEWS = 3
"""With fewer, brightness and height of a pixel explain all that it shows."""
LEAST_INFORMATION = 1e-12
Float = NDArray[np.float32]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def eliminate(
    values: Float,
    gradient: Array,
    trust: Float,
    heights: Array,
    rotations: Array,
    by_tilt: Array,
    by_axis: Array,
    translations: Array,
    distortions: Array,
    centre: Array,
    pixel: float,
    k: float,
    reference: int,
    own: Array,
    asked: Array,
    rows: Array,
    step: int,
    top: int,
    bottom: int,
    left: int,
    right: int,
) -> int:
    """Add up what the views say one by one, and write what brightness and height take from it.

    Parameters
    ----------
    values, gradient, trust, heights
        (views, rows, columns), (2, rows, columns) in 1/um, and (rows, columns) twice, heights in um.
    rotations, by_tilt, by_axis, translations, distortions
        Of every view, as `schur_kernel.eliminate` takes them.
    own, asked
        (views, 6, 6) and (5 views + 1,), added to.
    rows
        (2 pixels, 5 views + 1), zero; two are written for a pixel, and their squares are what it loses.

    Returns
    -------
    How many rows are in use.
    """
    views, used = len(values), 0
    point, camera, x, beam = np.empty((2, 3)), np.empty((2, LOCAL + 1)), np.empty(3), rotations[reference, 2]
    slope, by_height, weight = np.empty((views, LOCAL + 1)), np.empty(views), np.empty(views)
    for row in range(top, bottom, step):
        for column in range(left, right, step):
            seen = values[:, row, column]
            if not trust[row, column] > 0 or _weigh(seen, trust[row, column], weight) < LEAST_VIEWS:
                continue
            across, down = (column - centre[0]) * pixel, (row - centre[1]) * pixel
            _place(across, down, heights[row, column], k, rotations[reference], translations[reference], x)
            gx, gy = gradient[0, row, column], gradient[1, row, column]
            for v in range(views):
                if weight[v] > 0:
                    derivatives(
                        x, rotations[v], by_tilt[v], by_axis[v], translations[v], distortions[v], k, point, camera
                    )
                    slope[v] = gx * camera[0] + gy * camera[1]
                    by_height[v] = 0.0
                    for a in range(3):
                        by_height[v] -= (gx * point[0, a] + gy * point[1, a]) * beam[a]
            _add_pixel(seen, weight, slope, by_height, own, asked, rows[used], rows[used + 1])
            used += 2
    return used


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _weigh(seen: Float, trust: float, weight: Array) -> int:
    """Weigh views by how far they are from their mean; 0 for those that see nothing. Returns how many see."""
    n, level = 0, 0.0
    for v in range(len(seen)):
        if not np.isnan(seen[v]):
            n, level = n + 1, level + seen[v]
    for v in range(len(seen)):
        weight[v] = 0.0
        if not np.isnan(seen[v]):
            weight[v] = trust / (1.0 + ((seen[v] - level / n) / CAUCHY) ** 2)
    return n


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _place(across: float, down: float, height: float, k: float, r: Array, t: Array, x: Array) -> None:
    """World point (3,) at a height above a place of the reference view, um from its centre."""
    scale = 1.0 - k * height
    a, b, c = across * scale - t[0], down * scale - t[1], -height - t[2]
    for n in range(3):
        x[n] = r[0, n] * a + r[1, n] * b + r[2, n] * c


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _add_pixel(
    seen: Float,
    weight: Array,
    slope: Array,
    by_height: Array,
    own: Array,
    asked: Array,
    of_brightness: Array,
    of_height: Array,
) -> None:
    """Add one pixel: all sums are over the views that see it, with their weights."""
    views = len(seen)
    total = mean = mean_height = information = along = 0.0
    for v in range(views):
        if weight[v] > 0:
            total += weight[v]
            mean += weight[v] * seen[v]
            mean_height += weight[v] * by_height[v]
    mean, mean_height = mean / total, mean_height / total
    for v in range(views):
        if weight[v] > 0:
            by_height[v] -= mean_height
            information += weight[v] * by_height[v] ** 2
            along += weight[v] * by_height[v] * (mean - seen[v])
    information += LEAST_INFORMATION
    for v in range(views):
        if not weight[v] > 0:
            continue
        left_over = mean - seen[v] - by_height[v] * along / information
        for a in range(LOCAL + 1):
            weighted, place = weight[v] * slope[v, a], LOCAL * views if a == LOCAL else v * LOCAL + a
            asked[place] += weighted * left_over
            of_brightness[place] += weighted / np.sqrt(total)
            of_height[place] += weighted * by_height[v] / np.sqrt(information)
            for b in range(LOCAL + 1):
                own[v, a, b] += weighted * slope[v, b]
