"""A height for every pixel from all views at once: plane sweep, then least squares on the grey values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.data import Array, Estimate, HeightMap, Mask, TiltSeries
from semrecon.dense.confidence import ConfidenceOptions, confidence
from semrecon.dense.consistency import confirmed
from semrecon.dense.parallax import ParallaxOptions
from semrecon.dense.pictures import Level, prepared
from semrecon.dense.shading import ShadingOptions, shaded
from semrecon.dense.sightlines import Sightlines, sightlines
from semrecon.dense.spline import Float, spline_of
from semrecon.dense.surface import SweepOptions, coarse_to_fine
from semrecon.errors import InputError, MethodError
from semrecon.matches.correspondence import CorrespondenceOptions, view_name
from semrecon.methods.base import Gauge, Need
from semrecon.methods.cameras_from_tones import with_tones
from semrecon.pose.alignment import Alignment, align
from semrecon.surface.completion import points_from_heights
from semrecon.surface.height_origin import with_median_zero

SPAN_PERCENT = (0.5, 99.5)
"""Heights of the features between which the surface is looked for first ..."""
SPAN_MARGIN = 0.3
"""... and so many times their range beyond, on either side ..."""
SPAN_PARALLAX_PX = 4.0
"""... and so much parallax."""
BLIND_SPAN = 0.04
"""Parallax looked for where there are no features, as a share of the longer side of the images, on either side."""
OUTLIERS = 5.0
"""Interquartile ranges beyond the quartiles past which a feature is an error (stripes match by the pitch) ..."""
LEAST_REACH = 0.15
"""... but heights within so large a share of the image's longer side of the quartiles are always looked at."""
LEAST_SHARE = 0.005
"""Share of the pixels below which what is left is no surface."""
LEAST_POINTS = 20


