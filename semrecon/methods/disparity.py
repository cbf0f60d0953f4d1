"""The seed's control: depth from the disparity of adjacent pairs, alone or brought together by registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from semrecon.data import Array, Estimate, HeightMap, Mask, PointCloud, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts, view_from_world
from semrecon.matches.correspondence import CorrespondenceOptions, PairMatches, match_adjacent_pairs, view_name
from semrecon.matches.dense_pair import dense_matches
from semrecon.matches.matching import Matches
from semrecon.matches.semiglobal import SemiGlobalOptions
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import (
    heights_of,
    match_diagnostics,
    pair_clouds_of,
    register_pair_clouds,
    registration_history,
    skew_warnings,
)
from semrecon.points.disparity import Variant, disparity_cloud

Density = Literal["sparse", "dense"]
ICP_POINTS = 10_000
"""Most points of a dense cloud that are registered."""
LEAST_SHARE = 0.01
"""Share of the pixels with a disparity below which there is no dense answer."""

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
        Formula of the height: "printed" in the seed, "symmetric" or "boyde" (`semrecon.points.disparity`).
    density
        "sparse": heights at features, filled in between. "dense": a height for every pixel, by rectification of the
        pair and semi-global matching over the range of disparities that the features show. The clouds stay sparse.
    correspondence
        How matches are found and trusted.
    semiglobal
        How dense disparities are found.
    """

    variant: Variant = "printed"
    density: Density = "sparse"
    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)
    semiglobal: SemiGlobalOptions = field(default_factory=SemiGlobalOptions)

    name: ClassVar[str] = "disparity"
    citation: ClassVar[str] = "Samak et al. 2007; Baghaie et al. 2017; the seed's introduction, Fig. 3A"
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __post_init__(self) -> None:
        _check_options(self.variant, self.density)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match adjacent views, then map; raises `MethodError` with a sentence where it cannot."""
        return self.from_matches(series, match_adjacent_pairs(series, self.correspondence, rng))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Map matches that are at hand, so that several methods can share them; only adjacent pairs are used."""
        adjacent = adjacent_pairs(matches, len(series))
        clouds = tuple(map_pair(series, one, self.variant) for one in adjacent)
        pair = _from_reference(series, adjacent)
        points, heights = self._dense(series, pair) if self.density == "dense" else self._sparse(series, pair)
        return Estimate(
            points=points,
            heights=heights,
            clouds=clouds,
            pairs=tuple(one.pair for one in adjacent),
            diagnostics=match_diagnostics(series, adjacent) | {"points": len(points)},
            warnings=skew_warnings(series, adjacent),
        )

    def _sparse(self, series: TiltSeries, pair: PairMatches) -> tuple[PointCloud, HeightMap]:
        points = _in_world(series, map_pair(series, pair, self.variant))
        return points, heights_of(series, points)

    def _dense(self, series: TiltSeries, pair: PairMatches) -> tuple[PointCloud, HeightMap]:
        """Every formula places a pixel of the first view straight above itself, so that the cloud is a height map."""
        every, sigma = dense_matches(series, pair, self.semiglobal)
        cloud = map_pair(series, every, self.variant, sigma)
        z_um, sigma_um = (one.reshape(series.optics.shape) for one in (cloud.xyz_um[:, 2], cloud.sigma_um))
        known = np.isfinite(cloud.xyz_um[:, 2])
        _check_share(series, pair, float(known.mean()))
        points = _in_world(series, cloud.keep(known))
        return points, HeightMap(z_um, sigma_um, series.optics.pixel_size_um)


@dataclass(frozen=True)
class DisparityIcp:
    """Disparity depth mapping of all adjacent pairs, brought together by point-to-point ICP.

    Parameters
    ----------
    variant, density, correspondence, semiglobal
        As for `Disparity`. Dense clouds are thinned to some ten thousand points each, on a regular grid.
    """

    variant: Variant = "printed"
    density: Density = "sparse"
    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)
    semiglobal: SemiGlobalOptions = field(default_factory=SemiGlobalOptions)

    name: ClassVar[str] = "disparity_icp"
    citation: ClassVar[str] = REHMAN
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __post_init__(self) -> None:
        _check_options(self.variant, self.density)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match adjacent views, map and register; raises `MethodError` with a sentence where it cannot."""
        return self.from_matches(series, match_adjacent_pairs(series, self.correspondence, rng))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Map and register matches that are at hand; only adjacent pairs are used."""
        adjacent = adjacent_pairs(matches, len(series))
        measured = [self._measured(series, one) for one in adjacent]
        clouds = pair_clouds_of([one for one, _ in measured], [cloud for _, cloud in measured])
        points, registration = register_pair_clouds(series, clouds)
        found: dict[str, Any] = {"points": len(points), "registration_rmse_um": registration.rmse_um}
        found |= registration_history(clouds, registration, series.optics.pixel_size_um)
        return Estimate(
            points=points,
            heights=heights_of(series, points),
            clouds=tuple(one.cloud for one in clouds),
            pairs=tuple(one.pair for one in clouds),
            diagnostics=match_diagnostics(series, adjacent) | found,
            warnings=skew_warnings(series, adjacent),
        )

    def _measured(self, series: TiltSeries, one: PairMatches) -> tuple[PairMatches, PointCloud]:
        """Make the cloud of a pair in the view frame of its first view, beside the matches it comes from."""
        if self.density == "sparse":
            return one, map_pair(series, one, self.variant)
        every, sigma = dense_matches(series, one, self.semiglobal)
        cloud = map_pair(series, every, self.variant, sigma)
        _check_share(series, one, float(np.isfinite(cloud.xyz_um[:, 2]).mean()))
        thin = _thin_grid(series.optics.shape)
        return every.keep(thin), cloud.keep(thin)


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


def map_pair(
    series: TiltSeries, one: PairMatches, variant: Variant, disparity_sigma_px: Array | None = None
) -> PointCloud:
    """Map the disparity of a pair to points in the view frame of its first view.

    Parameters
    ----------
    disparity_sigma_px
        Standard deviation of each disparity, (matches,); None is what the pair shows across the epipolar lines.

    Raises
    ------
    MethodError
        Where the views have one tilt, or the projection is not parallel.
    """
    step = float(series.tilts_deg[one.pair[1]] - series.tilts_deg[one.pair[0]])
    xy1, xy2 = one.matches.xy1_px, one.matches.xy2_px
    sigma = np.maximum((one.sigma_px if disparity_sigma_px is None else disparity_sigma_px) / np.sqrt(2), 1e-6)
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


def _thin_grid(shape: tuple[int, int]) -> Mask:
    """Every so-many-th row and column, so that at most `ICP_POINTS` pixels are left, (pixels,)."""
    step = int(np.ceil(np.sqrt(shape[0] * shape[1] / ICP_POINTS)))
    chosen = np.zeros(shape, dtype=bool)
    chosen[step // 2 :: step, step // 2 :: step] = True
    return np.asarray(chosen.ravel())


def _check_share(series: TiltSeries, one: PairMatches, share: float) -> None:
    if share < LEAST_SHARE:
        names = " and ".join(view_name(series, i) for i in one.pair)
        raise MethodError(
            f"{names}: only {share:.1%} of the pixels have a disparity that is the same from left and from right; "
            'images with more contrast or less noise would help, or density "sparse"'
        )


def _check_options(variant: str, density: str) -> None:
    for name, value, kind in (("variant", variant, Variant), ("density", density, Density)):
        if value not in get_args(kind):
            raise InputError(f"option {name} must be one of {', '.join(get_args(kind))}, not {value!r}")
