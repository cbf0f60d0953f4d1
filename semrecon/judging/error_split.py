"""Split of a depth error into offset, scale of heights, tilt plane and remainder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array
from semrecon.errors import InputError
from semrecon.judging.gauge import gauge_residual


@dataclass(frozen=True)
class ErrorSplit:
    """Where the error of heights comes from; parts are NaN where they cannot be told.

    Parameters
    ----------
    offset_um
        Mean error (estimated - true).
    scale
        Factor on the true heights about their mean: 1 is right, 0.5 is relief of half its height. NaN if the truth is a
        plane, where scale is a tilt.
    tilt_x_deg, tilt_y_deg
        Slope of the error along x and along y as angles: positive rises toward +x, +y.
    offset_rms_um, scale_rms_um, tilt_rms_um, remainder_rms_um
        What each part adds to the RMS error when they are taken away one after another in this order; the squares add
        up to the square of `total_rms_um`.
    total_rms_um
        RMS error with nothing removed.
    count
        Heights compared.
    """

    offset_um: float
    scale: float
    tilt_x_deg: float
    tilt_y_deg: float
    offset_rms_um: float
    scale_rms_um: float
    tilt_rms_um: float
    remainder_rms_um: float
    total_rms_um: float
    count: int


def error_split(estimated_um: Array, true_um: Array, xy_um: Array) -> ErrorSplit:
    """Split the error of heights into offset, scale of heights, tilt plane and remainder by least squares.

    The model is ``e = offset + (scale - 1)(Z - mean Z) + p (x - mean x) + q (y - mean y) + remainder``, all its numbers
    fitted together, so that a tilt of a specimen that itself leans is not taken for scale. The RMS shares are
    sequential (offset, then scale, then tilt), so that they add up.

    Parameters
    ----------
    estimated_um, true_um
        Heights, (rows, columns) or (points,); what is not finite is left out.
    xy_um
        Places, (..., 2), x right and y up.

    Raises
    ------
    InputError
        If shapes differ or fewer than five heights can be compared.
    """
    error = gauge_residual(estimated_um, true_um, ())
    valid = np.isfinite(error)
    if xy_um.shape != (*true_um.shape, 2):
        raise InputError(f"places must be of shape {(*true_um.shape, 2)}, not {xy_um.shape}")
    if valid.sum() < 5:
        raise InputError(f"an error can be split from five heights on, not from {int(valid.sum())}")
    return _split(error[valid], true_um[valid], xy_um[valid])


def _split(error: Array, true: Array, xy: Array) -> ErrorSplit:
    offset = float(error.mean())
    centred, x, y = error - offset, xy[:, 0] - xy[:, 0].mean(), xy[:, 1] - xy[:, 1].mean()
    plane, relief = np.stack([x, y], axis=1), (true - true.mean())[:, None]
    flat = _rms(_removed(plane, relief[:, 0])) <= 1e-9 * _rms(plane)
    everything = plane if flat else np.hstack([plane, relief])
    factors = np.linalg.lstsq(everything, centred, rcond=None)[0]
    after_scale = centred if flat else _removed(relief, centred)
    remainder = centred - everything @ factors
    return ErrorSplit(
        offset_um=offset,
        scale=float("nan") if flat else float(1 + factors[2]),
        tilt_x_deg=float(np.rad2deg(np.arctan(factors[0]))),
        tilt_y_deg=float(np.rad2deg(np.arctan(factors[1]))),
        offset_rms_um=abs(offset),
        scale_rms_um=_rms_lost(centred, after_scale),
        tilt_rms_um=_rms_lost(after_scale, remainder),
        remainder_rms_um=_rms(remainder),
        total_rms_um=_rms(error),
        count=len(error),
    )


def _removed(columns: Array, values: Array) -> Array:
    """Values without their least-squares fit by the columns."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rms_lost(before: Array, after: Array) -> float:
    return float(np.sqrt(max(float(np.mean(before**2) - np.mean(after**2)), 0.0)))
