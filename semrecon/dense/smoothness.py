"""The surface that data and smoothness agree on: conjugate gradients on ``(H + L) z = b``.

L penalises second differences along rows and along columns, each with a weight of its own that
is small where the surface bends sharply, so that edges stay.
"""

from __future__ import annotations

import numba
import numpy as np

from semrecon.data import Array
from semrecon.dense.bands import in_bands


def edge_weights(heights: Array, edge_px: Array | float) -> Array:
    """Weights of the second differences along columns and rows, (2, rows, columns): near 0 across edges.

    Parameters
    ----------
    edge_px
        Second difference at which the weight is a half, px; one for all pixels or (rows, columns).
    """
    weights, edge = np.zeros((2, *heights.shape)), np.broadcast_to(edge_px, heights.shape)
    weights[0, :, 1:-1] = 1 / (1 + (np.diff(heights, 2, axis=1) / edge[:, 1:-1]) ** 2)
    weights[1, 1:-1] = 1 / (1 + (np.diff(heights, 2, axis=0) / edge[1:-1]) ** 2)
    return weights


def solved(information: Array, right: Array, weights: Array, start: Array, steps: int) -> Array:
    """Solve for the surface by preconditioned conjugate gradients.

    Parameters
    ----------
    information, right
        H (diagonal) and b, (rows, columns).
    weights
        Of the second differences, (2, rows, columns), with the strength of the prior in them.
    start
        Where to begin.
    steps
        How many iterations.
    """
    diagonal = information + _diagonal(weights)
    inverse = 1 / np.maximum(diagonal, 1e-12 * max(float(diagonal.max()), 1e-300))
    z, bent = start.copy(), np.zeros_like(weights)
    residual = right - applied(information, weights, z, bent)
    scaled = inverse * residual
    direction, rho = scaled.copy(), float(np.vdot(residual, scaled))
    for _ in range(steps):
        if rho <= 0:
            break
        image = applied(information, weights, direction, bent)
        length = rho / float(np.vdot(direction, image))
        z += length * direction
        residual -= length * image
        scaled = inverse * residual
        before, rho = rho, float(np.vdot(residual, scaled))
        direction *= rho / before
        direction += scaled
    return z


def applied(information: Array, weights: Array, z: Array, bent: Array) -> Array:
    """Return ``(H + L) z``; `bent` (2, rows, columns) is room to work in."""
    out = np.empty_like(z)
    in_bands(len(z), lambda start, stop: _bend(weights, z, bent, start, stop))
    in_bands(len(z), lambda start, stop: _unbend(information, bent, z, out, start, stop))
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _bend(weights: Array, z: Array, bent: Array, start: int, stop: int) -> None:
    """Weighted second differences."""
    rows, columns = z.shape
    for y in range(start, stop):
        for x in range(columns):
            if 0 < x < columns - 1:
                bent[0, y, x] = weights[0, y, x] * (z[y, x - 1] - 2 * z[y, x] + z[y, x + 1])
            if 0 < y < rows - 1:
                bent[1, y, x] = weights[1, y, x] * (z[y - 1, x] - 2 * z[y, x] + z[y + 1, x])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _unbend(information: Array, bent: Array, z: Array, out: Array, start: int, stop: int) -> None:
    """Add the transposed second differences of `bent` to ``H z``."""
    rows, columns = z.shape
    for y in range(start, stop):
        for x in range(columns):
            total = information[y, x] * z[y, x] - 2 * (bent[0, y, x] + bent[1, y, x])
            if x > 0:
                total += bent[0, y, x - 1]
            if x < columns - 1:
                total += bent[0, y, x + 1]
            if y > 0:
                total += bent[1, y - 1, x]
            if y < rows - 1:
                total += bent[1, y + 1, x]
            out[y, x] = total


def _diagonal(weights: Array) -> Array:
    """Diagonal of L."""
    along, down = weights
    out = 4 * (along + down)
    out[:, 1:] += along[:, :-1]
    out[:, :-1] += along[:, 1:]
    out[1:] += down[:-1]
    out[:-1] += down[1:]
    return np.asarray(out)
