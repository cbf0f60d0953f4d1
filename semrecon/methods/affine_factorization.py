"""Affine self-calibration by factorization, then dense matching of rectified pairs: no tilt need be known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from semrecon.data import Estimate, TiltSeries
from semrecon.errors import MethodError
from semrecon.matches.correspondence import PairMatches
from semrecon.matches.unguided_matching import UnguidedOptions, match_unguided
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import heights_of, match_diagnostics
from semrecon.surface.completion import points_from_heights
from semrecon.uncalibrated.affine_stereo import StereoOptions, dense_heights
from semrecon.uncalibrated.self_calibration import SelfCalibration, calibrate


@dataclass(frozen=True)
class AffineFactorization:
    """Tomasi-Kanade factorization with gaps, metric upgrade, affine rectification, semi-global matching.

    After Toeberg and Reithmeier 2020: SIFT and robust affine epipolar geometry for every pair, self-calibration by
    factorization with the scaled orthographic camera, rectification, semi-global block matching, triangulation. We
    deviate in this: the factorization takes tracks with gaps (weighted, robust, by damped Wiberg steps) instead of
    points seen in all views; the linear metric constraints are only the start of a bundle adjustment, as they are of
    second order in the tilts; features are compared upright, as stage tilts do not turn the picture; and all pairs
    with the reference view give one height together.

    Three views or more that differ in tilt are needed; two leave the scale of heights open. With small tilts the scale
    is known poorly, and the answer says how poorly. The sign of the relief is a convention: the last view of those
    tilted by at least half of the largest tilt counts as tilted positively, about an axis from -45 to 135 degrees.
    Stated tilts are not used, but for the reference view, whose tilt orients the world frame.

    Parameters
    ----------
    matching
        How matches are found and trusted.
    scaled
        Every view has a magnification of its own; otherwise all have the stated one.
    dense
        Match all pixels; otherwise the heights are filled in between the tracks.
    stereo
        How dense heights are found.
    reject_sigmas
        Leave out tracks whose misses are as unlikely as so many standard deviations.
    """

    matching: UnguidedOptions = field(default_factory=UnguidedOptions)
    scaled: bool = True
    dense: bool = True
    stereo: StereoOptions = field(default_factory=StereoOptions)
    reject_sigmas: float = 3.5

    name: ClassVar[str] = "affine_factorization"
    citation: ClassVar[str] = (
        "Toeberg, Reithmeier: Quantitative 3D reconstruction from scanning electron microscope images based on affine "
        "camera models, Sensors 20 (2020) 3598; Tomasi, Kanade 1992; Poelman, Kanade 1997"
    )
    needs: ClassVar[tuple[Need, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (3, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "mirror")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match, calibrate, reconstruct; raises `MethodError` with a sentence where it cannot."""
        if len(series) < 3:
            raise MethodError(
                f"{self.name} needs three views or more, not {len(series)}: two leave the scale of heights open"
            )
        return self.from_matches(series, match_unguided(series, self.matching, rng))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Reconstruct from matches that are at hand, so that several methods can share them."""
        found = calibrate(series, matches, scaled=self.scaled, sigmas=self.reject_sigmas)
        return Estimate(
            **self._surface(series, found),
            poses=found.poses,
            diagnostics=match_diagnostics(series, matches) | found.diagnostics,
            warnings=found.warnings,
        )

    def _surface(self, series: TiltSeries, found: SelfCalibration) -> dict[str, Any]:
        """Points and heights."""
        shift = found.poses.translations_um[series.reference]
        if not self.dense:
            return {"points": found.points, "heights": heights_of(series, found.points, shift)}
        depths = found.adjusted.points[np.isfinite(found.adjusted.points).all(axis=1), 2]
        heights = dense_heights(series, found.adjusted.model.cameras, depths, found.tilts.depth_sigma, self.stereo)
        if not np.isfinite(heights.z_um).any():
            raise MethodError("dense matching found no height that its neighbours and its other views support")
        rotation = found.poses.rotations[series.reference]
        return {"points": points_from_heights(heights, series, rotation, shift), "heights": heights}
