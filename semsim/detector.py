"""From the rate of electrons to a digital picture: dose, counting noise, amplifier, bits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Array

ELEMENTARY_CHARGE_C = 1.602176634e-19
Image = NDArray[np.unsignedinteger[Any]]
LOWEST, HIGHEST = 0.001, 0.99
"""Quantiles of the noise-free picture that auto contrast keeps within the range, with 2 sigma of noise beyond them."""


@dataclass(frozen=True)
class DetectorOptions:
    """Dose, and what detector and electronics do with it.

    Parameters
    ----------
    dose_e
        Electrons that leave a pixel of relative rate 1 in one frame.
    beam_current_pa, dwell_us
        The same stated as current times time, pA and us, where a surface of relative rate 1 gives one electron for
        each that comes; both or neither, and then without `dose_e`.
    frames
        Frames that are added up.
    dqe
        Detective quantum efficiency: the share of the electrons that the detector counts; 1 is all.
    read_noise_e
        Standard deviation of the amplifier's noise in one frame, in counted electrons; 0 is none.
    bits
        8 or 16.
    contrast
        "series": one brightness and contrast for all views; "view": the operator adjusts each.
    gain_per_e
        Grey levels a counted electron; None lets `contrast` choose gain and offset.
    offset_grey
        Grey level of no electron, where `gain_per_e` is given.

    Raises
    ------
    InputError
        A value outside its range, or a dose stated in part or twice.
    """

    dose_e: float = 200.0
    beam_current_pa: float | None = None
    dwell_us: float | None = None
    frames: int = 1
    dqe: float = 1.0
    read_noise_e: float = 0.0
    bits: int = 8
    contrast: Literal["series", "view"] = "series"
    gain_per_e: float | None = None
    offset_grey: float = 0.0

    def __post_init__(self) -> None:
        for name in ("dose_e", "beam_current_pa", "dwell_us", "frames", "gain_per_e"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e9:
                raise InputError(f"detector option {name} must be a positive number below 1e9, not {value}")
        if not (0 < self.dqe <= 1 and 0 <= self.read_noise_e < 1e9):
            raise InputError(f"detector options dqe ({self.dqe}) must lie in (0, 1], read_noise_e not be negative")
        if self.bits not in (8, 16):
            raise InputError(f"detector option bits must be 8 or 16, not {self.bits}")
        if self.contrast not in ("series", "view"):
            raise InputError(f'detector option contrast must be "series" or "view", not {self.contrast!r}')
        self._require_one_dose()

    def _require_one_dose(self) -> None:
        stated = [self.beam_current_pa is not None, self.dwell_us is not None]
        if any(stated) and not all(stated):
            raise InputError("detector options beam_current_pa and dwell_us state the dose together; one is missing")
        if all(stated) and self.dose_e != DetectorOptions.dose_e:
            raise InputError("detector options state the dose twice: give dose_e, or beam_current_pa and dwell_us")

    @property
    def frame_dose_e(self) -> float:
        """Electrons that leave a pixel of relative rate 1 in one frame, however they are stated."""
        if self.beam_current_pa is None or self.dwell_us is None:
            return self.dose_e
        return incident_electrons(self.beam_current_pa, self.dwell_us)

    @property
    def summed_read_noise_e(self) -> float:
        """Standard deviation of the amplifier's noise in the sum of all frames."""
        return float(self.read_noise_e * np.sqrt(self.frames))

    @property
    def white(self) -> int:
        """Highest grey level."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class Contrast:
    """What the amplifier does: ``grey = offset + gain * electrons``."""

    gain_per_e: float
    offset_grey: float


def incident_electrons(beam_current_pa: float, dwell_us: float) -> float:
    """Electrons of a beam in a time: ``N = I t / e``, 6.24 for 1 pA and 1 us."""
    return beam_current_pa * dwell_us * 1e-18 / ELEMENTARY_CHARGE_C


def expected_electrons(rate: Array, options: DetectorOptions) -> Array:
    """Electrons that are counted on average, all frames together, (rows, columns).

    Frames are added up before anything is drawn: a sum of Poisson numbers is Poisson with the sum of the means.
    Likewise the electrons that an inefficient detector keeps, each with probability `dqe`, are Poisson again.

    Parameters
    ----------
    rate
        (rows, columns) relative rate, after the spot; 1 is a flat sheet that faces the beam.
    """
    return np.asarray(options.frame_dose_e * options.frames * options.dqe * rate)


def random_children(
    rng: np.random.Generator, views: int, channels: int = 1
) -> tuple[tuple[np.random.Generator, ...], ...]:
    """Give each channel of each view a generator of its own, which does not depend on how many others there are."""
    return tuple(tuple(view.spawn(channels)) for view in rng.spawn(views))


def count_electrons(expected_e: Array, read_noise_e: float, rng: np.random.Generator) -> Array:
    """Draw the electrons of each pixel: Poisson about `expected_e` (rows, columns), plus the amplifier's noise."""
    counting, reading = rng.spawn(2)  # of their own, so that the amplifier's noise leaves the counting as it is
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


def saturation(image: Image) -> tuple[float, float]:
    """Share of the pixels that are black and of those that are white, where detail is lost."""
    return float((image == 0).mean()), float((image == np.iinfo(image.dtype).max).mean())


def _auto_contrast(expected_e: Array, options: DetectorOptions) -> Contrast:
    low, high = np.quantile(expected_e, [LOWEST, HIGHEST])
    read = options.summed_read_noise_e
    black = max(-2 * read, low - 2 * np.hypot(np.sqrt(low), read))  # counts are never below 0, the amplifier's noise is
    white = high + 2 * np.hypot(np.sqrt(high), read)
    gain = options.white / max(white - black, 1e-9)
    return Contrast(float(gain), float(-gain * black))
