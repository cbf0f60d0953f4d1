"""Structure from motion of all views at once: adaptive features, all pairs, one optimisation of cameras and points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from semrecon.data import Estimate, TiltSeries, View
from semrecon.errors import MethodError
from semrecon.matches.correspondence import PairMatches
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.unguided_matching import UnguidedOptions, match_unguided
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import heights_of, match_diagnostics
from semrecon.uncalibrated.self_calibration import calibrate


@dataclass(frozen=True)
class MultiviewSfm:
    """Optimised multi-view structure from motion in the manner of 3DSEM++.

    After Tafti et al. 2015 and 2016: SIFT whose threshold adapts to each view, matches of all pairs cleaned by random
    sampling, cameras and points of all views optimised together, metric scale from the known pixel size. We deviate
    in this: cameras are scaled orthographic instead of general projective ones, which parallel images do not determine;
    the epipolar geometry is the affine one for the same reason; the optimisation is a bundle adjustment with the points
    eliminated, started from a factorization, so that it needs no evolutionary search; and matches must agree with
    their neighbours.

    Three views or more are needed. The sign of the relief is the convention of `AffineFactorization`.

    Parameters
    ----------
    matching
        How matches are found and trusted; its contrast threshold is where the adaptation starts.
    least_features
        The contrast threshold of a view is halved until it has so many features,
    least_contrast
        but not below this.
    scaled
        Every view has a magnification of its own; otherwise all have the stated one.
    reject_sigmas
        Leave out tracks whose misses are as unlikely as so many standard deviations.
    """

    matching: UnguidedOptions = field(
        default_factory=lambda: UnguidedOptions(features=FeatureOptions(contrast_threshold=0.04))
    )
    least_features: int = 3000
    least_contrast: float = 0.005
    scaled: bool = True
    reject_sigmas: float = 3.5

    name: ClassVar[str] = "multiview_sfm"
    citation: ClassVar[str] = (
        "Tafti et al.: Recent advances in 3D SEM surface reconstruction, Micron 78 (2015) 54; Tafti et al.: 3DSEM++: "
        "adaptive and intelligent 3D SEM surface reconstruction, Micron 87 (2016) 33"
    )
    needs: ClassVar[tuple[Need, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (3, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "mirror")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Detect, match, optimise; raises `MethodError` with a sentence where it cannot."""
        if len(series) < 3:
            raise MethodError(
                f"{self.name} needs three views or more, not {len(series)}: two leave the scale of heights open"
            )
        features = [self._features(view) for view in series.views]
        return self.from_matches(series, match_unguided(series, self.matching, rng, features=features))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Reconstruct from matches that are at hand, so that several methods can share them."""
        found = calibrate(series, matches, scaled=self.scaled, sigmas=self.reject_sigmas)
        return Estimate(
            points=found.points,
            heights=heights_of(series, found.points, found.poses.translations_um[series.reference]),
            poses=found.poses,
            diagnostics=match_diagnostics(series, matches) | found.diagnostics,
            warnings=found.warnings,
        )

    def _features(self, view: View) -> Features:
        """Lower the contrast threshold until the view has features enough."""
        options = self.matching.features
        features = detect_features(view, options)
        while len(features) < self.least_features and options.contrast_threshold / 2 >= self.least_contrast:
            options = replace(options, contrast_threshold=options.contrast_threshold / 2)
            features = detect_features(view, options)
        return features
