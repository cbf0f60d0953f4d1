"""What a bundle adjustment refines, and how well it is known before any image is looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Loss = Literal["cauchy", "huber", "squared"]


@dataclass(frozen=True)
class RefinementOptions:
    """What is refined, and how well it is known beforehand (1 sigma).

    Parameters
    ----------
    tilts, axis, magnifications, rotations
        Switches; what is off keeps its stated value exactly.
    tilt_sigma_deg
        Of the stage, for each view by itself.
    axis_sigma_deg
        Of the direction of the tilt axis.
    magnification_sigma
        Of the magnification of a view against the reference view (0.005 is half a percent).
    rotation_sigma_deg
        Of the rotation in the image plane against the reference view.
    loss
        Of the first rounds; "squared" trusts every sighting and leaves none out.
    reject_sigmas
        What is as unlikely as so many standard deviations is left out.
    rounds
        Most Gauss-Newton steps in each of the stages.
    """

    tilts: bool = True
    axis: bool = True
    magnifications: bool = True
    rotations: bool = True
    tilt_sigma_deg: float = 0.1
    axis_sigma_deg: float = 2.0
    magnification_sigma: float = 0.005
    rotation_sigma_deg: float = 1.0
    loss: Loss = "cauchy"
    reject_sigmas: float = 3.5
    rounds: int = 30
