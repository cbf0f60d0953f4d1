"""Later views of any orientation (the seed's section 6): images of which nobody knows how the specimen stood.

Each image is matched freely with the views whose poses are known; matches at reconstructed points give a pose by
resection, and its magnification is checked. Views that were posed help the others in a next round, so that a view that
shares nothing with the series may come by way of another. The order in which images are given does not matter.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from semrecon.data import Array, Image, Optics, PointCloud, Poses, Tracks, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import back_project, nominal_poses, project
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.matching import Matches, MatchOptions
from semrecon.matches.unguided_matching import match_all
from semrecon.numerics.motion import rotation_angle_rad
from semrecon.points.triangulation import triangulate
from semrecon.pose.magnified_pose import MagnifiedPose, fit_pose
from semrecon.pose.view_pose import OrthographicPose
from semrecon.reconstruction import Reconstruction, jsonable
from semrecon.surface.completion import is_sparse

LEAST_BASELINE_DEG = 2.0


@dataclass(frozen=True)
class LaterViewOptions:
    """How later views are posed.

    Parameters
    ----------
    features, matches
        Features are described along their own gradients, so that a view may be turned in its plane.
    most_views
        Known views that an image is matched with, evenly over the series.
    join_px
        A match belongs to a point that the known view sees no farther away than this.
    least
        Fewest sightings that agree on a pose that is believed.
    trials
        Minimal sets tried.
    pixel_size_um
        Of the later images; None takes that of the series.
    """

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(max_features=5000, upright=False))
    matches: MatchOptions = field(default_factory=lambda: MatchOptions(ratio=0.8))
    most_views: int = 8
    join_px: float = 1.0
    least: int = 20
    trials: int = 400
    pixel_size_um: float | None = None


@dataclass(frozen=True)
class LaterView:
    """What was found about an image; where `failure` is a sentence, `pose` and `points` are None.

    Parameters
    ----------
    name
        Of the image.
    pose
        R_cam_from_world and t with covariance; None for a failure.
    optics
        Grid of the image; its pixel size is the one that the pose goes with.
    magnification, magnification_sigma
        By which the image is larger than its stated pixel size says. It is put right in `optics` only where it differs
        from 1 for sure, and then `warnings` says so.
    matches, joined, inliers
        Matches with all known views, those that met a point, and those of them that agree on the pose.
    residual_px
        Median distance of the agreeing sightings from the reprojected points.
    nearest, angle_deg
        Known view with most matches, and the angle from its orientation to this one.
    points
        Points that were not known before and that this view and two others see.
    """

    name: str
    pose: OrthographicPose | None
    optics: Optics
    magnification: float = float("nan")
    magnification_sigma: float = float("nan")
    matches: int = 0
    joined: int = 0
    inliers: int = 0
    residual_px: float = float("nan")
    nearest: str = ""
    angle_deg: float = float("nan")
    points: PointCloud | None = None
    warnings: tuple[str, ...] = ()
    failure: str = ""

    @property
    def sigma_deg(self) -> Array:
        """Standard deviation of the orientation about the camera's x, y and z axes, (3,); NaN for a failure."""
        if self.pose is None:
            return np.full(3, np.nan)
        return np.asarray(np.rad2deg(np.sqrt(np.diag(self.pose.covariance)[:3])))


@dataclass(frozen=True)
class _Known:
    """A view of known pose."""

    name: str
    features: Features
    rotation: Array
    translation_um: Array
    optics: Optics


@dataclass(frozen=True)
class _Ties:
    """Where an image sees known points: (n, 3) um with covariance, (n, 2) px; and how large both drew the feature."""

    xyz_um: Array
    covariance_um2: Array
    xy_px: Array
    feature: Array
    size_ratio: Array


def pose_later_views(
    result: Reconstruction,
    images: Sequence[tuple[str, Image]],
    rng: np.random.Generator,
    options: LaterViewOptions | None = None,
) -> tuple[LaterView, ...]:
    """Find the pose of images of unknown orientation from a finished reconstruction.

    Parameters
    ----------
    result
        Its points and poses are taken as they are; no image changes them.
    images
        Name and grey values (rows, columns) of each; sizes may differ from those of the series.

    Returns
    -------
    One answer an image, in their order. What cannot be posed says why in `failure`.

    Raises
    ------
    InputError
        The pixel size is not a positive number.
    """
    options = options or LaterViewOptions()
    seed = int(rng.integers(2**63))
    known = _known_views(result, options)
    waiting = {i: _seen(name, image, result.series.optics, options) for i, (name, image) in enumerate(images)}
    answers = {i: LaterView(view.name, None, view.optics, failure=sentence) for i, (view, sentence) in waiting.items()}
    waiting = {i: (view, sentence) for i, (view, sentence) in waiting.items() if not sentence}
    while waiting:
        found = {i: _answer(view, known, result, options, seed) for i, (view, _) in waiting.items()}
        answers |= {i: answer for i, (answer, _) in found.items()}
        posed = {i: view for i, (_, view) in found.items() if view is not None}
        known = [*known, *posed.values()]
        waiting = {i: view for i, view in waiting.items() if i not in posed} if posed else {}
    return tuple(answers[i] for i in range(len(images)))


