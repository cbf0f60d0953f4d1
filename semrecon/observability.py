"""What the images of a tilt series do not say, whatever their number, in sentences."""

from __future__ import annotations

import numpy as np

from semrecon.data import Array
from semrecon.refinement_options import RefinementOptions

HARDLY = 0.9
"""Posterior over prior sigma above which it is the stage that speaks, not the images."""


def unobservable(
    tilts_rad: Array, tilt_covariance_deg2: Array, reference: int, options: RefinementOptions
) -> tuple[str, ...]:
    """Say which freedoms the images leave open, and what holds each of them.

    Parameters
    ----------
    tilts_rad
        As the stage states them, (views,).
    tilt_covariance_deg2
        Posterior, (views, views).
    """
    prior = f"the stage's tilts (sigma {options.tilt_sigma_deg:g} degrees each)" if options.tilts else "the tilts given"
    said = [
        f"the place of the whole: shift 0 in view {reference}, median depth 0 along its beam",
        f"the overall magnification: the pixel size as stated, in view {reference}",
        f"the overall rotation in the plane: 0 in view {reference}",
        f"the mean tilt: {prior}",
        "the sign of the relief (Necker): the sign of the tilts as given",
    ]
    share = step_share(tilts_rad, tilt_covariance_deg2, options.tilt_sigma_deg)
    if options.tilts and share > HARDLY:
        said.append(f"the tilt steps, and with them the scale of depth: {prior}, as the images add next to nothing")
    return tuple(said)


def step_share(tilts_rad: Array, tilt_covariance_deg2: Array, tilt_sigma_deg: float) -> float:
    """Posterior over prior sigma of the spread of the tilts: 1 where the images say nothing of the scale of depth."""
    direction = tilts_rad - tilts_rad.mean()
    direction = direction / np.linalg.norm(direction)
    return float(np.sqrt(max(direction @ tilt_covariance_deg2 @ direction, 0.0)) / tilt_sigma_deg)
