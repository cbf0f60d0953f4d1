"""Contenders that are handed part of the truth, and say so: they cannot stand among the methods.

Each is the known-rotation method with one stage replaced by the truth, so that the difference of two errors is what
that stage costs. They are called as ``oracle(series, truth, rng=...)``: no method has a place for `truth`. Wherever
they are shown they bear `label`, which says what they were given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import ClassVar, Protocol

import numpy as np
from scipy.spatial import cKDTree

from semrecon.clouds.registration import Registration
from semrecon.data import Array, Estimate, HeightMap, PointCloud, Poses, TiltSeries
from semrecon.geometry import CAM_FROM_VIEW, rotations_from_tilts
from semrecon.matches.correspondence import PairMatches, match_adjacent_pairs, match_pairs, pair_geometry
from semrecon.matches.features import detect_features
from semrecon.matches.matching import Index, Matches
from semrecon.matches.tracks import join_matches
from semrecon.methods.base import Gauge
from semrecon.methods.known_rotation import KnownRotation, reconstruct_pair
from semrecon.methods.pair_clouds import heights_of, pair_clouds_of, register_pair_clouds
from semrecon.numerics.motion import RigidMotion
from semrecon.numerics.robust import fit_noise
from semrecon.points.sightings import without_wrong_sightings
from semrecon.points.triangulation import triangulate
from semsim.truth import GroundTruth

ENOUGH_FEATURES = 50
"""Features of the reference view below which true matches are taken on a grid instead ..."""
GRID_PX = 8
"""... of this spacing."""


class Oracle(Protocol):
    """A contender that is handed part of the truth; `given` says which."""

    name: ClassVar[str]
    given: ClassVar[str]
    gauge: ClassVar[tuple[Gauge, ...]]

    def __call__(self, series: TiltSeries, truth: GroundTruth, *, rng: np.random.Generator) -> Estimate:
        """Reconstruct; raises as methods do."""
        ...


@dataclass(frozen=True)
class OracleMatches:
    """True matches of the places where the method finds features: what is left is rounding and geometry."""

    method: KnownRotation = field(default_factory=KnownRotation)

    name: ClassVar[str] = "oracle_matches"
    given: ClassVar[str] = "true matches"
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, truth: GroundTruth, *, rng: np.random.Generator) -> Estimate:  # noqa: ARG002
        """Follow the features of the reference view by the truth, then reconstruct from them."""
        return self.method.from_matches(series, true_matches(series, truth, _places(series, self.method)))


@dataclass(frozen=True)
class OracleTranslation:
    """Estimated matches and the true translations of all views: what is left is matching and triangulation."""

    method: KnownRotation = field(default_factory=KnownRotation)

    name: ClassVar[str] = "oracle_translation"
    given: ClassVar[str] = "true translations"
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, truth: GroundTruth, *, rng: np.random.Generator) -> Estimate:
        """Match as the method does, then triangulate with the stated rotations and the true translations."""
        pairs = list(combinations(range(len(series)), 2))
        matches = match_pairs(series, pairs, self.method.correspondence, rng, optional=True)
        rotations = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)
        poses = Poses(rotations, np.stack([pose.translation_um for pose in truth.poses]))
        tracks, sigmas = join_matches(matches, len(series)), self.method.reject_sigmas
        kept = without_wrong_sightings(tracks, poses, series.optics, sigmas=sigmas)
        cloud = triangulate(kept, poses, series.optics, reference=series.reference)
        points = cloud.keep(fit_noise(cloud.residual_px, kept.seen.sum(axis=1), sigmas=sigmas).inliers)
        heights = heights_of(series, points, poses.translations_um[series.reference])
        return Estimate(points=points, heights=heights, poses=poses, diagnostics={"points": len(points)})


@dataclass(frozen=True)
class OracleRegistration:
    """Estimated clouds of adjacent pairs, brought together by true motions: what is left is the clouds' own error."""

    method: KnownRotation = field(default_factory=lambda: KnownRotation(merge="icp"))

    name: ClassVar[str] = "oracle_registration"
    given: ClassVar[str] = "true motions between pair clouds"
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, truth: GroundTruth, *, rng: np.random.Generator) -> Estimate:
        """Match and reconstruct pair by pair as published, then register by the truth."""
        adjacent = match_adjacent_pairs(series, self.method.correspondence, rng)
        clouds = []
        kept = []
        for one in adjacent:
            cloud = reconstruct_pair(series, one)
            good = fit_noise(cloud.residual_px, np.full(len(cloud), 2), sigmas=self.method.reject_sigmas).inliers
            kept.append(one.keep(good))
            clouds.append(cloud.keep(good))
        motions = true_motions(kept, clouds, truth)
        points, found = register_pair_clouds(series, pair_clouds_of(kept, clouds), _in_turn(motions))
        diagnostics = {"points": len(points), "registration_rmse_um": found.rmse_um}
        return Estimate(points, heights_of(series, points), clouds=tuple(clouds), diagnostics=diagnostics)