def later_views_report(views: Sequence[LaterView]) -> list[dict[str, Any]]:
    """Put later views into numbers and short words, ready for strict JSON."""
    plain = jsonable([_plain(view) for view in views])
    assert isinstance(plain, list)
    return plain


def with_later_views(result: Reconstruction, views: Sequence[LaterView]) -> Reconstruction:
    """Add what later views say: poses to the report, points to the cloud, sentences for the user."""
    clouds = [result.points, *(view.points for view in views if view.points is not None)]
    points = PointCloud(
        np.concatenate([cloud.xyz_um for cloud in clouds]),
        np.concatenate([cloud.covariance_um2 for cloud in clouds]),
        np.concatenate([cloud.residual_px for cloud in clouds]),
        np.concatenate([cloud.xy_px for cloud in clouds]),
    )
    said = [f"{view.name}: {sentence}" for view in views for sentence in (view.failure, *view.warnings) if sentence]
    later = (*result.later_views, *later_views_report(views))
    return replace(result, points=points, later_views=later, warnings=(*result.warnings, *said))


def _plain(view: LaterView) -> dict[str, Any]:
    if view.pose is None:
        return {"image": view.name, "failure": view.failure}
    return {
        "image": view.name,
        "rotation_cam_from_world": view.pose.rotation,
        "translation_um": view.pose.translation_um,
        "rotation_sigma_deg": view.sigma_deg,
        "translation_sigma_um": np.sqrt(np.diag(view.pose.covariance)[3:]),
        "pixel_size_um": view.optics.pixel_size_um,
        "magnification": view.magnification,
        "magnification_sigma": view.magnification_sigma,
        "nearest": view.nearest,
        "angle_to_nearest_deg": view.angle_deg,
        "matches": view.matches,
        "joined": view.joined,
        "inliers": view.inliers,
        "residual_median_px": view.residual_px,
        "sigma_px": view.pose.sigma_px,
        "new_points": 0 if view.points is None else len(view.points),
        "warnings": view.warnings,
    }


def _known_views(result: Reconstruction, options: LaterViewOptions) -> list[_Known]:
    """Evenly chosen views of the series, the reference among them, with their features."""
    series = result.series
    poses = result.estimate.poses or nominal_poses(series)
    n = len(series)
    order = np.argsort(series.tilts_deg, kind="stable")
    even = order[np.unique(np.linspace(0, n - 1, min(options.most_views, n)).round().astype(int))]
    chosen = np.unique([*even, series.reference])
    return [
        _Known(
            series.views[i].name or f"view {i}",
            detect_features(series.views[i], options.features),
            poses.rotations[i],
            poses.translations_um[i],
            series.optics,
        )
        for i in chosen
    ]


def _seen(name: str, image: Image, optics: Optics, options: LaterViewOptions) -> tuple[_Known, str]:
    """Features of an image, its pose not yet known; or a sentence why there are none."""
    size_um = optics.pixel_size_um if options.pixel_size_um is None else options.pixel_size_um
    if image.ndim != 2:
        raise InputError(f"{name} must be one grey image, not of shape {image.shape}")
    grid = Optics(size_um, image.shape[1], image.shape[0], optics.inverse_working_distance)
    nothing = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32), np.zeros(0, np.int64))
    view = _Known(name, nothing, np.full((3, 3), np.nan), np.full(3, np.nan), grid)
    try:
        return replace(view, features=detect_features(View(image, 0.0, name), options.features)), ""
    except MethodError as error:
        return view, str(error)


def _answer(
    view: _Known, known: Sequence[_Known], result: Reconstruction, options: LaterViewOptions, seed: int
) -> tuple[LaterView, _Known | None]:
    """Pose one image; its randomness comes from what it shows, not from when its turn is."""
    rng = np.random.default_rng([seed, zlib.crc32(view.features.xy_px.tobytes())])
    matches = [match_all(view.features, one.features, options.matches) for one in known]
    ties = _ties(view, known, matches, result, options.join_px)
    counts = [len(one) for one in matches]
    nearest = known[int(np.argmax(counts))]
    answer = LaterView(view.name, None, view.optics, matches=sum(counts), joined=len(ties.xyz_um), nearest=nearest.name)
    if len(ties.xyz_um) < options.least:
        sentence = (
            f"{view.name}: only {len(ties.xyz_um)} of {sum(counts)} matches with the known views meet a reconstructed "
            f"point, and a pose that can be believed needs {options.least}; a view between would help"
        )
        return replace(answer, failure=sentence), None
    try:
        found = fit_pose(
            ties.xyz_um,
            ties.xy_px,
            ties.covariance_um2,
            view.optics,
            float(np.median(ties.size_ratio)),
            rng,
            options.trials,
        )
    except MethodError as error:
        return replace(answer, failure=f"{view.name}: {error}"), None
    if found.inliers.sum() < options.least:
        sentence = (
            f"{view.name}: only {int(found.inliers.sum())} of {len(ties.xyz_um)} sightings agree on a pose, and one "
            f"that can be believed needs {options.least}; a view between would help"
        )
        return replace(answer, failure=sentence), None
    posed = replace(view, rotation=found.pose.rotation, translation_um=found.pose.translation_um, optics=found.optics)
    points = _new_points(posed, known, matches, ties, found, result.series.optics)
    return _told(answer, found, nearest, points), posed


