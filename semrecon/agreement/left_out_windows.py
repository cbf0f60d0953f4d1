"""Means over soft windows of pictures with gaps, and what interpolation leaves of noise."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from semrecon.data import Array, Mask

WIDE_PX = 8.0
"""Windows from here on are computed on a smaller picture: they are smooth enough ..."""
KEPT_PX = 4.0
"""... if their deviation is this many pixels of it."""
PHASES = 65


def smoothed(image: Array, valid: Mask, sigma_px: float) -> Array:
    """Mean of the valid pixels over a Gaussian window, (rows, columns); finite everywhere, 0 where none is near.

    Parameters
    ----------
    image
        (rows, columns); what is not valid may be anything.
    sigma_px
        Standard deviation of the window.
    """
    import cv2

    weight = valid.astype(np.float64)
    both = np.dstack([np.where(valid, image, 0.0), weight])
    shape = valid.shape[::-1]
    step = int(sigma_px // KEPT_PX) if sigma_px >= WIDE_PX else 1
    if step > 1:
        small = (max(1, shape[0] // step), max(1, shape[1] // step))
        both = cv2.resize(both, small, interpolation=cv2.INTER_AREA)
    both = cv2.GaussianBlur(both, (0, 0), sigma_px / step, borderType=cv2.BORDER_REFLECT_101)
    if step > 1:
        both = cv2.resize(both, shape, interpolation=cv2.INTER_LINEAR)
    return np.asarray(both[..., 0] / np.maximum(both[..., 1], 1e-9))


def noise_left(xy_px: Array) -> Array:
    """Variance that cubic spline interpolation leaves of white noise of variance 1 at positions (..., 2), (...).

    1 on a pixel, 0.57 in the middle between four.
    """
    phase = np.nan_to_num(xy_px - np.floor(xy_px))
    line = np.interp(phase, np.linspace(0, 1, PHASES), _kept())
    return np.asarray(line[..., 0] * line[..., 1])


@lru_cache(maxsize=1)
def _kept() -> Array:
    """Sum of the squared weights of the cubic cardinal spline by phase, (PHASES,)."""
    impulse = np.zeros(81)
    impulse[40] = 1.0
    coefficients = ndimage.spline_filter1d(impulse, order=3)
    places = np.arange(20, 60)[:, None] + np.linspace(0, 1, PHASES)
    weights = ndimage.map_coordinates(coefficients, [places], order=3, prefilter=False)
    return np.asarray((weights**2).sum(axis=0))
