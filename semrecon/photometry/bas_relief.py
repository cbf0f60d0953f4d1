"""Normals from channels whose directions nobody knows: three factors, made to belong to one surface.

The factors of the channels are the scaled normals up to a matrix 3 x 3; that they belong to a surface (no curl) leaves
of it the generalised bas-relief, ``z -> lambda z + mu x + nu y`` (Belhumeur, Kriegman and Yuille 1999).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from semrecon.data import Array, Mask
from semrecon.errors import MethodError

LEAST_PIXELS = 100
LEAST_FACTOR = 1e-3
"""Third singular value over the first below which the channels do not show three directions."""


def three_factors(signals: Array, known: Mask) -> tuple[Array, Array]:
    """Split channels into three pictures and their shares in each channel (Basri, Jacobs and Kemelmacher 2007).

    Parameters
    ----------
    signals
        (channels, rows, columns).
    known
        Where all channels are usable, (rows, columns).

    Returns
    -------
    Factors (rows, columns, 3), NaN where not known; singular values (channels,) over the largest.

    Raises
    ------
    MethodError
        There are too few pixels, or fewer than three factors in them.
    """
    if known.sum() < LEAST_PIXELS:
        raise MethodError(f"only {int(known.sum())} pixels are neither black nor white in all channels; record anew")
    values = signals[:, known]
    turned, singular, _ = np.linalg.svd(values @ values.T)
    singular = np.sqrt(singular / max(float(singular[0]), 1e-300))
    if singular[2] < LEAST_FACTOR:
        raise MethodError("the channels show fewer than three independent pictures; give three segments or more")
    factors = np.full((*known.shape, 3), np.nan)
    factors[known] = (turned[:, :3] / singular[:3]).T.dot(values).T
    return factors / np.sqrt(np.nanmean(factors**2)), singular


def integrable(factors: Array, known: Mask, smooth_px: float = 2.0) -> Array:
    """Turn factors into the scaled normals of a surface, up to a generalised bas-relief.

    With rows a1, a2, a3 of the matrix that does it, the lack of curl reads ``(a3 x a1) . (m x dm/dy) = (a3 x a2) . (m x
    dm/dx)``: linear in two vectors, which the smallest singular vector over all pixels gives (Yuille and Snow 1997).
    The bas-relief is then chosen so that the surface lies level and the yield is as even as can be.

    Parameters
    ----------
    factors
        m, (rows, columns, 3).
    known
        Where they are known, (rows, columns).
    smooth_px
        Standard deviation of the blur before derivatives are taken, px.

    Returns
    -------
    (rows, columns, 3) in the view frame; the sign of the relief and its scale are guesses.
    """
    blurred, inner = _blurred(factors, known, smooth_px)
    down, right = np.gradient(blurred, axis=(0, 1))
    about_y, about_x = np.cross(blurred, -down)[inner], np.cross(blurred, right)[inner]
    equations = np.hstack([about_y, -about_x])
    _, vectors = np.linalg.eigh(equations.T @ equations)
    c1, c2 = vectors[:3, 0], vectors[3:, 0]
    third = np.cross(c1, c2)
    size = float(np.linalg.norm(third))
    if size < 1e-9:
        raise MethodError("the channels do not fix a surface: they show no change of slope across two directions")
    third = third / size
    third = third if np.median(factors[known] @ third) > 0 else -third
    return _levelled(factors @ np.stack([np.cross(c1, third), np.cross(c2, third), third]).T, known)


def with_a_sign(vector: Array, signals: Array, known: Mask) -> tuple[Array, Array]:
    """Choose between relief and its inside-out twin: the first channel's detector sits to the right, or else above.

    That is an agreement and no finding; it makes the answer the same on every machine.

    Returns
    -------
    Scaled normals (rows, columns, 3) and the azimuths of the detectors that go with them, degrees, (channels,).
    """
    lights = np.linalg.lstsq(vector[known], signals[:, known].T, rcond=None)[0].T
    first = lights[0, :2]
    sign = 1.0 if first[np.argmax(np.abs(first))] >= 0 else -1.0
    turned = vector * np.array([sign, sign, 1.0])
    return turned, np.rad2deg(np.arctan2(sign * lights[:, 1], sign * lights[:, 0]))


def _levelled(vector: Array, known: Mask) -> Array:
    """Choose the bas-relief: median slopes of 0, and the scale at which the length of the vectors varies least."""
    x, y, z = vector[known].T
    ahead = z > 0
    if ahead.sum() < LEAST_PIXELS:
        raise MethodError("the channels do not fix a surface that faces the beam; give the directions of the detectors")
    tilt_x, tilt_y = float(np.median(x[ahead] / z[ahead])), float(np.median(y[ahead] / z[ahead]))
    x, y = x - tilt_x * z, y - tilt_y * z
    flat, upright = (x**2 + y**2)[ahead], z[ahead] ** 2
    # |m|^2 = s^2 flat + upright is to vary least: regress upright on flat
    slope = np.cov(flat, upright)[0, 1] / max(float(np.var(flat)), 1e-300)
    typical = float(np.sqrt(np.median(flat / upright)))
    scale = float(np.sqrt(-slope)) if slope < 0 else 1.0
    scale = float(np.clip(scale * typical, 0.05, 1.5)) / max(typical, 1e-12)
    answer = vector.copy()
    answer[..., 0] = scale * (vector[..., 0] - tilt_x * vector[..., 2])
    answer[..., 1] = scale * (vector[..., 1] - tilt_y * vector[..., 2])
    return answer


def _blurred(factors: Array, known: Mask, smooth_px: float) -> tuple[Array, Mask]:
    """Blur what is known, and tell where the blur is not fed by holes or the frame."""
    share = gaussian_filter(known.astype(float), smooth_px)
    blurred = gaussian_filter(np.where(known[..., None], factors, 0.0), (smooth_px, smooth_px, 0))
    inner = share > 0.99
    inner[[0, -1]] = inner[:, [0, -1]] = False
    return blurred / np.maximum(share, 1e-9)[..., None], inner
