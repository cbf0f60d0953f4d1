"""Who is asked: the dense method under its options, and the seed's method on some of the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semrecon.data import Estimate, Poses, TiltSeries
from semrecon.errors import MethodError
from semrecon.method_options import with_settings
from semrecon.methods import method_named
from semrecon.methods.base import Gauge, Method, Need

DENSE = "dense_multiview"
SEED = "known_rotation"


@dataclass(frozen=True)
class Titled:
    """A method under another name, so that it can stand beside itself with other options."""

    method: Method
    name: str

    @property
    def citation(self) -> str:
        """Where the method was published."""
        return self.method.citation

    @property
    def needs(self) -> tuple[Need, ...]:
        """What it must be told."""
        return self.method.needs

    @property
    def views(self) -> tuple[int, int | None]:
        """Least and most number of views."""
        return self.method.views

    @property
    def gauge(self) -> tuple[Gauge, ...]:
        """What it cannot observe."""
        return self.method.gauge

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Reconstruct as the method does."""
        return self.method(series, rng=rng)


@dataclass(frozen=True)
class OfPair(Titled):
    """A method that is given the reference view and one other.

    Parameters
    ----------
    widest
        Whether the other is the one whose tilt is farthest from the reference, else the nearest; of two that are as
        far, the first.
    """

    widest: bool

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Reconstruct from two views; poses of the others are NaN, and the frame is that of the whole series."""
        pair = pair_of(series.tilts_deg, series.reference, self.widest)
        found = self.method(replace(series, views=tuple(series.views[i] for i in pair)), rng=rng)
        if found.poses is None:
            raise MethodError(f"{self.method.name} answers without poses: its frame is not known")
        return replace(found, poses=_among(found.poses, pair, len(series)))


def pair_of(tilts_deg: Sequence[float] | np.ndarray, reference: int, widest: bool) -> tuple[int, int]:
    """Find the reference view and the one that is nearest to it in tilt, or farthest, in the order of the series."""
    apart = np.abs(np.asarray(tilts_deg, dtype=np.float64) - tilts_deg[reference])
    apart[reference] = -1.0 if widest else np.inf
    other = int(np.argmax(apart) if widest else np.argmin(apart))
    return (min(reference, other), max(reference, other))


def _among(poses: Poses, kept: Sequence[int], views: int) -> Poses:
    rotations, shifts = np.full((views, 3, 3), np.nan), np.full((views, 3), np.nan)
    rotations[list(kept)], shifts[list(kept)] = poses.rotations, poses.translations_um
    return Poses(rotations, shifts)


def dense(**options: str) -> Any:
    """Make the dense method as it is, or with options as a command line has them; it is called after them.

    Raises
    ------
    InputError
        It has no such option, or the value is none.
    """
    plain = method_named(DENSE)
    changed = with_settings(plain, options)
    if repr(changed) == repr(plain):
        return plain
    return Titled(changed, ", ".join([DENSE, *(f"{name} {value}" for name, value in options.items())]))


def seed_of_pair(*, widest: bool) -> OfPair:
    """Make the seed's method for two views."""
    return OfPair(method_named(SEED), f"{SEED}, {'widest' if widest else 'adjacent'} pair", widest)
