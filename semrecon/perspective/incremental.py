"""Incremental structure from motion: a pair to start from, then every other view by its pose from points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semrecon.data import Array, TiltSeries, Tracks
from semrecon.errors import MethodError
from semrecon.matches.correspondence import PairMatches, view_name
from semrecon.matches.tracks import join_matches
from semrecon.perspective.essential import EssentialOptions, best_pair, beyond_homography
from semrecon.perspective.pinhole import PinholeReconstruction, Pinholes, in_front, intersect, residual_px
from semrecon.perspective.pinhole_bundle import bundle, robust_cost


def incremental(
    series: TiltSeries,
    pairs: Sequence[PairMatches],
    focal_px: float,
    options: EssentialOptions,
    rng: np.random.Generator,
) -> PinholeReconstruction:
    """Grow from each of the pairs that a homography explains least; the answer that explains most sightings counts.

    Raises
    ------
    MethodError
        Where no pair gives a pose, or the reference view sees too few points.
    """
    tracks = join_matches(pairs, len(series)).xy_px
    ranked = sorted(pairs, key=lambda one: -beyond_homography(one.matches, options.threshold_px))
    grown: list[tuple[tuple[int, float], PinholeReconstruction]] = []
    for one, child in zip(ranked, rng.spawn(len(ranked)), strict=True):
        cameras = best_pair(series, one, focal_px, options, child) if len(grown) < options.starts else None
        found = None if cameras is None else _grown(tracks, cameras, one.pair, options)
        if found is not None:
            cost = robust_cost(tracks, intersect(tracks, found.cameras)[0], found.cameras, options.threshold_px / 2)
            grown.append(((-int(found.cameras.placed.sum()), cost), found))
    if not grown:
        raise MethodError("no pair of views has an essential matrix that puts its points in front of both cameras")
    with_reference = [one for one in grown if one[1].cameras.placed[series.reference]]
    if not with_reference:
        raise MethodError(f"{view_name(series, series.reference)}, the reference view, sees too few of the points")
    return min(with_reference, key=lambda one: one[0])[1]


def _grown(
    tracks: Array, cameras: Pinholes, start: tuple[int, int], options: EssentialOptions
) -> PinholeReconstruction | None:
    """Add the view that sees most points until none can be added."""
    xyz, cameras = _settled(tracks, cameras, options)
    refused: set[int] = set()
    while left := [int(view) for view in np.flatnonzero(~cameras.placed) if int(view) not in refused]:
        known = np.isfinite(xyz).all(axis=1)
        counts = [int((known & np.isfinite(tracks[:, view, 0])).sum()) for view in left]
        view = left[int(np.argmax(counts))]
        more = place_view(tracks, xyz, cameras, view, options)
        if more is None:
            refused.add(view)
            continue
        xyz, cameras = _settled(tracks, more, options)
        refused.clear()
    return _finished(tracks, xyz, cameras, start)


def place_view(tracks: Array, xyz: Array, cameras: Pinholes, view: int, options: EssentialOptions) -> Pinholes | None:
    """Find a later view from points that it sees: perspective pose from points, RANSAC, then least squares.

    Parameters
    ----------
    tracks, xyz
        Sightings (n, views, 2) of points (n, 3); NaN where missing.
    """
    import cv2

    known = np.isfinite(tracks[:, view]).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if known.sum() < options.least:
        return None
    ray, scene = (tracks[known, view] - cameras.centre_px) / cameras.focal_px, xyz[known]
    limit = 2 * options.threshold_px / cameras.focal_px
    found, turn, shift, inliers = cv2.solvePnPRansac(
        scene, ray, np.eye(3), None, iterationsCount=2000, reprojectionError=limit, flags=cv2.SOLVEPNP_EPNP
    )
    if not found or inliers is None or len(inliers) < options.least:
        return None
    used = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(scene[used], ray[used], np.eye(3), None, turn, shift)
    rotations, shifts = cameras.rotations.copy(), cameras.translations.copy()
    rotations[view], shifts[view] = cv2.Rodrigues(turn)[0], np.asarray(shift).ravel()
    return replace(cameras, rotations=rotations, translations=shifts) if np.isfinite(shift).all() else None


def _settled(tracks: Array, cameras: Pinholes, options: EssentialOptions) -> tuple[Array, Pinholes]:
    """Intersect the beams of placed views and adjust the whole; points that do not fit are NaN."""
    for _ in range(2 if options.adjust else 0):
        xyz = _fitting(tracks, cameras, options)
        good = np.isfinite(xyz).all(axis=1)
        if good.sum() < options.least:
            break
        _, cameras = bundle(tracks[good], xyz[good], cameras, robust_px=options.threshold_px / 2)
    return _fitting(tracks, cameras, options), cameras


def _fitting(tracks: Array, cameras: Pinholes, options: EssentialOptions) -> Array:
    xyz = intersect(tracks, cameras)[0]
    good = in_front(xyz, cameras) & (residual_px(tracks, xyz, cameras) <= options.threshold_px)
    return np.where(good[:, None], xyz, np.nan)


def _finished(tracks: Array, xyz: Array, cameras: Pinholes, start: tuple[int, int]) -> PinholeReconstruction | None:
    good = np.isfinite(xyz).all(axis=1)
    if good.sum() < 3:
        return None
    seen = Tracks(np.where(cameras.placed[:, None], tracks[good], np.nan))
    points, covariance = intersect(seen.xy_px, cameras)
    return PinholeReconstruction(cameras, points, covariance, seen.xy_px, start)
