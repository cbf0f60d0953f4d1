"""Areal surface texture parameters of a height map (ISO 25178-2), with and without the mean plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semrecon.data import Array, HeightMap

ROUNDING = 1e-12
"""Share of the largest height below which a deviation is arithmetic: shape of a distribution that is none."""


@dataclass(frozen=True)
class Texture:
    """Parameters of ISO 25178-2 over all pixels with a height; no filter is applied. NaN where there is nothing to say.

    Parameters
    ----------
    Sa_um, Sq_um
        Arithmetic and root mean square deviation from the mean height.
    Sp_um, Sv_um, Sz_um
        Highest peak above the mean, deepest pit below it, and their sum.
    Ssk, Sku
        Skewness and kurtosis of the heights (a normal distribution has 0 and 3).
    Sdq
        Root mean square slope, over cells of four pixels with a height.
    Sdr
        Area of the surface over its projection, less 1, over the same cells.
    """

    Sa_um: float = math.nan
    Sq_um: float = math.nan
    Sp_um: float = math.nan
    Sv_um: float = math.nan
    Sz_um: float = math.nan
    Ssk: float = math.nan
    Sku: float = math.nan
    Sdq: float = math.nan
    Sdr: float = math.nan


@dataclass(frozen=True)
class SurfaceTexture:
    """Texture of a height map, and what it rests on.

    Parameters
    ----------
    coverage
        Fraction of the pixels that have a height: the others take no part.
    slope_x, slope_y
        Of the least-squares plane, um per um, along x (right in the image) and y (up).
    levelled
        About the least-squares plane.
    unlevelled
        About the mean height, the plane left in.
    """

    coverage: float
    slope_x: float
    slope_y: float
    levelled: Texture
    unlevelled: Texture


def surface_texture(heights: HeightMap) -> SurfaceTexture:
    """Describe the roughness of a height map.

    Parameters
    ----------
    heights
        Missing pixels are NaN. With fewer than three heights, or all on one line, the plane of least slope is taken.
    """
    finite = np.isfinite(heights.z_um)
    plane, slope_x, slope_y = _plane(heights)
    levelled = texture_of(heights.z_um - plane, heights.pixel_size_um, _size(heights.z_um))
    unlevelled = texture_of(heights.z_um, heights.pixel_size_um)
    return SurfaceTexture(float(finite.mean()) if finite.size else 0.0, slope_x, slope_y, levelled, unlevelled)


def texture_of(z_um: Array, pixel_size_um: float, size_um: float | None = None) -> Texture:
    """Compute the parameters of heights about their mean.

    Parameters
    ----------
    z_um
        (rows, columns), NaN = missing.
    size_um
        Largest height that went into `z_um`, by which rounding is told from shape; that of `z_um` by default.
    """
    finite = z_um[np.isfinite(z_um)]
    if finite.size == 0:
        return Texture()
    deviation = finite - finite.mean()
    variance = float(np.mean(deviation**2))
    peak, pit = float(deviation.max()), float(-deviation.min())
    flat = math.sqrt(variance) <= ROUNDING * (_size(z_um) if size_um is None else size_um)
    skewness = math.nan if flat else float(np.mean(deviation**3)) / variance**1.5
    kurtosis = math.nan if flat else float(np.mean(deviation**4)) / variance**2
    mean = float(np.mean(np.abs(deviation)))
    slope, area = _slope_and_area(z_um, pixel_size_um)
    return Texture(mean, math.sqrt(variance), peak, pit, peak + pit, skewness, kurtosis, slope, area)


def _plane(heights: HeightMap) -> tuple[Array, float, float]:
    """Least-squares plane at every pixel, and its slopes."""
    rows, columns = (np.asarray(index, dtype=np.float64) for index in np.indices(heights.z_um.shape))
    finite = np.isfinite(heights.z_um)
    if not finite.any():
        return np.zeros_like(heights.z_um), math.nan, math.nan
    x, y = columns * heights.pixel_size_um, -rows * heights.pixel_size_um
    x, y, z = x - x[finite].mean(), y - y[finite].mean(), heights.z_um[finite]
    xy = np.stack([x[finite], y[finite]], axis=1)
    slope_x, slope_y = (float(slope) for slope in np.linalg.pinv(xy.T @ xy) @ (xy.T @ (z - z.mean())))
    return z.mean() + slope_x * x + slope_y * y, slope_x, slope_y


def _slope_and_area(z_um: Array, pixel_size_um: float) -> tuple[float, float]:
    """Sdq and Sdr from the mean gradient of every cell of four pixels that all have a height."""
    across, down = np.diff(z_um, axis=1) / pixel_size_um, np.diff(z_um, axis=0) / pixel_size_um
    square = ((across[1:] + across[:-1]) / 2) ** 2 + ((down[:, 1:] + down[:, :-1]) / 2) ** 2
    square = square[np.isfinite(square)]
    if square.size == 0:
        return math.nan, math.nan
    return math.sqrt(float(square.mean())), float(np.mean(np.sqrt(1 + square))) - 1


def _size(z_um: Array) -> float:
    finite = np.abs(z_um[np.isfinite(z_um)])
    return float(finite.max()) if finite.size else 0.0
