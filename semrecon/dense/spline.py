"""Views sampled where they see the surface: cubic B-spline, value and gradient.

A B-spline, because the cubic interpolation of image libraries shifts by up to 0.03 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.dense.bands import in_bands
from semrecon.dense.pictures import Level, Picture, shrunk
from semrecon.dense.sightlines import Sightlines, place

Float = NDArray[np.float32]


@dataclass(frozen=True)
class Spline:
    """Spline coefficients of a picture, and where it may be read."""

    coefficients: Picture
    valid: Mask


@dataclass(frozen=True)
class Samples:
    """What one view sees at each pixel of the reference grid, (rows, columns) each; NaN where it sees nothing.

    Parameters
    ----------
    values
        Grey value.
    across, down
        Its derivative by column and row of the view.
    """

    values: Float
    across: Float
    down: Float


def spline_of(level: Level) -> Spline:
    """Make a picture ready for sampling."""
    coefficients = ndimage.spline_filter(level.values, order=3, output=np.float32, mode="mirror")
    return Spline(coefficients, shrunk(level.valid))


def sampled(spline: Spline, lines: Sightlines, view: int, heights: Array) -> Samples:
    """Sample a view at the places where it sees the surface `heights` (rows, columns)."""
    out = np.full((3, *heights.shape), np.nan, dtype=np.float32)
    geometry = lines.of(view)
    in_bands(
        len(heights),
        lambda start, stop: _sample(spline.coefficients, spline.valid, geometry, heights, out, start, stop),
    )
    return Samples(*out)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _sample(
    coefficients: Float, valid: Mask, geometry: Array, heights: Array, out: Float, start: int, stop: int
) -> None:
    rows, columns = coefficients.shape
    wx, wy, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for y in range(start, stop):
        for x in range(heights.shape[1]):
            if not np.isfinite(heights[y, x]):
                continue
            u, v = place(geometry, float(x), float(y), heights[y, x])
            if not (u >= 1 and v >= 1 and u < columns - 2 and v < rows - 2):
                continue
            i, j = int(u), int(v)
            if not (valid[j, i] and valid[j + 1, i + 1]):
                continue
            _weights(u - i, wx, dx)
            _weights(v - j, wy, dy)
            value = across = down = 0.0
            for b in range(4):
                line = slope = 0.0
                for a in range(4):
                    c = coefficients[j - 1 + b, i - 1 + a]
                    line += wx[a] * c
                    slope += dx[a] * c
                value += wy[b] * line
                across += wy[b] * slope
                down += dy[b] * line
            out[0, y, x], out[1, y, x], out[2, y, x] = value, across, down


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _weights(t: float, w: Array, d: Array) -> None:
    """Cubic B-spline weights of four neighbours, and their derivatives."""
    r = 1.0 - t
    w[0], w[1] = r * r * r / 6, (4 - 6 * t * t + 3 * t * t * t) / 6
    w[2], w[3] = (4 - 6 * r * r + 3 * r * r * r) / 6, t * t * t / 6
    d[0], d[1] = -r * r / 2, (3 * t * t - 4 * t) / 2
    d[2], d[3] = (4 * r - 3 * r * r) / 2, t * t / 2
