"""Removal of what a method cannot observe (its gauge) before heights are judged, and of nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from semrecon.data import Array, Mask
from semrecon.errors import InputError

if TYPE_CHECKING:
    from semrecon.methods.base import Gauge

Norm = Literal["squares", "absolute"]
"""What the removed part makes small: the sum of squared errors, or the median of their absolute values."""
GAUGES = ("offset", "plane", "scale", "mirror")
ENOUGH = 200_000
"""Heights asked for a fit by least absolute error ..."""
ENOUGH_FOR_SCALE = 5_000
"""... and in the search for a scale."""
SCALE_REACH = 2.0
"""A scale is looked for within this factor of the one that least absolute error gives ..."""
SPREAD_REACH = 4.0
"""... which is itself held within this factor of the ratio of the spreads: else a relief that fits nowhere is
flattened, and the median of a scene that is mostly flat would be pleased."""


@dataclass(frozen=True)
class GaugeFit:
    """The member of a gauge that brings an estimate nearest the truth.

    Heights become ``scale h - offset - slope_x x - slope_y y``; the scale is negative where the relief was turned
    inside out.
    """

    scale: float = 1.0
    offset_um: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0

    def error(self, estimated_um: Array, true_um: Array, xy_um: Array | None = None) -> Array:
        """Estimated minus true height after the removal, um; `true_um` 0 gives the heights themselves."""
        error = self.scale * estimated_um - true_um - self.offset_um
        if xy_um is None or (self.slope_x == 0 and self.slope_y == 0):
            return np.asarray(error)
        return np.asarray(error - self.slope_x * xy_um[..., 0] - self.slope_y * xy_um[..., 1])


def gauge_residual(
    estimated_um: Array,
    true_um: Array,
    gauge: Sequence[Gauge] = ("offset",),
    xy_um: Array | None = None,
    norm: Norm = "squares",
) -> Array:
    """Error of heights that is left after the best member of the declared gauge is taken away.

    See `gauge_fit` for the parameters and for what is raised.

    Returns
    -------
    estimated - true in um, in the shape of the input; NaN where either is missing, and everywhere if no more heights
    are left than the gauge has free numbers: nothing would be left to judge.
    """
    fit = gauge_fit(estimated_um, true_um, gauge, xy_um, norm)
    residual = np.full(true_um.shape, np.nan)
    if fit is not None:
        valid = np.isfinite(estimated_um) & np.isfinite(true_um)
        xy = _places(true_um.shape, xy_um)[valid] if "plane" in gauge else None
        residual[valid] = fit.error(estimated_um[valid].astype(np.float64), true_um[valid].astype(np.float64), xy)
    return residual


def gauge_fit(
    estimated_um: Array,
    true_um: Array,
    gauge: Sequence[Gauge] = ("offset",),
    xy_um: Array | None = None,
    norm: Norm = "squares",
    narrower: bool = True,
) -> GaugeFit | None:
    """Find the member of a gauge that brings an estimate nearest the truth.

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
        ``squares``: least squares, so an offset is the mean error: what suits an RMS. ``absolute``: offset and plane by
        least absolute error (an offset is the median error), which does not follow outliers; scale, sign, and whether
        plane and scale are used at all, by the median absolute error, which is what is scored. So neither can cost a
        method anything: a wider gauge never has the larger RMS, nor, with the offset alike, the larger median.
    narrower
        Whether a freedom may go unused under ``absolute``. It may for a score; but relief of a wrong size scores well
        where most of the scene is flat, so that to bring surfaces together all freedoms should be used.

    Returns
    -------
    The fit, or None if no more heights are known than the gauge has free numbers.

    Raises
    ------
    InputError
        If shapes differ, a gauge is unknown, or places are needed and not given.
    """
    valid = _checked(estimated_um, true_um, gauge)
    free = ("offset" in gauge) + 2 * ("plane" in gauge) + ("scale" in gauge)
    if valid.sum() <= free:
        return None
    estimated, true = estimated_um[valid].astype(np.float64), true_um[valid].astype(np.float64)
    xy = _places(true_um.shape, xy_um)[valid] if "plane" in gauge else None
    found = []
    for sign in (1.0, -1.0) if "mirror" in gauge else (1.0,):
        turned = sign * estimated
        by_squares = norm == "squares"
        fits = _by_squares(turned, true, gauge, xy) if by_squares else _by_median(turned, true, gauge, xy, narrower)
        for fit in fits:
            error = fit.error(turned, true, xy)
            found.append((_misfit(error, norm), replace(fit, scale=sign * fit.scale)))
    return min(found, key=lambda each: each[0])[1]  # the first of equals: the narrowest


def _misfit(error: Array, norm: Norm) -> float:
    return float(np.mean(error**2) if norm == "squares" else np.median(np.abs(error)))


def _by_squares(estimated: Array, true: Array, gauge: Sequence[Gauge], xy: Array | None) -> Iterator[GaugeFit]:
    """Yield the least-squares member; a scale that wants to be negative is held at zero.

    A level estimate has no scale of its own, and rounding may make a wild one of it: the scale of 1 is yielded too.
    """
    columns, offset = _columns(xy), "offset" in gauge
    yield _fit(1.0, _taken(estimated - true, columns, offset, "squares"))
    if "scale" not in gauge:
        return
    *slopes, share, constant = _taken(estimated - true, [*columns, estimated], offset, "squares")
    if share <= 1:
        yield _fit(1.0 - share, np.array([*slopes, constant]))
    else:
        yield _fit(0.0, _taken(-true, columns, offset, "squares"))


def _by_median(
    estimated: Array, true: Array, gauge: Sequence[Gauge], xy: Array | None, narrower: bool
) -> Iterator[GaugeFit]:
    """Yield members of the gauge, and where wanted without plane or scale, for the least median to be taken."""
    offset = "offset" in gauge  # always taken where it is free: to leave it would spoil all but the median
    for plane in _choices("plane", gauge, narrower):
        columns = _columns(xy if plane else None)
        scales = _scales(estimated, true, columns, offset) if "scale" in gauge else ()
        for scale in (1.0, *scales) if narrower or not scales else scales:
            yield _fit(scale, _taken(scale * estimated - true, columns, offset, "absolute"))


def _choices(freedom: Gauge, gauge: Sequence[Gauge], narrower: bool) -> tuple[bool, ...]:
    if freedom not in gauge:
        return (False,)
    return (False, True) if narrower else (True,)


def _scales(estimated: Array, true: Array, columns: list[Array], offset: bool) -> tuple[float, ...]:
    """Scales worth a try: that of the estimate over the truth, which has no outliers, and the best about it."""
    every = max(1, len(true) // ENOUGH_FOR_SCALE)
    estimated, true, columns = estimated[::every], true[::every], [column[::every] for column in columns]
    spread, wanted = _spread(estimated, columns), _spread(true, columns)
    if spread == 0 or wanted == 0:
        return ()
    ratio = wanted / spread
    gain = 1 + _taken(estimated - true, [*columns, true], offset, "absolute")[-2]
    centre = float(np.clip(1 / gain if gain > 0 else np.inf, ratio / SPREAD_REACH, ratio * SPREAD_REACH))

    def misfit(scale: float) -> float:
        fit = _fit(scale, _taken(scale * estimated - true, columns, offset, "absolute"))
        return _misfit(fit.error(estimated, true, np.stack(columns, axis=-1) if columns else None), "absolute")

    best, reach = centre, SCALE_REACH
    for _ in range(3):
        tried = np.clip(best * np.geomspace(1 / reach, reach, 9), centre / SCALE_REACH, centre * SCALE_REACH)
        best, reach = float(min(tried, key=misfit)), reach**0.25
    return centre, best


def _spread(heights: Array, columns: list[Array]) -> float:
    """Height between the 5th and the 95th percentile, without the plane where that is free."""
    if columns:
        *slopes, _ = _taken(heights, columns, True, "squares")
        heights = heights - sum(slope * column for slope, column in zip(slopes, columns, strict=True))
    return float(np.subtract(*np.percentile(heights, [95, 5])))


def _columns(xy: Array | None) -> list[Array]:
    return [] if xy is None else [xy[:, 0], xy[:, 1]]


def _fit(scale: float, taken: Array) -> GaugeFit:
    """Name the factors: slopes, if any, then the constant."""
    *slopes, constant = (float(each) for each in taken)
    return GaugeFit(scale, constant, *slopes)


def _taken(error: Array, columns: list[Array], offset: bool, norm: Norm) -> Array:
    """Factor of each column, then the constant (0 unless there is an offset), of the best fit to an error.

    The fit is to the error and not to the heights, so no error has exactly nothing taken away.
    """
    if not columns:
        return np.array([_centre(error, norm) if offset else 0.0])
    design = np.stack([column - column.mean() if offset else column for column in columns], axis=1)
    size = np.sqrt(np.mean(design**2, axis=0))
    size = np.where(size > 0, size, 1)
    design = design / size
    if offset:
        design = np.column_stack([design, np.ones(len(error))])
    found = _least_squares(design, error) if norm == "squares" else _least_absolute(design, error)
    factors = found[: len(columns)] / size
    left = error - sum(factor * column for factor, column in zip(factors, columns, strict=True))
    return np.append(factors, _centre(left, norm) if offset else 0.0)


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
