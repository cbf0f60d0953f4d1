"""Methods that end in every way a method can end, for the bench to survive."""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from semrecon.data import Estimate, HeightMap, TiltSeries
from semrecon.errors import MethodError


@dataclass(frozen=True)
class Troubled:
    """Does what `way` says; "level" answers with a level at height 0."""

    way: str = "level"
    name: str = "troubled"
    citation: ClassVar[str] = "nobody"
    needs: ClassVar[tuple[str, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (1, None)
    gauge: ClassVar[tuple[str, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """End in the way that was asked for."""
        if series.optics.width_px < 150 and self.way != "refuses":
            raise MethodError("this is the call that warms up")
        match self.way:
            case "refuses":
                raise MethodError("there is nothing\nto see")
            case "hangs":
                time.sleep(600)
            case "eats":
                kept = np.ones(1 << 27)
                time.sleep(600 + kept[0])
            case "crashes":
                ctypes.string_at(0)
            case "breaks":
                raise ZeroDivisionError("a bug")
            case "slow":
                time.sleep(0.5)
            case "empty":
                return Estimate()
        assert not any(view.channels for view in series.views)
        level = np.zeros(series.optics.shape)
        return Estimate(heights=HeightMap(level, level + rng.random(), series.optics.pixel_size_um))