@dataclass(frozen=True)
class DenseMultiview:
    """Dense heights from all views at once.

    Parameters
    ----------
    correspondence, refinement
        How the cameras are found.
    sweep
        How heights are first found.
    parallax
        How they are refined.
    confidence
        What is trusted.
    shading
        Whether to reckon with brightness that changes with slope and tilt, and to add the detail that it tells of:
        where the views agree on it ("auto"), without asking ("everywhere"), or not ("off"). It takes the secant law,
        and for ridges and hollows what fits to simulated specimens had in common.
    """

    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    sweep: SweepOptions = field(default_factory=SweepOptions)
    parallax: ParallaxOptions = field(default_factory=ParallaxOptions)
    confidence: ConfidenceOptions = field(default_factory=ConfidenceOptions)
    shading: Literal["off", "auto", "everywhere"] = "auto"

    name: ClassVar[str] = "dense_multiview"
    citation: ClassVar[str] = (
        "ours; plane sweep (Collins 1996), semi-global aggregation (Hirschmueller 2008), least-squares matching on "
        "all views (Gruen and Baltsavias 1988)"
    )
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Align the views, then reconstruct; raises `MethodError` with a sentence where it cannot."""
        if len(series) < 2:
            raise InputError(f"a tilt series needs at least two views, not {len(series)}")
        aligned = align(series, self.correspondence, self.refinement, rng)
        return self.from_alignment(series, aligned)

    def from_alignment(self, series: TiltSeries, aligned: Alignment) -> Estimate:
        """Reconstruct with cameras that are at hand."""
        lines = sightlines(aligned.poses, aligned.distortions, series.optics, series.reference)
        pictures = [prepared(view) for view in series.views]
        span = _span_px(series, aligned, lines)
        heights, redrawn = coarse_to_fine(pictures, lines, span, self.sweep, self.parallax)
        splines = [spline_of(picture) for picture in pictures]
        aligned, heights = with_tones(series, aligned, splines, heights, self.parallax, self.refinement.tilt_sigma_deg)
        lines = sightlines(aligned.poses, aligned.distortions, series.optics, series.reference)
        heights, trust, by_shading = self._shaded(series, pictures, lines, heights)
        judged = confidence(pictures, splines, lines, heights, trust, redrawn, self.parallax, self.confidence)
        found_again = self._found_again(series, aligned, lines, pictures, heights, judged.trusted)
        sigma = np.where(found_again, 1.0, self.confidence.doubt) * judged.sigma_px
        estimate = _estimate(series, aligned, heights, sigma, judged.trusted, found_again | judged.sure)
        return replace(estimate, diagnostics={**estimate.diagnostics, **by_shading})

    def _shaded(
        self, series: TiltSeries, pictures: Sequence[Level], lines: Sightlines, heights: Array
    ) -> tuple[Array, Float, dict[str, Any]]:
        """Heights with the detail that shading tells of, where that is wanted, its weight, and what is to be said."""
        if self.shading == "off":
            return heights, np.zeros(heights.shape, np.float32), {}
        everywhere = self.shading == "everywhere"
        found = shaded(series, pictures, lines, heights, self.parallax, ShadingOptions(), everywhere=everywhere)
        return found.heights, found.trust, {"shading": found.diagnostics}

    def _found_again(
        self,
        series: TiltSeries,
        aligned: Alignment,
        lines: Sightlines,
        pictures: list[Level],
        heights: Array,
        trusted: Mask,
    ) -> Mask:
        """Check against a sweep from the view that moves most, over the heights that are trusted so far."""
        if not trusted.any():
            return trusted
        other = int(np.argmax(np.linalg.norm(lines.parallax(), axis=1)))
        other_lines = sightlines(aligned.poses, aligned.distortions, series.optics, other)
        low, high = np.percentile(heights[trusted], (0.1, 99.9))
        margin = 0.1 * (high - low) + SPAN_PARALLAX_PX
        span = float(low - margin), float(high + margin)
        return confirmed(pictures, lines, other_lines, heights, span, self.sweep)


def _span_px(series: TiltSeries, aligned: Alignment, lines: Sightlines) -> tuple[float, float]:
    """Heights between which the surface is looked for, px."""
    fastest = max(float(np.linalg.norm(lines.parallax(), axis=1).max()), 1e-9)
    if aligned.points is None or len(aligned.points) < LEAST_POINTS:
        reach = BLIND_SPAN * max(series.optics.shape) / fastest
        return -reach, reach
    beam = aligned.poses.rotations[series.reference, 2]
    heights = -(aligned.points.xyz_um @ beam) / series.optics.pixel_size_um
    low, high = np.percentile(heights, SPAN_PERCENT)
    quarter, three = np.percentile(heights, (25, 75))
    reach = max(OUTLIERS * (three - quarter), LEAST_REACH * max(series.optics.shape))
    low, high = max(low, quarter - reach), min(high, three + reach)
    margin = SPAN_MARGIN * (high - low) + SPAN_PARALLAX_PX / fastest
    return float(low - margin), float(high + margin)


def _estimate(
    series: TiltSeries, aligned: Alignment, heights: Array, sigma_px: Array, trusted: Mask, found_again: Mask
) -> Estimate:
    """Heights in um with holes, and a point a pixel."""
    kept, size_um = trusted & found_again, series.optics.pixel_size_um
    if kept.mean() < LEAST_SHARE:
        names = ", ".join(view_name(series, view) for view in range(len(series)))
        raise MethodError(
            f"{names} agree on the height of {int(kept.sum())} pixels only: images with more contrast or less noise "
            "would help, and the tilts, the tilt axis and the masks must be right"
        )
    z_um = np.where(kept, heights * size_um, np.nan)
    map_um = HeightMap(z_um, np.where(kept, sigma_px * size_um, np.nan), size_um)
    pose = aligned.poses.rotations[series.reference], aligned.poses.translations_um[series.reference]
    found: dict[str, Any] = {
        "alignment": aligned.diagnostics,
        "pixels": int(kept.sum()),
        "not_trusted": int((~trusted).sum()),
        "not_found_again": int((trusted & ~found_again).sum()),
        "median_sigma_um": float(np.median(map_um.sigma_um[kept])),
    }
    estimate = Estimate(
        points=points_from_heights(map_um, series, *pose),
        heights=map_um,
        poses=aligned.poses,
        ties=aligned.points,
        diagnostics=found,
        warnings=aligned.warnings,
    )
    return estimate if series.optics.inverse_working_distance else with_median_zero(estimate, series.reference)
