"""The seed's method: known rotation, translation by the linear system, triangulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any, ClassVar, Literal, cast, get_args

import numpy as np

from semrecon.adjustment.refinement import Refinement, RefinementOptions, refine
from semrecon.clouds.registration import Open3dKind, Registration, icp, icp_open3d
from semrecon.data import Estimate, PointCloud, Poses, TiltSeries, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um, rotations_from_tilts
from semrecon.matches.correspondence import CorrespondenceOptions, PairMatches, match_adjacent_pairs, match_pairs
from semrecon.matches.tracks import join_matches
from semrecon.methods.base import Gauge, Need
from semrecon.methods.pair_clouds import (
    PairCloud,
    heights_of,
    match_diagnostics,
    pair_clouds_of,
    register_pair_clouds,
    registration_history,
    skew_warnings,
)
from semrecon.methods.registration_check import compare_with_registration
from semrecon.numerics.history import CONVERGENCE, history
from semrecon.numerics.robust import NoiseFit, fit_noise
from semrecon.points.joint_translation import SeriesTranslation, solve_series
from semrecon.points.sightings import without_wrong_sightings
from semrecon.points.translation import solve_closed_form
from semrecon.points.triangulation import pair_cloud, triangulate

RegistrationKind = Literal["icp", "open3d_point_to_point", "open3d_point_to_plane", "open3d_generalized"]


@dataclass(frozen=True)
class KnownRotation:
    """Known rotation, translation by linear equations, triangulation.

    Parameters
    ----------
    correspondence
        How matches are found and trusted.
    pairs
        Match "all" pairs of views, so that points have as many sightings as can be had, or "adjacent" ones only, as
        the seed does.
    merge
        "poses": translations of all views at once, each point from all its views. "icp": the seed's published form,
        a cloud for each adjacent pair (generalised inverse, Eqs. 4 to 6), brought together by registration.
    registration
        What registers the clouds with merge "icp": ours by the rules of the seed's program ("icp"), or one of Open3D's.
    reject_sigmas
        Leave out what is as unlikely as so many standard deviations: the one sighting that the rest of its track speaks
        against, or else the whole point.
    refine
        Adjust tilts, tilt axis, magnification and rotation in the plane of the views to the images, starting from what
        is stated (bundle adjustment); only with merge "poses".
    refinement
        What is adjusted, and how well it is known beforehand.
    """

    correspondence: CorrespondenceOptions = field(default_factory=CorrespondenceOptions)
    pairs: Literal["all", "adjacent"] = "all"
    merge: Literal["poses", "icp"] = "poses"
    registration: RegistrationKind = "icp"
    reject_sigmas: float = 3.5
    refine: bool = False
    refinement: RefinementOptions = field(default_factory=RefinementOptions)

    name: ClassVar[str] = "known_rotation"
    citation: ClassVar[str] = (
        "Research on micro/nano scale 3D reconstruction based on scanning electron microscope, sections 3.2 and 3.3"
    )
    needs: ClassVar[tuple[Need, ...]] = ("rotations", "pixel_size", "tilt_axis")
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __post_init__(self) -> None:
        if self.registration not in get_args(RegistrationKind):
            raise InputError(
                f"registration must be one of {', '.join(get_args(RegistrationKind))}, not {self.registration}"
            )
        if self.refine and self.merge != "poses":
            raise InputError('option refine works on the poses of all views: it needs merge "poses", not "icp"')

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Match the views, then reconstruct; raises `MethodError` with a sentence where it cannot."""
        if self.merge == "icp" or self.pairs == "adjacent":
            return self.from_matches(series, match_adjacent_pairs(series, self.correspondence, rng))
        pairs = list(combinations(range(len(series)), 2))
        return self.from_matches(series, match_pairs(series, pairs, self.correspondence, rng, optional=True))

    def from_matches(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Reconstruct from matches that are at hand, so that several methods can share them."""
        return self._by_registration(series, matches) if self.merge == "icp" else self._by_poses(series, matches)

    def _by_poses(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Tracks over all views, all translations at once, one triangulation."""
        tracks = join_matches(matches, len(series))
        if self.refine:
            return self._by_refinement(series, matches, tracks)
        rotations = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)
        solved = solve_series(tracks, rotations, series.optics, reference=series.reference)
        kept = without_wrong_sightings(tracks, solved.poses, series.optics, sigmas=self.reject_sigmas)
        cloud = triangulate(kept, solved.poses, series.optics, reference=series.reference)
        noise = fit_noise(cloud.residual_px, kept.seen.sum(axis=1), sigmas=self.reject_sigmas)
        points = _with_noise(cloud.keep(noise.inliers), noise.sigma_px)
        clouds = self._clouds(series, matches)
        return Estimate(
            points=points,
            heights=heights_of(series, points, solved.poses.translations_um[series.reference]),
            poses=solved.poses,
            clouds=tuple(one.cloud for one in clouds),
            pairs=tuple(one.pair for one in clouds),
            diagnostics=match_diagnostics(series, matches)
            | _pose_diagnostics(tracks, kept, noise, solved)
            | _registration_check(series, clouds, solved.poses),
            warnings=skew_warnings(series, matches),
        )

    def _by_refinement(self, series: TiltSeries, matches: Sequence[PairMatches], tracks: Tracks) -> Estimate:
        """Tracks over all views, all geometry at once; the heights belong to the refined pose of the reference view."""
        options = replace(self.refinement, reject_sigmas=self.reject_sigmas)
        refined = refine(
            tracks,
            series.tilts_deg,
            series.optics,
            tilt_axis_deg=series.tilt_axis_deg,
            reference=series.reference,
            options=options,
        )
        points = refined.points.keep(np.isfinite(refined.points.residual_px))
        clouds = self._clouds(series, matches)
        return Estimate(
            points=points,
            poses=refined.poses,
            clouds=tuple(one.cloud for one in clouds),
            pairs=tuple(one.pair for one in clouds),
            diagnostics=match_diagnostics(series, matches) | _refined_diagnostics(tracks, refined),
            warnings=() if options.magnifications and options.rotations else skew_warnings(series, matches),
        )

    def _by_registration(self, series: TiltSeries, matches: Sequence[PairMatches]) -> Estimate:
        """Clouds of adjacent pairs, each in its own frame, registered to the first."""
        adjacent = _adjacent(matches)
        kept = [self._trusted(series, one) for one in adjacent]
        clouds = pair_clouds_of([one for one, _ in kept], [cloud for _, cloud in kept])
        points, registration = register_pair_clouds(series, clouds, self._register)
        found: dict[str, Any] = {
            "points": len(points),
            "rejected": sum(len(one.matches) for one in adjacent) - len(points),
            "registration": self.registration,
            "registration_rmse_um": registration.rmse_um,
        } | registration_history(clouds, registration, series.optics.pixel_size_um)
        return Estimate(
            points=points,
            heights=heights_of(series, points),
            clouds=tuple(one.cloud for one in clouds),
            pairs=tuple(one.pair for one in clouds),
            diagnostics=match_diagnostics(series, adjacent) | found,
            warnings=skew_warnings(series, adjacent),
        )

    def _clouds(self, series: TiltSeries, matches: Sequence[PairMatches]) -> tuple[PairCloud, ...]:
        """Clouds of the adjacent pairs, each in its own frame."""
        kept = [self._trusted(series, one) for one in matches if one.pair[1] == one.pair[0] + 1]
        return pair_clouds_of([one for one, _ in kept], [cloud for _, cloud in kept])

    @property
    def _register(self) -> Callable[[PointCloud, PointCloud], Registration]:
        if self.registration == "icp":
            return icp
        kind = cast(Open3dKind, self.registration.removeprefix("open3d_"))
        return partial(icp_open3d, kind=kind)

    def _trusted(self, series: TiltSeries, one: PairMatches) -> tuple[PairMatches, PointCloud]:
        """Reconstruct a pair, without what its reprojection error speaks against."""
        cloud = reconstruct_pair(series, one)
        noise = fit_noise(cloud.residual_px, np.full(len(cloud), 2), sigmas=self.reject_sigmas)
        return one.keep(noise.inliers), _with_noise(cloud.keep(noise.inliers), noise.sigma_px)


