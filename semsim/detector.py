"""From the rate of electrons to a digital picture: spot, counting noise, amplifier, bits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Array

Image = NDArray[np.unsignedinteger[Any]]
LOWEST, HIGHEST = 0.001, 0.99
"""Quantiles of the noise-free picture that auto contrast keeps within the range, with 2 sigma of noise beyond them."""


@dataclass(frozen=True)
class DetectorOptions:
    """Beam dose, spot, and what the electronics do.

    Parameters
    ----------
    dose_e
        Electrons detected in a pixel of relative rate 1.
    spot_sigma_px
        Standard deviation of the Gaussian beam spot; 0 is a needle.
    read_noise_e
        Standard deviation of the amplifier's noise, in electrons; 0 is none.
    bits
        8 or 16.
    contrast
        "series": one brightness and contrast for all views; "view": the operator adjusts each.
    gain_per_e
        Grey levels an electron; None lets `contrast` choose gain and offset.
    offset_grey
        Grey level of no electron, where `gain_per_e` is given.

    Raises
    ------
    InputError
        A value outside its range.
    """

    dose_e: float = 200.0
    spot_sigma_px: float = 0.7
    read_noise_e: float = 0.0
    bits: int = 8
    contrast: Literal["series", "view"] = "series"
    gain_per_e: float | None = None
    offset_grey: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.dose_e < 1e9:
            raise InputError(f"detector option dose_e must be a positive number of electrons, not {self.dose_e}")
        if not (0 <= self.spot_sigma_px < 100 and 0 <= self.read_noise_e < 1e9):
            raise InputError("detector options spot_sigma_px (below 100) and read_noise_e must not be negative")
        if self.bits not in (8, 16):
            raise InputError(f"detector option bits must be 8 or 16, not {self.bits}")
        if self.contrast not in ("series", "view"):
            raise InputError(f'detector option contrast must be "series" or "view", not {self.contrast!r}')
        if self.gain_per_e is not None and not 0 < self.gain_per_e < 1e9:
            raise InputError(f"detector option gain_per_e must be a positive number, not {self.gain_per_e}")

    @property
    def white(self) -> int:
        """Highest grey level."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class Contrast:
    """What the amplifier does: ``grey = offset + gain * electrons``."""

    gain_per_e: float
    offset_grey: float


def spot_kernel(sigma_px: float) -> Array:
    """Sample a Gaussian spot out to five sigma: (2 r + 1,), sum 1, centroid 0."""
    if sigma_px == 0:
        return np.ones(1)
    x = np.arange(np.ceil(5 * sigma_px) + 1)
    half = np.exp(-0.5 * (x / sigma_px) ** 2)
    kernel = np.concatenate([half[:0:-1], half])  # mirrored, so that the centroid is 0 to the last bit
    return np.asarray(kernel / kernel.sum())


def blur_by_spot(rate: Array, sigma_px: float) -> Array:
    """Average a rate (rows, columns) over the spot; the picture continues beyond its border as in a mirror."""
    if sigma_px == 0:
        return rate
    import cv2

    kernel = spot_kernel(sigma_px)
    return np.asarray(cv2.sepFilter2D(rate, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101))


def count_electrons(expected_e: Array, read_noise_e: float, rng: np.random.Generator) -> Array:
    """Draw the electrons of each pixel: Poisson about `expected_e` (rows, columns), then the amplifier's noise."""
    counting, reading = rng.spawn(2)
    electrons = counting.poisson(expected_e).astype(np.float64)
    if read_noise_e > 0:
        electrons += reading.normal(0.0, read_noise_e, electrons.shape)
    return electrons


def contrasts(expected_e: Sequence[Array], options: DetectorOptions) -> tuple[Contrast, ...]:
    """Choose the contrast of each view from the noise-free pictures, so that no seed can change it.

    Parameters
    ----------
    expected_e
        Expected electrons of each view, (rows, columns).
    """
    if options.gain_per_e is not None:
        return (Contrast(options.gain_per_e, options.offset_grey),) * len(expected_e)
    if options.contrast == "view":
        return tuple(_auto_contrast(view.ravel(), options) for view in expected_e)
    return (_auto_contrast(np.concatenate([view.ravel() for view in expected_e]), options),) * len(expected_e)


def digitise(electrons: Array, contrast: Contrast, bits: int) -> Image:
    """Grey levels, rounded to the nearest and clipped: uint8 or uint16 of (rows, columns)."""
    grey = np.rint(contrast.offset_grey + contrast.gain_per_e * electrons)
    return np.clip(grey, 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)


def _auto_contrast(expected_e: Array, options: DetectorOptions) -> Contrast:
    low, high = np.quantile(expected_e, [LOWEST, HIGHEST])
    black = max(0.0, low - 2 * np.sqrt(low + options.read_noise_e**2))
    white = high + 2 * np.sqrt(high + options.read_noise_e**2)
    gain = options.white / max(white - black, 1e-9)
    return Contrast(float(gain), float(-gain * black))
