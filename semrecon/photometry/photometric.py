"""Slopes from several detectors of one view: each sees a place the brighter, the more the place faces it.

Electrons that leave by Lambert's law meet a detector in the direction d with ``I = rho n . d``, also a wide one: then
d is its mean direction. So ``m = rho n`` is linear in the signals and the unknown yield rho of each place cancels in
the slopes: with two opposite detectors that is the symmetric ratio ``(A - B) / (A + B)`` of SEM topography.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Image, Mask

STEEPEST = 12.0
"""Slope beyond which nothing is believed: 85 degrees."""
LEAST_CONDITION = 1e-3
"""Least over greatest singular value of detector directions that still fix a normal."""


@dataclass(frozen=True)
class ScaledNormals:
    """Normals times the yield, as far as the channels tell.

    Parameters
    ----------
    vector
        m = rho n in the view frame (x right, y up, z to the gun), (rows, columns, 3); NaN where unknown.
    residual
        Root-mean-square misfit of the channels in use, in their unit, (rows, columns).
    used
        How many channels each pixel rests on, (rows, columns).
    """

    vector: Array
    residual: Array
    used: NDArray[np.int64]


def usable(image: Image) -> Mask:
    """Tell where a channel is neither missing, nor black, nor white, (rows, columns); a float image has no white."""
    if np.issubdtype(image.dtype, np.integer):
        return np.asarray((image > 0) & (image < np.iinfo(image.dtype).max))
    return np.isfinite(image)


def fit_normals(signals: Array, directions: Array, trusted: Mask, reject_sigmas: float = 5.0) -> ScaledNormals:
    """Solve ``I_k = m . d_k`` at each pixel by least squares over the channels that can be trusted (Woodham 1980).

    With more than three channels, those that disagree are left out one by one. What disagrees in a relief is mostly
    shadow, which only takes away: of the channels below the fit, the darkest goes (Barsky and Petrou 2003; with four
    detectors the misfit alone cannot tell a dark channel from two bright ones).

    Parameters
    ----------
    signals
        Grey values less the black level, (channels, rows, columns).
    directions
        Towards the detectors, view frame, (channels, 3).
    trusted
        Where each channel may be used, (channels, rows, columns).
    reject_sigmas
        Misfit, in robust standard deviations over the picture, from which a channel is left out.
    """
    kept = trusted.copy()
    fit = _fit(signals, directions, kept)
    for _ in range(len(directions) - 3):
        spare = np.isfinite(fit.residual) & (fit.used > 3)
        if not spare.any():
            break
        limit = reject_sigmas * 1.4826 * float(np.median(fit.residual[spare]))
        wrong = spare & (fit.residual > max(limit, 1e-9 * float(np.nanmax(signals))))
        if not wrong.any():
            break
        misfit = signals - np.einsum("kj,rcj->krc", directions, fit.vector)
        below = np.where(kept & (misfit < 0), signals, np.inf)
        darkest = np.argmin(below, axis=0)
        rows, columns = np.nonzero(wrong)
        kept[darkest[rows, columns], rows, columns] = False
        fit = _fit(signals, directions, kept)
    return fit


def _fit(signals: Array, directions: Array, kept: Mask) -> ScaledNormals:
    """Least squares for every set of channels that occurs."""
    shape = kept.shape[1:]
    vector, residual = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    pattern = np.tensordot(1 << np.arange(len(kept)), kept, axes=1)
    for code in np.unique(pattern):
        chosen = np.array([bool(code >> k & 1) for k in range(len(kept))])
        design = directions[chosen]
        if chosen.sum() < 3 or _condition(design) < LEAST_CONDITION:
            continue
        here = pattern == code
        values = signals[chosen][:, here]
        solved = np.linalg.pinv(design) @ values
        vector[here] = solved.T
        residual[here] = np.sqrt(np.mean((values - design @ solved) ** 2, axis=0))
    return ScaledNormals(vector, residual, kept.sum(axis=0))


def _condition(design: Array) -> float:
    singular = np.linalg.svd(design, compute_uv=False)
    return float(singular[-1] / singular[0])


def slopes(vector: Array) -> tuple[Array, Array, Array]:
    """Turn (scaled) normals into slopes.

    Returns
    -------
    dz/dx, dz/dy (y up) and a weight n_z^2, (rows, columns) each: steep slopes are the least certain. NaN and weight 0
    where no surface seen from above can have the normal, or is too steep to believe.
    """
    x, y, z = np.moveaxis(vector, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        length = np.sqrt(x**2 + y**2 + z**2)
        upright = z / length
        good = upright > 1 / np.hypot(1, STEEPEST)
        slope_x, slope_y = np.where(good, -x / z, np.nan), np.where(good, -y / z, np.nan)
    return slope_x, slope_y, np.where(good, np.nan_to_num(upright) ** 2, 0.0)


def with_ambient(vector: Array, ambient: float) -> Array:
    """Take a constant out of the signals: Basri and Jacobs' harmonics of the first order, ``I_k = rho (a + n . d_k)``.

    For detectors of one elevation the constant cannot be told from the upright part of the normal pixel by pixel, but
    the normal is of length one: if the fit without it makes the angle phi, the true one is ``phi + asin(c sin(phi))``.

    Parameters
    ----------
    vector
        Of `fit_normals`, (rows, columns, 3).
    ambient
        c, the constant as a share of the rest of the signal at a level place.

    Returns
    -------
    The same with normals leaning farther, (rows, columns, 3); NaN where the angle would pass 90 degrees.
    """
    length = np.linalg.norm(vector, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = np.hypot(vector[..., 0], vector[..., 1])
        sine = level / length
        added = np.arcsin(np.clip(ambient * sine, -1, 1))
        angle = np.arctan2(level, vector[..., 2]) + added
        turn = np.where(level > 0, np.sin(angle) / np.maximum(level, 1e-300), 0.0)
        upright = np.where((angle < np.pi / 2) & (ambient * sine < 1), np.cos(angle), np.nan)
    yield_ = np.where(level > 0, level / np.maximum(np.sin(angle), 1e-300), vector[..., 2] / (1 + ambient))
    leaning = np.stack([turn * vector[..., 0], turn * vector[..., 1], upright], axis=-1)
    return np.asarray(leaning * yield_[..., None])