def reconstruct_pair(series: TiltSeries, one: PairMatches) -> PointCloud:
    """Reconstruct one pair as published: Eqs. 4, 5 by the generalised inverse, then Eq. 6, in its first view's frame.

    The closed form stands in for the matrix, which it equals to rounding; across the epipolar lines the median takes
    the place of the mean. The depth gauge is the generalised inverse's: least norm.
    """
    first, second = rotations_from_tilts(series.tilts_deg[list(one.pair)], series.tilt_axis_deg)
    relative = second @ first.T
    xy1, xy2 = one.matches.xy1_px, one.matches.xy2_px
    m1, m2 = centred_um(xy1, series.optics), centred_um(xy2, series.optics)
    solved = solve_closed_form(m1, m2, relative, gauge="minimum_norm")
    return pair_cloud(xy1, xy2, relative, solved.translation_um, series.optics)


def _adjacent(matches: Sequence[PairMatches]) -> tuple[PairMatches, ...]:
    adjacent = tuple(one for one in matches if one.pair[1] == one.pair[0] + 1)
    if not adjacent:
        raise MethodError("registration needs matches between views that follow each other, and there are none")
    return adjacent


def _with_noise(cloud: PointCloud, sigma_px: float) -> PointCloud:
    """Scale the covariances, made for a noise of one pixel, to the noise that was found."""
    return PointCloud(cloud.xyz_um, cloud.covariance_um2 * sigma_px**2, cloud.residual_px, cloud.xy_px)


