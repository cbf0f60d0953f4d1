"""Heights from the brightness of one view: the secant law makes it an equation for the steepness alone.

``I = I0 sec(theta)^n`` gives ``|grad z| = sqrt((I / I0)^(2 / n) - 1)``, an eikonal equation. It says how steep a place
is and not which way it falls: an assumption has to start the solution, and the picture then improves it.
"""

from __future__ import annotations

from typing import Literal

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

from semrecon.data import Array
from semrecon.photometry.integration import integrate_freely

Lowest = Literal["frame", "bright"]
"""Where the surface lies lowest: along the frame of the picture, or wherever it falls to from its darkest place."""
SETTLED_UM = 1e-9


def steepness(brightness: Array, flat: float, exponent: float, steepest: float) -> Array:
    """Slope that the secant law asks for, ``sqrt((I / I0)^(2 / n) - 1)``, (rows, columns), from 0 to `steepest`.

    Parameters
    ----------
    brightness
        I over the black level; NaN where unknown, which counts as level.
    flat
        I0, the brightness of a place that faces the beam.
    exponent
        n.
    """
    secant = np.maximum(np.nan_to_num(brightness, nan=flat) / flat, 1.0) ** (1 / exponent)
    return np.asarray(np.sqrt(np.minimum(secant**2 - 1, steepest**2)))


def first_relief(slope: Array, pixel_size_um: float, lowest: Lowest = "frame") -> Array:
    """Solve the eikonal equation from an assumption, (rows, columns) um.

    The viscosity solution of ``|grad z| = slope`` with upwind differences (Rouy and Tourin 1992), by sweeps in
    alternating directions (Zhao 2005). "frame": the frame lies at 0 and all relief rises inwards from it, over the
    bright rims, up to dark tops. "bright": everything falls from the darkest place.
    """
    height = np.full(slope.shape, np.inf)
    if lowest == "frame":
        height[[0, -1]] = height[:, [0, -1]] = 0.0
    else:
        summit = np.unravel_index(int(np.argmin(gaussian_filter(slope, 3))), slope.shape)
        height[summit] = 0.0
    _sweep(height, slope * pixel_size_um)
    return height if lowest == "frame" else -height


def improve(height: Array, slope: Array, pixel_size_um: float, rounds: int, smooth_px: float) -> Array:
    """Make ``sum (|grad z| - slope)^2`` smaller without an assumption on the frame, (rows, columns) um.

    Each round keeps the directions of the gradients, gives them the lengths that the picture asks for, and takes the
    surface nearest to that in least squares: without the blur neither half could make the sum larger (as Frankot and
    Chellappa 1988 project on what is integrable). Directions are those of a blurred surface, which is the smoothness
    that Ikeuchi and Horn (1981) ask of neighbours.

    Parameters
    ----------
    rounds
        How often.
    smooth_px
        Standard deviation of the blur, px; 0 is none.
    """
    length_um = slope * pixel_size_um
    wanted_x, wanted_y = _edges(length_um**2, 1) ** 0.5, _edges(length_um**2, 0) ** 0.5
    for _ in range(rounds):
        seen = gaussian_filter(height, smooth_px) if smooth_px > 0 else height
        down, right = np.gradient(seen)
        size = np.maximum(np.hypot(down, right), SETTLED_UM)
        height = integrate_freely(wanted_x * _edges(right / size, 1), wanted_y * _edges(down / size, 0))
    return height


def misfit(height: Array, slope: Array, pixel_size_um: float) -> float:
    """Root-mean-square difference between the steepness of a surface and that of the picture."""
    down, right = np.gradient(height, pixel_size_um)
    return float(np.sqrt(np.mean((np.hypot(down, right) - slope) ** 2)))


def _edges(values: Array, axis: int) -> Array:
    turned = np.moveaxis(values, axis, 0)
    return np.moveaxis((turned[:-1] + turned[1:]) / 2, 0, axis)


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _sweep(height: Array, step: Array) -> None:  # pragma: no cover - compiled
    """Sweep in four directions until nothing moves; heights above 0 are lowered in place, those of the start stay."""
    rows, columns = height.shape
    for _ in range(200):
        largest = 0.0
        for turn in range(4):
            for i in range(rows):
                r = i if turn < 2 else rows - 1 - i
                for j in range(columns):
                    c = j if turn % 2 == 0 else columns - 1 - j
                    up = height[r - 1, c] if r > 0 else np.inf
                    low = height[r + 1, c] if r < rows - 1 else np.inf
                    left = height[r, c - 1] if c > 0 else np.inf
                    right = height[r, c + 1] if c < columns - 1 else np.inf
                    a, b = min(up, low), min(left, right)
                    if a > b:
                        a, b = b, a
                    if a == np.inf:
                        continue
                    f = step[r, c]
                    new = a + f if b - a >= f else (a + b + np.sqrt(2 * f * f - (a - b) ** 2)) / 2
                    if new < height[r, c]:
                        largest = max(largest, height[r, c] - new)
                        height[r, c] = new
        if largest < SETTLED_UM:
            break