def _told(answer: LaterView, found: MagnifiedPose, nearest: _Known, points: PointCloud) -> LaterView:
    """Complete the answer of a pose that was found."""
    residual = found.pose.residual_px[found.inliers]
    return replace(
        answer,
        pose=found.pose,
        optics=found.optics,
        magnification=found.magnification,
        magnification_sigma=found.magnification_sigma,
        inliers=int(found.inliers.sum()),
        residual_px=float(np.median(residual)),
        angle_deg=float(np.rad2deg(rotation_angle_rad(found.pose.rotation @ nearest.rotation.T))),
        points=points,
        warnings=tuple(f"{answer.name}: {sentence}" for sentence in found.warnings),
    )


def _ties(
    view: _Known, known: Sequence[_Known], matches: Sequence[Matches], result: Reconstruction, join_px: float
) -> _Ties:
    """Join matches with known views to points; each point and each feature takes part once, by its best."""
    cloud = result.points.keep(np.asarray(np.isfinite(result.points.xyz_um).all(axis=1)))
    sparse = is_sparse(cloud, result.heights)
    parts = [_joined(one, match, cloud, sparse, join_px) for one, match in zip(known, matches, strict=True)]
    point, xyz, covariance, feature, distance, size = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(distance, kind="stable")
    order = order[np.sort(np.unique(point[order], return_index=True)[1])]
    order = order[np.sort(np.unique(feature[order], return_index=True)[1])]
    feature = feature[order].astype(np.int64)
    ratio = view.features.scale_px[feature] / size[order]
    return _Ties(xyz[order], covariance[order], view.features.xy_px[feature], feature, ratio)


def _joined(one: _Known, match: Matches, cloud: PointCloud, sparse: bool, join_px: float) -> tuple[Array, ...]:
    """Points that matched features of a known view show: row, position, covariance, the image's feature, and so on.

    Points of a sparse method were measured at features. Between the pixels of a dense one the place is that of the
    feature, and only the depth along the beam is the neighbour's.
    """
    seen = project(cloud.xyz_um, one.rotation, one.translation_um, one.optics)
    near = cKDTree(seen).query(match.xy2_px, distance_upper_bound=join_px)[1]
    met = near < len(cloud)
    row = near[met]
    xyz, covariance = cloud.xyz_um[row], cloud.covariance_um2[row]
    if not sparse:
        depth = xyz @ one.rotation[2] + one.translation_um[2]
        xyz = back_project(match.xy2_px[met], depth, one.rotation, one.translation_um, one.optics)
    return row, xyz, covariance, match.index1[met], match.distance[met], one.features.scale_px[match.index2[met]]


def _new_points(
    view: _Known, known: Sequence[_Known], matches: Sequence[Matches], ties: _Ties, found: MagnifiedPose, optics: Optics
) -> PointCloud:
    """Intersect the beams of features that met no point and that two known views or more share with this one."""
    views = [*known, view]
    xy = np.full((len(view.features), len(views), 2), np.nan)
    for column, match in enumerate(matches):
        xy[match.index1, column] = _on_grid(match.xy2_px, known[column].optics, optics)
    xy[:, -1] = _on_grid(view.features.xy_px, view.optics, optics)
    shared = np.isfinite(xy[:, :-1, 0]).sum(axis=1) >= 2
    shared[ties.feature] = False  # these are known already
    poses = Poses(np.stack([one.rotation for one in views]), np.stack([one.translation_um for one in views]))
    sigma = found.pose.sigma_px
    cloud = triangulate(Tracks(xy[shared]), poses, optics, sigma_px=sigma)
    spread = np.deg2rad(LEAST_BASELINE_DEG)
    good = (cloud.residual_px <= 2 * sigma) & (cloud.sigma_um <= sigma * optics.pixel_size_um / spread)
    return cloud.keep(np.asarray(good))


def _on_grid(xy_px: Array, own: Optics, common: Optics) -> Array:
    """Positions on the grid of the series: the same lengths from the middle of the image."""
    return np.asarray(common.centre_px + (xy_px - own.centre_px) * (own.pixel_size_um / common.pixel_size_um))