ORACLES: tuple[Oracle, ...] = (OracleMatches(), OracleTranslation(), OracleRegistration())
"""What each stage costs: matching, translation, registration."""


def label(oracle: Oracle) -> str:
    """Name of an oracle wherever it is shown: it says that it cheats, and by what."""
    return f"{oracle.name} (given {oracle.given})"


def truth_as_estimate(truth: GroundTruth, view: int) -> Estimate:
    """Submit the truth itself: judging is right only if this scores zero error and full completeness.

    Parameters
    ----------
    view
        Reference view of the height map; points are in its view frame, one for every pixel that shows the surface.
    """
    buffer, pose = truth.buffers[view], truth.poses[view]
    rows, columns = np.nonzero(~buffer.miss)
    xy_px = np.column_stack([columns, rows]).astype(np.float64)
    xyz_um = buffer.position_um[rows, columns] @ pose.view_from_world.T
    unknown = np.zeros((len(xyz_um), 3, 3))
    points = PointCloud(xyz_um, unknown, np.zeros(len(xyz_um)), xy_px)
    heights = truth.height_map(view)
    poses = Poses(
        np.stack([each.rotation for each in truth.poses]), np.stack([each.translation_um for each in truth.poses])
    )
    return Estimate(points, HeightMap(heights, np.zeros_like(heights), truth.microscope.pixel_size_um), poses)


def true_matches(series: TiltSeries, truth: GroundTruth, places_px: Array) -> tuple[PairMatches, ...]:
    """Match every pair of views where the truth sees the points under places of the reference view, (n, 2) px."""
    surface = truth.surface_at(series.reference, places_px)
    tracks = np.stack([truth.image_of(view, surface) for view in range(len(series))], axis=1)
    seen = np.stack([truth.visible(view, surface) for view in range(len(series))], axis=1)
    return tuple(
        _pair(series, pair, tracks, np.flatnonzero(seen[:, pair[0]] & seen[:, pair[1]]))
        for pair in combinations(range(len(series)), 2)
    )


def true_motions(
    matches: Sequence[PairMatches], clouds: Sequence[PointCloud], truth: GroundTruth
) -> tuple[RigidMotion, ...]:
    """Motion of every pair's cloud but the first into the frame of the one before it.

    A cloud stands in the view frame of its first view, at a depth that its pair cannot know: the median difference to
    the truth under its points, which is taken out.
    """
    world = []
    for one, cloud in zip(matches, clouds, strict=True):
        view = one.pair[0]
        pose = truth.poses[view]
        shift = CAM_FROM_VIEW @ pose.translation_um
        true = truth.surface_at(view, cloud.xy_px) @ pose.view_from_world[2] + shift[2]
        shift[2] += np.nanmedian(cloud.xyz_um[:, 2] - true)
        world.append(RigidMotion(pose.view_from_world, shift).inverse)
    return tuple(fixed.inverse @ moving for fixed, moving in pairwise(world))


def _places(series: TiltSeries, method: KnownRotation) -> Array:
    """Feature positions in the reference view; a grid where there are hardly any."""
    features = detect_features(series.views[series.reference], method.correspondence.features)
    if len(features) >= ENOUGH_FEATURES:
        return features.xy_px[np.unique(features.place)]
    rows, columns = (one[::GRID_PX, ::GRID_PX].ravel() for one in np.indices(series.optics.shape))
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _pair(series: TiltSeries, pair: tuple[int, int], tracks_px: Array, both: Index) -> PairMatches:
    """Match the tracks that both views see; a track has one number in all views."""
    xy1, xy2 = tracks_px[both, pair[0]], tracks_px[both, pair[1]]
    across = pair_geometry(series, pair).offsets_px(xy1, xy2)[:, 0]
    counts = (len(tracks_px), len(tracks_px))
    matches = Matches(xy1, xy2, both, both, np.zeros(len(both)))
    return PairMatches(pair, matches, len(both), counts, float(across.mean()), float(across.std(ddof=1)), (0.0, 0.0))


def _in_turn(motions: Sequence[RigidMotion]) -> Callable[[PointCloud, PointCloud], Registration]:
    """Answer each motion when its turn comes: a sequence is registered in order."""
    left: Iterator[RigidMotion] = iter(motions)

    def register(moving: PointCloud, fixed: PointCloud) -> Registration:
        motion = next(left)
        apart = cKDTree(fixed.xyz_um).query(motion.apply(moving.xyz_um))[0]
        rmse = float(np.sqrt(np.mean(apart**2)))
        return Registration(motion.rotation, motion.translation_um, rmse, None, None, "truth")

    return register
