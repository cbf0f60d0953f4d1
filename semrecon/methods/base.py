"""What a method is: a frozen value of its options that can be called on a series."""

from __future__ import annotations

from typing import ClassVar, Literal, Protocol

import numpy as np

from semrecon.data import Estimate, TiltSeries

Need = Literal["rotations", "pixel_size", "tilt_axis", "channels", "perspective", "stage_path"]
"""What a method must be told beside the images."""
Gauge = Literal["offset", "plane", "scale", "mirror"]
"""What a method cannot observe: a height offset, a tilted plane, the scale of heights, the sign of relief."""


class Method(Protocol):
    """The one call of every method.

    Attributes
    ----------
    name
        As the command line and the tables call it.
    citation
        Where the method was published.
    needs
        What it must be told.
    views
        Least and most number of views; None is no limit.
    gauge
        What it cannot observe; judging removes exactly this.
    """

    name: ClassVar[str]
    citation: ClassVar[str]
    needs: ClassVar[tuple[Need, ...]]
    views: ClassVar[tuple[int, int | None]]
    gauge: ClassVar[tuple[Gauge, ...]]

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Reconstruct; raises `semrecon.errors.MethodError` with a sentence where it cannot."""
        ...
