"""Settings that differ from one series of a training set to the next: what they are drawn from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from semsim.errors import InputError
from semsim.overrides import assignment, setting, value_of
from semsim.scene import Scene


@dataclass(frozen=True)
class Variation:
    """A setting and the range or the list that its values are drawn from.

    Parameters
    ----------
    name
        Of the setting, such as ``detector.dose_e``.
    low, high
        Range, both ends included; a setting that is a whole number in the scene stays one.
    logarithmic
        Draw evenly over the logarithm, as suits a dose.
    choices
        Values to choose from instead of a range.

    Raises
    ------
    InputError
        The range is empty, or has no logarithm.
    """

    name: str
    low: float = 0.0
    high: float = 0.0
    logarithmic: bool = False
    choices: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise InputError(
                f"{self.name} varies from a lower to a higher number, not from {self.low:g} to {self.high:g}"
            )
        if self.logarithmic and not self.low > 0:
            raise InputError(f"{self.name} varies over its logarithm only above 0, not from {self.low:g}")

    def draw(self, scene: Scene, seed: int) -> Any:
        """Return a value for a scene; the same seed gives the same value."""
        rng = np.random.default_rng(seed)
        if self.choices:
            return self.choices[int(rng.integers(len(self.choices)))]
        share = rng.random()
        if isinstance(setting(scene, self.name), int):
            return math.floor(math.ceil(self.low) + share * (math.floor(self.high) - math.ceil(self.low) + 1))
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)


def variation(text: str) -> Variation:
    """Read a variation as it is typed: `section.key=low:high`, `section.key=low:high:log` or `section.key=a,b,c`.

    Raises
    ------
    InputError
        It is written in another way.
    """
    name, values = assignment(text)
    if (listed := value_of(f"[{values}]")) and isinstance(listed, list):
        return Variation(name, choices=tuple(listed))
    match [value_of(part) for part in values.split(":")]:
        case [int() | float() as low, int() | float() as high]:
            return Variation(name, low, high)
        case [int() | float() as low, int() | float() as high, "log"]:
            return Variation(name, low, high, logarithmic=True)
        case [str()] if "," in values:
            return Variation(name, choices=tuple(word.strip() for word in values.split(",")))
    raise InputError(f"{text!r} is no variation; write key=low:high, key=low:high:log or key=a,b,c")
