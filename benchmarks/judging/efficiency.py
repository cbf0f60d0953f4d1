"""Efficiency: how far an answer is from the physical limit, over the very pixels that it answered.

The score of a method is a median of absolute errors, and so the limit has to be one: errors that are normal, each with
the least standard deviation that the light allows at its pixel, have a median absolute value of 0.6745 of it where it
is the same everywhere, and that of their mixture where it is not. Both are taken over the pixels at which the method
has a height, so that one which answers only where it is easy is held against what is easy. The limit is that of
`benchmarks.judging.limits`: one height a window, a texture of which nothing is known, known poses, no bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from benchmarks.judging.limits import (
    LimitOptions,
    common_sigma_um,
    median_abs_of_normals,
    motion_px_per_um,
    parallaxes,
)
from semrecon.data import Array, Mask
from semsim.capture import Surfaces

STILL_PX = 1e-6
"""A surface that moves less in every picture when it rises by 1 um does not move: 1e-5 of the smallest tilt in use."""
ONE_VIEW = "it has a single view, and matching needs two"
NO_PARALLAX = "none of its pictures changes with the height: no tilt, and no perspective, between its views"
NOTHING = "no pixel that all views see has a signal that changes along the parallax"


@dataclass(frozen=True, eq=False)
class SceneLimit:
    """The limit of a scene.

    Parameters
    ----------
    sigma_um
        Least standard deviation of the height at each pixel of the reference view, (rows, columns); NaN where not all
        views see the surface. Empty where there is no limit.
    window_px
        Standard deviation of the Gaussian window in which a height counts as one number.
    reason
        Why there is no limit; "" if there is one.
    """

    sigma_um: Array
    window_px: float
    reason: str = ""

    @property
    def median_abs_um(self) -> float:
        """Least median absolute error over all that is judged; NaN where there is no limit."""
        return self.over(np.isfinite(self.sigma_um))

    def over(self, answered: Mask) -> float:
        """Least median absolute error over the pixels of a mask, (rows, columns); NaN where none of them has a limit.

        Raises
        ------
        ValueError
            The mask is of another shape than the reference view.
        """
        if self.reason:
            return float("nan")
        if answered.shape != self.sigma_um.shape:
            raise ValueError(f"a mask of {answered.shape} cannot be laid over a limit of {self.sigma_um.shape}")
        sigmas = self.sigma_um[answered & np.isfinite(self.sigma_um)]
        return median_abs_of_normals(sigmas) if sigmas.size else float("nan")

    def shares_within(self, errors_um: Array) -> Array:
        """Share of the judged surface whose error would be within each of `errors_um`, (n,)."""
        sigmas = self.sigma_um[np.isfinite(self.sigma_um)]
        return np.array([erf(each / (np.sqrt(2) * sigmas)).mean() for each in errors_um])


def scene_limit(surfaces: Surfaces, options: LimitOptions | None = None) -> SceneLimit:
    """Work out the limit of a scene, or say why it has none."""
    options = options or LimitOptions()
    reason = _hindrance(surfaces)
    if not reason:
        sigma_um = common_sigma_um(parallaxes(surfaces), options)
        if np.isfinite(sigma_um).any():
            return SceneLimit(sigma_um, options.window_px)
        reason = NOTHING
    return SceneLimit(np.empty((0, 0)), options.window_px, reason)


def _hindrance(surfaces: Surfaces) -> str:
    """Say why nothing can be matched for depth, whatever the light; "" where it can."""
    views = range(len(surfaces.truth))
    if len(views) < 2:
        return ONE_VIEW
    reference = surfaces.scene.schedule.reference
    moved = [np.nan_to_num(motion_px_per_um(surfaces, reference, each)) for each in views if each != reference]
    return "" if max(float(np.abs(each).max()) for each in moved) > STILL_PX else NO_PARALLAX
