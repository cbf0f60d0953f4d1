"""Structure from motion by the essential matrix: what works for photographs, taken to micrographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from semrecon.data import Estimate, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.matches.correspondence import PairMatches
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import match_diagnostics
from semrecon.perspective.essential import EssentialOptions, verified_pairs
from semrecon.perspective.incremental import incremental
from semrecon.perspective.pinhole import focal_length_px
from semrecon.perspective.pinhole_estimate import estimate_of


@dataclass(frozen=True)
class EssentialSfm:
    """Essential matrix of a pair, decomposition, cheirality, triangulation; later views by perspective pose.

    What the seed reports to fail on micrographs (introduction and section 6). Five-point essential matrix (Nister
    2004) with random sampling for every pair; those start that a homography explains least; later views by EPnP with
    random sampling and least squares. We deviate in favour of the method: the camera is given the focal length that
    the working distance means, or a long one; all pairs are matched, not only adjacent ones; matches must agree with
    their neighbours; a bundle adjustment follows every view, as in incremental pipelines; and of several attempts at
    the start the one counts that explains most sightings.

    The essential matrix needs perspective. Under parallel projection it is degenerate: tilts, relief and its sign come
    out as chance has them, and a warning says when that is so. What parallel views leave open is declared as gauge;
    where perspective is strong, all but the offset is measured.

    Parameters
    ----------
    search
        How pairs and later views are placed.
    focal_widths
        Focal length in image widths where no working distance is stated: long, as fits a microscope (defaults for
        photographs are 1.2).
    """

    search: EssentialOptions = field(default_factory=EssentialOptions)
    focal_widths: float = 10.0

    name: ClassVar[str] = "essential_sfm"
    citation: ClassVar[str] = (
        "Longuet-Higgins, Nature 293 (1981) 133; Nister, IEEE TPAMI 26 (2004) 756; for micrographs Liu 2018, as "
        "the seed cites it"
    )
    needs: ClassVar[tuple[Need, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "plane", "scale", "mirror")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match, place, triangulate; raises `MethodError` with a sentence where it cannot."""
        if len(series) < 2:
            raise MethodError(f"{self.name} needs two views or more, not {len(series)}")
        matching, search = rng.spawn(2)
        matches = verified_pairs(series, self._focal_px(series), self.search, matching)
        return self.from_matches(series, matches, rng=search)

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches], *, rng: np.random.Generator) -> Estimate:
        """Reconstruct from matches that are at hand."""
        found = incremental(series, matches, self._focal_px(series), self.search, rng)
        return estimate_of(series, found, match_diagnostics(series, matches))

    def _focal_px(self, series: TiltSeries) -> float:
        if not self.focal_widths > 0:
            raise InputError(f"focal_widths must be a positive number of image widths, not {self.focal_widths:g}")
        return focal_length_px(series.optics, self.focal_widths)