def _pose_diagnostics(tracks: Tracks, kept: Tracks, noise: NoiseFit, solved: SeriesTranslation) -> dict[str, Any]:
    views = tracks.seen.sum(axis=1)
    return {
        "tracks": len(views),
        "tracks_by_views": {str(n): int((views == n).sum()) for n in np.unique(views)},
        "rejected": int((~noise.inliers).sum()),
        "sightings_left_out": int((tracks.seen & ~kept.seen).sum()),
        "sigma_px": noise.sigma_px,
        "rank": solved.rank,
        "condition": solved.condition,
        "depth_gauge": list(solved.gauge),
    }


def _registration_check(series: TiltSeries, clouds: Sequence[PairCloud], poses: Poses) -> dict[str, Any]:
    """Hold registration of adjacent pairs against the poses: what merge "icp" would do differently."""
    compared = compare_with_registration(clouds, poses, series.optics)
    return {"registration_check": [one.reported for one in compared]} if compared else {}


def _refined_diagnostics(tracks: Tracks, refined: Refinement) -> dict[str, Any]:
    """Geometry as refined, each number with its standard deviation, and what the images leave open."""
    views = tracks.seen.sum(axis=1)
    return {
        "tracks": len(tracks),
        "tracks_by_views": {str(n): int((views == n).sum()) for n in np.unique(views)},
        "rejected": int((~np.isfinite(refined.points.xyz_um).all(axis=1)).sum()),
        "sigma_px": refined.sigma_px,
        "refinement": {
            "tilts_deg": refined.tilts_deg,
            "tilt_sigma_deg": refined.tilt_sigma_deg,
            "tilt_steps_deg": np.diff(refined.tilts_deg),
            "tilt_step_sigma_deg": refined.tilt_step_sigma_deg,
            "tilt_axis_deg": refined.tilt_axis_deg,
            "tilt_axis_sigma_deg": refined.axis_sigma_deg,
            "magnifications": refined.magnifications,
            "magnification_sigma": refined.magnification_sigma,
            "rotations_deg": refined.rotations_deg,
            "rotation_sigma_deg": refined.rotation_sigma_deg,
            "shifts_um": refined.shifts_um,
            "shift_sigma_um": refined.shift_sigma_um,
            "unobservable": refined.unobservable,
            "iterations": refined.iterations,
            "converged": refined.converged,
        },
        CONVERGENCE: [history("bundle adjustment", refined.history_px)],
    }
