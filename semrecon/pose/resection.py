"""Later views of any orientation: pose from points, robustly, and a series that grows by it (the seed's section 6).

The seed names PnP, which needs perspective; under parallel projection the pose has five parameters, found by
`view_pose.orthographic_pose` from three points or more. This file picks out the points to believe and joins matches
between images to the points that are known already.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semrecon.data import Array, Mask, Optics, PointCloud, Poses
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um
from semrecon.pose.onp import moments, planar_lifts
from semrecon.pose.view_pose import OrthographicPose, Sightings, checked, orthographic_pose

__all__ = [
    "AddedView",
    "ResectionOptions",
    "RobustPose",
    "add_view",
    "orthographic_pose",
    "ransac_pose",
]

SCORED = 1000
"""Most points asked to score a hypothesis of a minimal set."""
FINALISTS = 12
ROUNDS = 10


@dataclass(frozen=True)
class RobustPose:
    """A pose and the sightings that support it: `inliers` (points,) is False for missing sightings, too."""

    pose: OrthographicPose
    inliers: Mask


@dataclass(frozen=True)
class ResectionOptions:
    """How a view is added.

    Parameters
    ----------
    threshold_px
        Greatest residual of an inlier beyond what the noise of its point explains.
    sigma_px
        Standard deviation of a sighting per coordinate, the one that the cloud's covariances were made with.
    join_px
        A match belongs to a point that the reference view sees no farther away than this.
    least
        Fewest inliers of a pose that is believed.
    trials
        Minimal sets tried.
    """

    threshold_px: float = 2.0
    sigma_px: float = 1.0
    join_px: float = 0.5
    least: int = 12
    trials: int = 300


@dataclass(frozen=True)
class AddedView:
    """What is known of a series after one more view.

    Parameters
    ----------
    poses
        Those given and the new one.
    pose
        The new one with its covariance and, if there is one, the alternative.
    xy_px
        Where the new view sees each point of the cloud, (points, 2); NaN where it does not or was not believed: a
        column to append to tracks whose rows are the points.
    matches, joined, inliers
        How many there were, how many met a point, how many of these agree.
    warnings
        Sentences that the user should read.
    """

    poses: Poses
    pose: OrthographicPose
    xy_px: Array
    matches: int
    joined: int
    inliers: int
    warnings: tuple[str, ...] = ()


def ransac_pose(
    xyz_um: Array,
    xy_px: Array,
    optics: Optics,
    rng: np.random.Generator,
    threshold_px: float = 2.0,
    *,
    sigma_px: float | None = None,
    covariance_um2: Array | None = None,
    trials: int = 300,
) -> RobustPose:
    """Find the pose that most sightings agree on: MSAC (Torr & Zisserman 2000) over sets of three points.

    Three points are the fewest that fix a pose, and they fix two (`onp.planar_lifts`); both are scored. The best few
    are refined on their inliers until these stay the same, each by the search over all orientations.

    Parameters
    ----------
    xyz_um, xy_px, sigma_px, covariance_um2
        As for `view_pose.orthographic_pose`.
    threshold_px
        Greatest residual of an inlier; with covariances, beyond what the noise of its point explains.
    trials
        Sets of three; 300 miss half a set of good points once in 10^17 tries, and 80 % wrong ones in one of ten.

    Raises
    ------
    InputError
        As for `orthographic_pose`, or the threshold is not positive.
    MethodError
        Fewer than four complete sightings, no four that agree, or only points on one line.
    """
    given = checked(xyz_um, xy_px, optics, sigma_px, covariance_um2)
    if not (np.isfinite(threshold_px) and threshold_px > 0):
        raise InputError(f"threshold_px must be a positive number of pixels, not {threshold_px}")
    complete = np.flatnonzero(given.complete)
    kept = given.keep(complete)
    if len(kept) < 4:
        raise MethodError(f"outliers among sightings show from 4 points on, and there are {len(kept)}")
    finalists = _finalists(kept, threshold_px, trials, rng)
    loss, agreeing = min((_settled(kept, one, threshold_px, sigma_px) for one in finalists), key=lambda found: found[0])
    if not np.isfinite(loss):
        raise MethodError(f"no 4 of {len(kept)} sightings agree on a pose within {threshold_px:g} px")
    inliers = np.zeros(len(given), dtype=bool)
    inliers[complete[agreeing]] = True
    seen = np.where(inliers[:, None], xy_px, np.nan)
    pose = orthographic_pose(xyz_um, seen, optics, sigma_px=sigma_px, covariance_um2=covariance_um2)
    return RobustPose(pose, inliers)


def add_view(
    cloud: PointCloud,
    xy_reference_px: Array,
    xy_new_px: Array,
    poses: Poses,
    optics: Optics,
    rng: np.random.Generator,
    options: ResectionOptions | None = None,
) -> AddedView:
    """Extend a series by a view of any orientation, from its matches with the reference view.

    Parameters
    ----------
    cloud
        Points in the world frame; its `xy_px` says where the reference view sees them. Finite covariances are used.
    xy_reference_px, xy_new_px
        Matches of the reference view and the new one, (matches, 2) each, as in `matching.Matches`.
    poses
        Of the views so far.
    optics
        Of the new view: a magnification of its own has a pixel size of its own.

    Raises
    ------
    InputError
        The two sides of the matches differ in number, or an option is out of range.
    MethodError
        Too few matches meet a point, or too few of these agree on a pose.
    """
    options = options or ResectionOptions()
    points, sightings = _join(cloud, xy_reference_px, xy_new_px, options.join_px)
    if len(points) < options.least:
        raise MethodError(
            f"only {len(points)} of {len(xy_reference_px)} matches with the new view meet a known point, and a pose "
            f"that can be believed needs {options.least}"
        )
    xyz, covariance = cloud.xyz_um[points], cloud.covariance_um2[points]
    known = covariance if np.isfinite(covariance).all() else None
    sigma, threshold = options.sigma_px, options.threshold_px
    found = ransac_pose(
        xyz, sightings, optics, rng, threshold, sigma_px=sigma, covariance_um2=known, trials=options.trials
    )
    agreeing = int(found.inliers.sum())
    if agreeing < options.least:
        raise MethodError(
            f"only {agreeing} of {len(points)} sightings of the new view agree on a pose within {threshold:g} px, "
            f"and one that can be believed needs {options.least}"
        )
    xy = np.full((len(cloud), 2), np.nan)
    xy[points[found.inliers]] = sightings[found.inliers]
    warnings = _warnings(found.pose, agreeing, len(points))
    extended = _extended(poses, found.pose)
    return AddedView(extended, found.pose, xy, len(xy_reference_px), len(points), agreeing, warnings)


def _finalists(given: Sightings, threshold_px: float, trials: int, rng: np.random.Generator) -> list[Mask]:
    """Inliers of the best hypotheses of minimal sets, best first."""
    asked = given if len(given) <= SCORED else given.keep(rng.choice(len(given), SCORED, replace=False))
    scored: list[tuple[float, Array, Array]] = []
    for _ in range(trials):
        chosen = given.keep(rng.choice(len(given), 3, replace=False))
        for rotation, translation in _hypotheses(chosen):
            loss = _loss(asked.distances_px(rotation, translation), threshold_px)
            scored.append((loss, rotation, translation))
    if not scored:
        raise MethodError("the points lie on one line, about which a view turns freely; give others beside it")
    scored.sort(key=lambda one: one[0])
    return [given.distances_px(rotation, t) <= threshold_px for _, rotation, t in scored[:FINALISTS]]


def _hypotheses(chosen: Sightings) -> list[tuple[Array, Array]]:
    """Both poses of three points; none where they lie on one line."""
    m = centred_um(chosen.xy_px, chosen.optics)
    try:
        rotations = planar_lifts(moments(chosen.xyz_um, m))
    except MethodError:
        return []
    return [(one, np.append((m - chosen.xyz_um @ one[:2].T).mean(axis=0), 0.0)) for one in rotations]


def _settled(given: Sightings, inliers: Mask, threshold_px: float, sigma_px: float | None) -> tuple[float, Mask]:
    """Refine on the inliers until they stay the same; the loss is infinite where fewer than four are left."""
    for _ in range(ROUNDS):
        if inliers.sum() < 4:
            return np.inf, inliers
        kept = given.keep(inliers)
        try:
            pose = orthographic_pose(
                kept.xyz_um, kept.xy_px, kept.optics, sigma_px=sigma_px, covariance_um2=kept.covariance_um2
            )
        except MethodError:
            return np.inf, inliers
        distance = given.distances_px(pose.rotation, pose.translation_um)
        previous, inliers = inliers, distance <= threshold_px
        if (inliers == previous).all():
            break
    return (_loss(distance, threshold_px), inliers) if inliers.sum() >= 4 else (np.inf, inliers)


def _loss(distance_px: Array, threshold_px: float) -> float:
    return float(np.minimum(distance_px**2, threshold_px**2).sum())


def _join(
    cloud: PointCloud, xy_reference_px: Array, xy_new_px: Array, join_px: float
) -> tuple[NDArray[np.intp], Array]:
    """Rows of the cloud that a match belongs to, and where the new view sees them; the nearest match wins a point."""
    if xy_reference_px.shape != xy_new_px.shape or xy_new_px.shape[1:] != (2,):
        raise InputError(f"matches need (n, 2) twice, not {xy_reference_px.shape} and {xy_new_px.shape}")
    rows = np.flatnonzero(np.isfinite(cloud.xy_px).all(axis=1) & np.isfinite(cloud.xyz_um).all(axis=1))
    usable = np.flatnonzero(np.isfinite(xy_reference_px).all(axis=1) & np.isfinite(xy_new_px).all(axis=1))
    if not (len(rows) and len(usable)):
        return rows[:0], xy_new_px[:0]
    distance, nearest = cKDTree(cloud.xy_px[rows]).query(xy_reference_px[usable])
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] <= join_px]
    points, first = np.unique(nearest[order], return_index=True)
    return rows[points], xy_new_px[usable[order[first]]]


def _extended(poses: Poses, pose: OrthographicPose) -> Poses:
    rotations = np.concatenate([poses.rotations, pose.rotation[None]])
    return Poses(rotations, np.concatenate([poses.translations_um, pose.translation_um[None]]))


def _warnings(pose: OrthographicPose, agreeing: int, joined: int) -> tuple[str, ...]:
    """Say what a user should doubt."""
    said = []
    if pose.alternative is not None:
        said.append(
            "the points that the new view sees lie so nearly on a plane that two orientations fit them alike; "
            "choose by what the stage says, or give points off the plane"
        )
    if not np.isfinite(pose.covariance).all():
        said.append("the new view sees a plane face-on, so that its slope is undetermined and without covariance")
    if agreeing < joined / 2:
        said.append(f"only {agreeing} of {joined} sightings of the new view agree; check its pixel size and matches")
    return tuple(said)
