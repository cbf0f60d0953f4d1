"""Removal of what a method cannot observe (its gauge) before heights are judged, and of nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from semrecon.data import Array, Mask
from semrecon.errors import InputError

if TYPE_CHECKING:
    from semrecon.methods.base import Gauge

Norm = Literal["squares", "absolute"]
"""What the removed part makes smallest: the sum of squared errors, or the sum of their absolute values."""
GAUGES = ("offset", "plane", "scale", "mirror")
ENOUGH = 200_000


def gauge_residual(
    estimated_um: Array,
    true_um: Array,
    gauge: Sequence[Gauge] = ("offset",),
    xy_um: Array | None = None,
    norm: Norm = "squares",
) -> Array:
    """Error of heights that is left after the best member of the declared gauge is taken away.

    Parameters
    ----------
    estimated_um, true_um
        Heights of one shape, (rows, columns) or (points,); what is not finite is missing.
    gauge
        Any of: ``offset``, a constant is subtracted; ``plane``, a tilt ``b x + c y`` is; ``scale``, the estimate is
        multiplied by a number that is not negative; ``mirror``, it is turned inside out where that fits better.
        Without ``offset``, tilts turn about the origin of `xy_um`, and scale and mirror about height 0.
    xy_um
        Places of the heights, (..., 2); needed for ``plane`` on points. A map has its pixel grid about its centre.
    norm
        ``squares``: least squares, so an offset is the mean error: what suits an RMS. ``absolute``: least absolute
        error, so an offset is the median error: what suits a median and quantiles, and does not follow outliers.

    Returns
    -------
    estimated - true in um, in the shape of the input; NaN where either is missing, and everywhere if no more heights
    are left than the gauge has free numbers: nothing would be left to judge.

    Raises
    ------
    InputError
        If shapes differ, a gauge is unknown, or places are needed and not given.
    """
    valid = _checked(estimated_um, true_um, gauge)
    residual = np.full(true_um.shape, np.nan)
    free = ("offset" in gauge) + 2 * ("plane" in gauge) + ("scale" in gauge)
    if valid.sum() <= free:
        return residual
    estimated, true = estimated_um[valid].astype(np.float64), true_um[valid].astype(np.float64)
    xy = _places(true_um.shape, xy_um)[valid] if "plane" in gauge else None
    if "mirror" in gauge and _mirrored_fits_better(estimated, true, gauge, xy):
        estimated = -estimated
    residual[valid] = _fitted(estimated, true, gauge, xy, norm)
    return residual


def _mirrored_fits_better(estimated: Array, true: Array, gauge: Sequence[Gauge], xy: Array | None) -> bool:
    """Compare both signs of the relief by least squares; a tie leaves it as it is."""
    upright, mirrored = (_fitted(sign * estimated, true, gauge, xy, "squares") for sign in (1, -1))
    return bool(np.mean(mirrored**2) < np.mean(upright**2))


def _fitted(estimated: Array, true: Array, gauge: Sequence[Gauge], xy: Array | None, norm: Norm) -> Array:
    """Error after offset, tilt and scale are removed; a scale that wants to be negative is held at zero.

    Under `absolute` the scale is that of the estimate over the truth, which has no outliers, and a surface without
    relief is taken where even that has the lower median.
    """
    columns, offset = [] if xy is None else [xy[:, 0], xy[:, 1]], "offset" in gauge
    if "scale" not in gauge:
        return _without(estimated - true, columns, offset, norm)[0]
    flat = _without(-true, columns, offset, norm)[0]
    if norm == "squares":
        error, taken = _without(estimated - true, [*columns, estimated], offset, norm)
        return error if taken[-1] <= 1 else flat
    error, taken = _without(estimated - true, [*columns, true], offset, norm)
    scale = 1 + taken[-1]
    return error / scale if scale > 0 and np.median(np.abs(error)) <= scale * np.median(np.abs(flat)) else flat


def _without(error: Array, columns: list[Array], offset: bool, norm: Norm) -> tuple[Array, Array]:
    """Error without its best fit by the columns (and a constant), and the factor of each column.

    The fit is to the error and not to the heights, so no error has exactly nothing taken away.
    """
    if not columns:
        return (error - _centre(error, norm) if offset else error), np.zeros(0)
    design = np.stack([column - column.mean() if offset else column for column in columns], axis=1)
    size = np.sqrt(np.mean(design**2, axis=0))
    design = design / np.where(size > 0, size, 1)
    if offset:
        design = np.column_stack([design, np.ones(len(error))])
    factors = _least_squares(design, error) if norm == "squares" else _least_absolute(design, error)
    left = error - design @ factors
    if offset:
        left = left - _centre(left, norm)
    return left, factors[: len(columns)] / np.where(size > 0, size, 1)


def _least_squares(design: Array, error: Array, weight: Array | None = None) -> Array:
    """Weighted least squares by the normal equations; columns that say the same share it."""
    weighted = design if weight is None else design * weight[:, None]
    return np.asarray(np.linalg.lstsq(weighted.T @ design, weighted.T @ error, rcond=1e-12)[0])


def _least_absolute(design: Array, error: Array, rounds: int = 20) -> Array:
    """Least absolute deviations by reweighted least squares, to about a hundredth of the median error.

    Of a large map every so-many-th height is asked: a few numbers need no more than `ENOUGH`.
    """
    every = max(1, len(error) // ENOUGH)
    design, error = design[::every], error[::every]
    factors = _least_squares(design, error)
    for _ in range(rounds):
        size = np.abs(error - design @ factors)
        floor = max(1e-2 * float(np.median(size)), 1e-12 * float(np.abs(error).max()))
        if floor == 0:
            break
        previous, factors = factors, _least_squares(design, error, 1 / np.maximum(size, floor))
        if np.abs(factors - previous).max() < floor:
            break
    return factors


def _centre(error: Array, norm: Norm) -> float:
    return float(np.mean(error) if norm == "squares" else np.median(error))


def _checked(estimated: Array, true: Array, gauge: Sequence[Gauge]) -> Mask:
    """Where both heights are known."""
    if estimated.shape != true.shape:
        raise InputError(f"estimated and true heights must have one shape, not {estimated.shape} and {true.shape}")
    unknown = [name for name in gauge if name not in GAUGES]
    if unknown:
        raise InputError(f"unknown gauge {unknown[0]!r}; known are {', '.join(GAUGES)}")
    return np.asarray(np.isfinite(estimated) & np.isfinite(true))


def _places(shape: tuple[int, ...], xy_um: Array | None) -> Array:
    """Place of every height, (..., 2): as given, or the pixel grid (a tilt does not care for its unit)."""
    if xy_um is not None:
        if xy_um.shape != (*shape, 2):
            raise InputError(f"places of heights of shape {shape} must be of shape {(*shape, 2)}, not {xy_um.shape}")
        return xy_um
    if len(shape) != 2:
        raise InputError("heights at points need xy_um, their places, before a plane can be removed")
    rows, columns = np.indices(shape, dtype=np.float64)
    return np.stack([columns - (shape[1] - 1) / 2, (shape[0] - 1) / 2 - rows], axis=-1)
