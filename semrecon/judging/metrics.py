"""Measures of quality: arrays in, numbers out.

RMSE (Eq. 7) and RRE (Eq. 8) are the seed's; both can look good on a wrong surface, so they stand beside the absolute
depth error and never instead of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semrecon.data import Array
from semrecon.errors import InputError
from semrecon.judging.error_split import ErrorSplit, error_split
from semrecon.judging.gauge import gauge_residual
from semrecon.numerics.motion import rotation_angle_rad
from semrecon.numerics.neighbours import distances_um

if TYPE_CHECKING:
    from semrecon.methods.base import Gauge

__all__ = [
    "DepthErrors",
    "ErrorSplit",
    "NeighbourRmse",
    "depth_errors",
    "error_split",
    "relative_rotation_error_arccos_deg",
    "relative_rotation_error_deg",
    "rmse_um",
]


@dataclass(frozen=True)
class NeighbourRmse:
    """RMS distances between nearest neighbours of two clouds, um.

    Parameters
    ----------
    moving_to_fixed_um
        Over the moving points, each to its nearest fixed point: what ``pcregistericp`` reports and the seed prints.
    fixed_to_moving_um
        The other way round; larger where the moving cloud leaves part of the fixed one bare.
    symmetric_um
        Root of the mean of both squares: each cloud has one vote, whatever its number of points.
    """

    moving_to_fixed_um: float
    fixed_to_moving_um: float
    symmetric_um: float


def rmse_um(moving_um: Array, fixed_um: Array) -> NeighbourRmse:
    """Root mean square distance of nearest neighbours after registration (Eq. 7), in both directions.

    The seed's text calls it the average Euclidean distance; its equation is the root of the mean square, which is what
    is computed here. Even identical surfaces sampled at different points have an RMSE, of about the point spacing.

    Parameters
    ----------
    moving_um, fixed_um
        (points, 3) each, the moving cloud already brought into the fixed frame.

    Raises
    ------
    InputError
        If a cloud is empty or holds a number that is not finite: a missing point must not lower the score.
    """
    for name, cloud in (("moving", moving_um), ("fixed", fixed_um)):
        if not len(cloud) or not np.isfinite(cloud).all():
            raise InputError(f"the {name} cloud must hold at least one point and only finite numbers")
    there = float(np.mean(distances_um(moving_um, fixed_um) ** 2))
    back = float(np.mean(distances_um(fixed_um, moving_um) ** 2))
    return NeighbourRmse(np.sqrt(there), np.sqrt(back), np.sqrt((there + back) / 2))


def relative_rotation_error_deg(true: Array, estimated: Array) -> float:
    """Angle between a true and an estimated rotation (Eq. 8), degrees, exact at any size.

    The angle of ``R_e R_c^-1`` by atan2 instead of the printed arccos, which cannot tell angles below 1e-6 degrees from
    zero. A rotation that was transposed by mistake shows as twice its angle.

    Parameters
    ----------
    true, estimated
        R_e and R_c, (3, 3), of the same direction (both fixed_from_moving).

    Raises
    ------
    InputError
        If either is not a rotation.
    """
    return float(np.rad2deg(rotation_angle_rad(_relative(true, estimated))))


def relative_rotation_error_arccos_deg(true: Array, estimated: Array) -> float:
    """Evaluate Eq. 8 as printed, degrees; the cosine is clipped to [-1, 1], which rounding can leave.

    See `relative_rotation_error_deg` for the parameters and for why this one is only for comparison.
    """
    cosine = (np.trace(_relative(true, estimated)) - 1) / 2
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True)
class DepthErrors:
    """Absolute depth errors after removal of the declared gauge, um; errors are NaN where nothing was estimated.

    Parameters
    ----------
    median_abs_um, p95_um
        Median and 95 % quantile of the absolute error; the gauge is removed by least absolute error (an offset is the
        median).
    rms_um
        Root mean square error; the gauge is removed by least squares (an offset is the mean).
    bias_um
        Mean error (estimated - true) that the least-squares removal leaves: zero by construction if offset is gauge.
    penalised_median_abs_um, penalised_p95_um
        The same quantiles over *all* true heights, a missing one counted as infinitely wrong. Leaving out what is
        difficult can lower `median_abs_um`, never these.
    completeness
        Heights estimated, of those that have a true value, 0 to 1.
    count
        How many heights were compared.
    """

    median_abs_um: float
    p95_um: float
    rms_um: float
    bias_um: float
    penalised_median_abs_um: float
    penalised_p95_um: float
    completeness: float
    count: int


def depth_errors(
    estimated_um: Array, true_um: Array, gauge: Sequence[Gauge] = ("offset",), xy_um: Array | None = None
) -> DepthErrors:
    """Judge heights against true heights after removing only the declared gauge (`semrecon.judging.gauge`).

    Parameters
    ----------
    estimated_um, true_um
        Heights at the same places, (rows, columns) or (points,). Set the truth to NaN where it is not to be judged.
    gauge
        What the method cannot observe.
    xy_um
        Places, (..., 2), needed only to remove a plane from points.

    Raises
    ------
    InputError
        If shapes differ, a gauge is unknown, places are needed and not given, or no height has a true value.
    """
    robust = np.abs(gauge_residual(estimated_um, true_um, gauge, xy_um, "absolute"))
    squares = gauge_residual(estimated_um, true_um, gauge, xy_um, "squares")
    judged = np.isfinite(true_um)
    if not judged.any():
        raise InputError("no height has a true value, so there is nothing to judge")
    errors, signed = robust[np.isfinite(robust)], squares[np.isfinite(squares)]
    count = int((judged & np.isfinite(estimated_um)).sum())
    missing = int(judged.sum()) - len(errors)
    return DepthErrors(
        median_abs_um=_quantile(errors, 0, 0.5),
        p95_um=_quantile(errors, 0, 0.95),
        rms_um=float(np.sqrt(np.mean(signed**2))) if len(signed) else float("nan"),
        bias_um=float(np.mean(signed)) if len(signed) else float("nan"),
        penalised_median_abs_um=_quantile(errors, missing, 0.5),
        penalised_p95_um=_quantile(errors, missing, 0.95),
        completeness=count / int(judged.sum()),
        count=count,
    )


def _quantile(errors: Array, missing: int, q: float) -> float:
    """Quantile as `numpy.quantile` has it, of the errors and of so many infinite ones; NaN of nothing."""
    position = q * (len(errors) + missing - 1)
    if position < 0:
        return float("nan")
    low, high = int(np.floor(position)), int(np.ceil(position))
    if high >= len(errors):
        return float("inf")
    ordered = np.partition(errors, (low, high))
    return float(ordered[low] + (position - low) * (ordered[high] - ordered[low]))


def _relative(true: Array, estimated: Array) -> Array:
    for name, rotation in (("true", true), ("estimated", estimated)):
        square = np.asarray(rotation).shape == (3, 3)
        if not (square and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0):
            raise InputError(f"the {name} rotation must be a proper rotation matrix of shape (3, 3)")
    return np.asarray(true @ estimated.T)
