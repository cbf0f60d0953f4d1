"""Charging: after a place that emits strongly the same line of the scan stays darker for a while.

A phenomenological model of one symptom, the streak. A place that emits more than the beam brings is left with a
positive charge, which holds slow electrons back until it has leaked away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from semsim.errors import InputError
from semsim.mesh import Array


@dataclass(frozen=True)
class ChargingOptions:
    """Streaks along the fast scan direction.

    Parameters
    ----------
    strength
        Exponent of the loss for a unit of charge: 0 switches it off, positive gives dark streaks, negative bright ones.
    recovery_px
        Pixels of the line after which the charge has fallen to 1/e.
    threshold
        Rate above which a place charges, relative to a flat sheet.

    Raises
    ------
    InputError
        A value outside its range.
    """

    strength: float = 0.0
    recovery_px: float = 60.0
    threshold: float = 1.2

    def __post_init__(self) -> None:
        for name, low, high in (("strength", -10.0, 10.0), ("recovery_px", 0.1, 1e6), ("threshold", 0.0, 1e6)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"charging option {name} must lie between {low:g} and {high:g}, not {value}")


def charged(rate: Array, options: ChargingOptions) -> Array:
    """Weaken each pixel by the charge that the pixels before it on its line have left; strength 0 is the identity.

    Parameters
    ----------
    rate
        (rows, columns) electron rate; the fast scan runs to higher columns.

    Returns
    -------
    (rows, columns) ``rate * exp(-strength * charge)``.
    """
    if options.strength == 0:
        return rate
    return np.asarray(rate * np.exp(-options.strength * line_charge(rate, options.recovery_px, options.threshold)))


def line_charge(rate: Array, recovery_px: float, threshold: float) -> Array:
    """Charge met at each pixel, (rows, columns): ``v[i] = a v[i-1] + (1 - a) max(rate[i-1] - threshold, 0)``.

    ``a = exp(-1 / recovery_px)``, an autoregression of first order; every line begins discharged by the flyback. The
    charge tends to the excess itself on a wide region.
    """
    decay = np.exp(-1.0 / recovery_px)
    excess = np.maximum(rate - threshold, 0.0)
    return np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], excess, axis=1))
