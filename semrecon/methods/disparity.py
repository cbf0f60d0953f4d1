"""The seed's control: depth from the disparity of adjacent pairs, alone or brought together by registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from semrecon.correspondence import CorrespondenceOptions, PairMatches, match_adjacent_pairs, view_name
from semrecon.data import Estimate, PointCloud, TiltSeries
from semrecon.disparity import Variant, disparity_cloud
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts, view_from_world
from semrecon.matching import Matches
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import (
    heights_of,
    match_diagnostics,
    pair_clouds_of,
    register_pair_clouds,
    skew_warnings,
)

REHMAN = "Rehman 2018, as the control experiment of: Research on micro/nano scale 3D reconstruction based on SEM"


@dataclass(frozen=True)
class Disparity:
    """Disparity depth mapping of adjacent pairs.

    Points and heights come from one pair: of those with the reference view, the one with the widest tilt step (the
    first of equals), seen from the reference view. The other pairs have their clouds. There is no reprojection error,
    so nothing is rejected after matching.

    Parameters
    ----------
    variant
        Formula of the height: "printed" in the seed, "symmetric" or "boyde" (`semrecon.disparity`).
    correspondence
        How matches are found and trusted.
    """

    variant: Variant = "printed"
    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)

    name: ClassVar[str] = "disparity"
    citation: ClassVar[str] = "Samak et al. 2007; Baghaie et al. 2017; the seed's introduction, Fig. 3A"
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match adjacent views, then map; raises `MethodError` with a sentence where it cannot."""
        return self.from_matches(series, match_adjacent_pairs(series, self.correspondence, rng))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Map matches that are at hand, so that several methods can share them; only adjacent pairs are used."""
        adjacent = adjacent_pairs(matches, len(series))
        points = _in_world(series, map_pair(series, _from_reference(series, adjacent), self.variant))
        clouds = tuple(map_pair(series, one, self.variant) for one in adjacent)
        return Estimate(
            points=points,
            heights=heights_of(series, points),
            clouds=clouds,
            pairs=tuple(one.pair for one in adjacent),
            diagnostics=match_diagnostics(series, adjacent) | {"points": len(points)},
            warnings=skew_warnings(series, adjacent),
        )


@dataclass(frozen=True)
class DisparityIcp:
    """Disparity depth mapping of all adjacent pairs, brought together by point-to-point ICP.

    Parameters
    ----------
    variant, correspondence
        As for `Disparity`.
    """

    variant: Variant = "printed"
    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)

    name: ClassVar[str] = "disparity_icp"
    citation: ClassVar[str] = REHMAN
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match adjacent views, map and register; raises `MethodError` with a sentence where it cannot."""
        return self.from_matches(series, match_adjacent_pairs(series, self.correspondence, rng))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Map and register matches that are at hand; only adjacent pairs are used."""
        adjacent = adjacent_pairs(matches, len(series))
        clouds = pair_clouds_of(adjacent, [map_pair(series, one, self.variant) for one in adjacent])
        points, registration = register_pair_clouds(series, clouds)
        found = {"points": len(points), "registration_rmse_um": registration.rmse_um}
        return Estimate(
            points=points,
            heights=heights_of(series, points),
            clouds=tuple(one.cloud for one in clouds),
            pairs=tuple(one.pair for one in clouds),
            diagnostics=match_diagnostics(series, adjacent) | found,
            warnings=skew_warnings(series, adjacent),
        )


def adjacent_pairs(matches: Sequence[PairMatches], n_views: int) -> tuple[PairMatches, ...]:
    """Pick the pairs of views that follow each other, in order.

    Raises
    ------
    MethodError
        Where one of them is missing.
    """
    found = {one.pair: one for one in matches}
    wanted = [(i, i + 1) for i in range(n_views - 1)]
    missing = [pair for pair in wanted if pair not in found]
    if missing:
        raise MethodError(f"views {missing[0][0]} and {missing[0][1]} follow each other, but have not been matched")
    return tuple(found[pair] for pair in wanted)


def map_pair(series: TiltSeries, one: PairMatches, variant: Variant) -> PointCloud:
    """Map the disparity of a pair to points in the view frame of its first view.

    Raises
    ------
    MethodError
        Where the views have one tilt, or the projection is not parallel.
    """
    step = float(series.tilts_deg[one.pair[1]] - series.tilts_deg[one.pair[0]])
    xy1, xy2 = one.matches.xy1_px, one.matches.xy2_px
    sigma = max(one.sigma_px / np.sqrt(2), 1e-6)
    axis = series.tilt_axis_deg
    try:
        cloud = disparity_cloud(xy1, xy2, step, series.optics, variant=variant, tilt_axis_deg=axis, sigma_px=sigma)
    except InputError as error:
        names = " and ".join(view_name(series, i) for i in one.pair)
        raise MethodError(f"{names}: {error}") from error
    return cloud.in_first_view()


def _from_reference(series: TiltSeries, adjacent: Sequence[PairMatches]) -> PairMatches:
    """Pick the widest pair with the reference view, and turn it so that the reference view comes first."""
    reference, tilts = series.reference, series.tilts_deg
    touching = [one for one in adjacent if reference in one.pair]
    widest = max(touching, key=lambda one: abs(tilts[one.pair[1]] - tilts[one.pair[0]]))
    if widest.pair[0] == reference:
        return widest
    m = widest.matches
    swapped = Matches(m.xy2_px, m.xy1_px, m.index2, m.index1, m.distance)
    return replace(widest, pair=(reference, widest.pair[0]), matches=swapped)


def _in_world(series: TiltSeries, cloud: PointCloud) -> PointCloud:
    """Turn a cloud from the view frame of the reference view into the world frame."""
    view = view_from_world(rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[series.reference])
    return PointCloud(cloud.xyz_um @ view, view.T @ cloud.covariance_um2 @ view, cloud.residual_px, cloud.xy_px)
