"""Two views of a pinhole camera: matches that an essential matrix explains, and the relative poses that it allows."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Mask, TiltSeries
from semrecon.errors import MethodError
from semrecon.matches.correspondence import PairMatches
from semrecon.matches.features import FeatureOptions, detect_features
from semrecon.matches.matching import Matches, MatchOptions
from semrecon.matches.unguided_matching import match_all
from semrecon.numerics.robust import consistent_with_neighbours
from semrecon.perspective.pinhole import Pinholes, in_front, intersect
from semrecon.perspective.pinhole_bundle import bundle, robust_cost

MOST = 300
"""Matches that attempts at a pair are compared by."""


@dataclass(frozen=True)
class EssentialOptions:
    """How pairs and later views are placed.

    Parameters
    ----------
    features, matches
        How candidates are found, each feature against all others.
    threshold_px
        Greatest distance of an inlier from its epipolar line, and of a point's sightings from its projections.
    trials
        Most samples of five matches.
    limits_px
        Distances of an inlier, one for each attempt at a pair: where there is little perspective, attempts differ.
    starts
        So many pairs are tried as the first; the answer that explains most sightings counts.
    least
        Fewest matches of a pair, and fewest points of a later view.
    check_neighbours
        Leave out matches that move otherwise than those around them.
    adjust
        Optimise cameras and points after every view (bundle adjustment).
    """

    features: FeatureOptions = field(default_factory=FeatureOptions)
    matches: MatchOptions = field(default_factory=MatchOptions)
    threshold_px: float = 1.5
    trials: int = 5000
    limits_px: tuple[float, ...] = (0.3, 0.7, 1.5)
    starts: int = 2
    least: int = 16
    check_neighbours: bool = True
    adjust: bool = True


def verified_pairs(
    series: TiltSeries, focal_px: float, options: EssentialOptions, rng: np.random.Generator
) -> tuple[PairMatches, ...]:
    """Match all pairs of views and keep what an essential matrix and the neighbours support.

    Raises
    ------
    MethodError
        Where no pair has matches enough, or a view is blank.
    """
    features = [detect_features(view, options.features) for view in series.views]
    places = [len(np.unique(one.place)) for one in features]
    pairs = list(combinations(range(len(series)), 2))
    found = []
    for pair, child in zip(pairs, rng.spawn(len(pairs)), strict=True):
        first, second = pair
        candidates = match_all(features[first], features[second], options.matches)
        kept = _ordered(candidates, child.permutation(len(candidates)))  # samples go by number: the seed decides
        kept = kept.keep(essential_inliers(kept, series.optics.centre_px, focal_px, options.threshold_px, options)[1])
        kept = _ordered(kept, np.argsort(kept.index1, kind="stable"))
        kept = kept.keep(_like_neighbours(kept)) if options.check_neighbours else kept
        if len(kept) >= options.least:
            counts = (places[first], places[second])
            found.append(PairMatches(pair, kept, len(candidates), counts, float("nan"), float("nan"), (np.nan, np.nan)))
    if not found:
        raise MethodError(
            f"no two views have {options.least} matches that an essential matrix explains; images with more contrast, "
            "less noise or smaller tilt steps would help"
        )
    return tuple(found)


def essential_inliers(
    matches: Matches, centre_px: Array, focal_px: float, limit_px: float, options: EssentialOptions
) -> tuple[Array | None, Mask]:
    """Find the essential matrix that most matches obey: five points a sample (Nister 2004), RANSAC.

    Returns
    -------
    (3, 3), or None where there is none; and the inliers, (matches,).
    """
    import cv2

    nothing = None, np.zeros(len(matches), dtype=np.bool_)
    if len(matches) < options.least:
        return nothing
    one, two = ((xy - centre_px) / focal_px for xy in (matches.xy1_px, matches.xy2_px))
    limit = limit_px / focal_px
    matrix, mask = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, 0.9999, limit, options.trials)
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return nothing
    return np.asarray(matrix, dtype=np.float64), mask.ravel() > 0


def best_pair(
    series: TiltSeries, matches: PairMatches, focal_px: float, options: EssentialOptions, rng: np.random.Generator
) -> Pinholes | None:
    """Place two views several times over, adjust each attempt, and keep the one that explains most matches.

    Where perspective is weak, one matrix may come out far from another, and the adjustment gets stuck on the way.
    """
    best, least = None, float("inf")
    few = _ordered(matches.matches, rng.permutation(len(matches.matches))[:MOST])
    for limit_px in options.limits_px:
        few = _ordered(few, rng.permutation(len(few)))
        cameras = place_pair(
            series, PairMatches(matches.pair, few, 0, (0, 0), 0.0, 0.0, (0.0, 0.0)), focal_px, limit_px, options
        )
        if cameras is None:
            continue
        xy_px = sightings(few, matches.pair, len(series))
        xyz = intersect(xy_px, cameras)[0]
        good = in_front(xyz, cameras) & np.isfinite(xyz).all(axis=1)
        xyz, cameras = bundle(xy_px[good], xyz[good], cameras, robust_px=options.threshold_px / 2)
        cost = robust_cost(xy_px, intersect(xy_px, cameras)[0], cameras, options.threshold_px / 2)
        best, least = (cameras, cost) if cost < least else (best, least)
    return best


def sightings(matches: Matches, pair: tuple[int, int], views: int) -> Array:
    """Write matches of a pair as tracks of all views, (matches, views, 2)."""
    xy_px = np.full((len(matches), views, 2), np.nan)
    xy_px[:, pair[0]], xy_px[:, pair[1]] = matches.xy1_px, matches.xy2_px
    return xy_px


def place_pair(
    series: TiltSeries, matches: PairMatches, focal_px: float, limit_px: float, options: EssentialOptions
) -> Pinholes | None:
    """Decompose the essential matrix into four relative poses; the one with most points in front of both wins."""
    import cv2

    centre, views, (first, second) = series.optics.centre_px, len(series), matches.pair
    matrix, inliers = essential_inliers(matches.matches, centre, focal_px, limit_px, options)
    if matrix is None or inliers.sum() < options.least:
        return None
    one, two, direction = cv2.decomposeEssentialMat(matrix)
    xy_px = sightings(matches.matches.keep(inliers), matches.pair, views)
    best, most = None, options.least - 1
    for rotation, sign in product((one, two), (1.0, -1.0)):
        rotations, shifts = np.full((views, 3, 3), np.nan), np.full((views, 3), np.nan)
        rotations[first], shifts[first] = np.eye(3), 0.0
        rotations[second], shifts[second] = rotation, sign * np.asarray(direction).ravel()
        cameras = Pinholes(rotations, shifts, focal_px, centre)
        count = int(in_front(intersect(xy_px, cameras)[0], cameras).sum())
        best, most = (cameras, count) if count > most else (best, most)
    return best


def beyond_homography(matches: Matches, threshold_px: float) -> int:
    """Count the matches that no homography explains: what shows parallax (Snavely et al. 2006 start there)."""
    import cv2

    found, mask = cv2.findHomography(matches.xy1_px, matches.xy2_px, cv2.RANSAC, threshold_px, maxIters=2000)
    return len(matches) if found is None else int((mask.ravel() == 0).sum())


def _ordered(matches: Matches, order: NDArray[np.int64]) -> Matches:
    """Take matches by number."""
    xy1_px, xy2_px = matches.xy1_px[order], matches.xy2_px[order]
    return Matches(xy1_px, xy2_px, matches.index1[order], matches.index2[order], matches.distance[order])


def _like_neighbours(matches: Matches) -> Mask:
    """Compare the motion beyond an affine map, along its main direction, with the neighbours'."""
    if len(matches) < 4:
        return np.ones(len(matches), dtype=np.bool_)
    design = np.column_stack([matches.xy1_px, np.ones(len(matches))])
    rest = matches.xy2_px - design @ np.linalg.lstsq(design, matches.xy2_px, rcond=None)[0]
    along = np.linalg.svd(rest, full_matrices=False)[2][0]
    return consistent_with_neighbours(matches.xy1_px, rest @ along)
