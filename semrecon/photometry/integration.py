"""Heights from slopes: weighted least squares on the pixel grid, with holes, and with steps that slopes do not show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dctn, idctn

from semrecon.data import Array

BRIDGE = 1e-4
"""Weight of what joins islands and fills holes: too weak to be felt by what was measured."""
FLOOR = 1e-3
"""Least slope that counts as a disagreement, so that exact slopes are not weighted by their rounding."""


@dataclass(frozen=True)
class IntegrationOptions:
    """How heights are found.

    Parameters
    ----------
    rounds
        Solutions, each with less weight on the neighbours that the last one disagreed with; 1 is plain least squares.
    outlier
        Disagreement, in standard deviations of the good ones, that halves a weight.
    iterations, tolerance
        Of the conjugate gradients: most steps, and where they may end (residual over right-hand side).
    """

    rounds: int = 3
    outlier: float = 3.0
    iterations: int = 40
    tolerance: float = 1e-4


def integrate_slopes(
    slope_x: Array,
    slope_y: Array,
    pixel_size_um: float,
    weight: Array | None = None,
    options: IntegrationOptions | None = None,
) -> Array:
    """Find the heights whose differences agree best with slopes.

    Neighbours are to differ by the mean of their two slopes times the pixel (trapezoid rule). The weighted normal
    equations are solved by conjugate gradients, preconditioned by the solution without weights, which a cosine
    transform gives at once (Ghiglia and Romero 1994). A step breaks the agreement of a few neighbours; they lose their
    weight (Durou, Aujol and Courteille 2009).

    Parameters
    ----------
    slope_x, slope_y
        dz/dx to the right and dz/dy **up** (rows run down), (rows, columns); NaN where unknown.
    weight
        How far to trust each pixel's slopes, 0 to 1, (rows, columns); None is everywhere alike.
    options
        Defaults if None.

    Returns
    -------
    (rows, columns) um with median 0; NaN where a slope is unknown. Parts that nothing joins stand where the smoothest
    filling of the gap puts them.
    """
    options = options or IntegrationOptions()
    known = np.isfinite(slope_x) & np.isfinite(slope_y)
    trust = np.where(known, 1.0 if weight is None else np.nan_to_num(np.clip(weight, 0, 1)), 0.0)
    across = _between(np.where(known, slope_x, 0.0), 1) * pixel_size_um
    down = -_between(np.where(known, slope_y, 0.0), 0) * pixel_size_um
    sure = _both(trust, 1), _both(trust, 0)
    height = np.zeros(known.shape)
    weights = tuple(np.maximum(one, BRIDGE) for one in sure)
    for turn in range(options.rounds):
        height = _solve(height, across, down, weights, options)
        if turn + 1 < options.rounds:
            softer = _agreement(
                (np.diff(height, axis=1) - across, np.diff(height, axis=0) - down), sure, pixel_size_um, options
            )
            weights = tuple(np.maximum(one * soft, BRIDGE) for one, soft in zip(sure, softer, strict=True))
    answer = np.where(known, height, np.nan)
    return answer - np.nanmedian(answer) if known.any() else answer


def integrate_freely(across: Array, down: Array) -> Array:
    """Solve the same without weights, exactly: a Poisson equation with free edges, by the cosine transform.

    Parameters
    ----------
    across, down
        Wanted differences to the next column, (rows, columns - 1), and to the next row, (rows - 1, columns).

    Returns
    -------
    (rows, columns) with mean 0 (Frankot and Chellappa 1988, for edges that do not wrap around).
    """
    return _poisson(_divergence(across, down))


def _between(slope: Array, axis: int) -> Array:
    first, second = np.moveaxis(slope, axis, 0)[:-1], np.moveaxis(slope, axis, 0)[1:]
    return np.moveaxis((first + second) / 2, 0, axis)


def _both(trust: Array, axis: int) -> Array:
    first, second = np.moveaxis(trust, axis, 0)[:-1], np.moveaxis(trust, axis, 0)[1:]
    return np.moveaxis(np.minimum(first, second), 0, axis)


def _agreement(
    residuals: tuple[Array, Array], sure: tuple[Array, Array], pixel_size_um: float, options: IntegrationOptions
) -> tuple[Array, Array]:
    """Cauchy weights of the residuals, on the scale of most of them."""
    good = np.concatenate([np.abs(r[s > 0]) for r, s in zip(residuals, sure, strict=True)])
    sigma = 1.4826 * float(np.median(good)) if good.size else 0.0
    scale = max(options.outlier * sigma, FLOOR * pixel_size_um)
    across, down = (1 / (1 + (r / scale) ** 2) for r in residuals)
    return across, down


def _solve(start: Array, across: Array, down: Array, weights: tuple[Array, ...], options: IntegrationOptions) -> Array:
    """Preconditioned conjugate gradients from `start`; the constant, which nothing decides, stays what it was."""
    weight_x, weight_y = weights
    height = start
    right = _divergence(weight_x * across, weight_y * down)
    residual = right - _divergence(weight_x * np.diff(height, axis=1), weight_y * np.diff(height, axis=0))
    enough = options.tolerance * float(np.linalg.norm(right))
    direction, before = np.zeros_like(height), 1.0
    for _ in range(options.iterations):
        if float(np.linalg.norm(residual)) <= enough:
            break
        towards = _poisson(residual)
        now = float(np.vdot(residual, towards))
        direction = towards + now / before * direction
        image = _divergence(weight_x * np.diff(direction, axis=1), weight_y * np.diff(direction, axis=0))
        step = now / float(np.vdot(direction, image))
        height, residual, before = height + step * direction, residual - step * image, now
    return height


def _divergence(across: Array, down: Array) -> Array:
    """Transpose of the differences, (rows, columns): what they leave at each pixel, seen from its neighbours."""
    answer = np.zeros((across.shape[0], down.shape[1]))
    answer[:, 1:] += across
    answer[:, :-1] -= across
    answer[1:] += down
    answer[:-1] -= down
    return answer


def _poisson(source: Array) -> Array:
    """Invert `_divergence` of the differences; the mean of the answer is 0."""
    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in source.shape)
    eigenvalues = rows[:, None] + columns
    eigenvalues[0, 0] = 1.0
    spectrum = dctn(source, norm="ortho") / eigenvalues
    spectrum[0, 0] = 0.0
    return np.asarray(idctn(spectrum, norm="ortho"))
