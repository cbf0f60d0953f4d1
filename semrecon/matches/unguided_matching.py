"""Matches between views of which neither tilts nor tilt axis are known: every feature is compared with every other.

What the known rotation gives for free elsewhere (`correspondence`), has to come from the images here: the ratio and
mutual tests over the whole picture, then the epipolar lines that most matches agree on (`affine_epipolar`), then the
neighbours, because no residual shows an error along those lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from semrecon.data import Array, Mask, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.matches.affine_epipolar import AffineEpipolar, EpipolarOptions, fit_affine_epipolar
from semrecon.matches.correspondence import PairMatches, view_name
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.matching import Matches, MatchOptions, Nearest, select_matches
from semrecon.numerics.robust import consistent_with_neighbours

BLOCK = 512
"""Rows of the table of similarities at a time: bounds memory."""


@dataclass(frozen=True)
class UnguidedOptions:
    """How matches are found and trusted without known rotations.

    Parameters
    ----------
    features, matches
        Options of the two stages; the ratio test has the whole picture for rivals, so it is stricter than in a band.
    epipolar
        How the epipolar lines are found.
    check_neighbours
        Leave out matches that move along the lines otherwise than those around them.
    least
        Fewest matches of a pair.
    """

    features: FeatureOptions = field(default_factory=FeatureOptions)
    matches: MatchOptions = field(default_factory=MatchOptions)
    epipolar: EpipolarOptions = field(default_factory=EpipolarOptions)
    check_neighbours: bool = True
    least: int = 16


@dataclass(frozen=True)
class UnguidedMatches(PairMatches):
    """Trusted matches of two views with the epipolar lines that they showed.

    Of what is inherited, `shift_px` is the constant of their equation, and `skew` the turn of the lines (rad, from x to
    y) and the growth of their spacing from the first view to the second.

    Parameters
    ----------
    epipolar
        As found; its inliers are rows of the candidates.
    """

    epipolar: AffineEpipolar


def match_unguided(
    series: TiltSeries,
    options: UnguidedOptions,
    rng: np.random.Generator,
    *,
    features: Sequence[Features] | None = None,
    pairs: Sequence[tuple[int, int]] | None = None,
) -> tuple[UnguidedMatches, ...]:
    """Match all pairs of views, or those asked for; pairs that fail are left out while the others connect all views.

    Parameters
    ----------
    features
        Of every view, where they are at hand.

    Raises
    ------
    InputError
        With fewer than two views.
    MethodError
        Where a pair that is needed has too few matches or no parallax, or a view is blank.
    """
    if len(series) < 2:
        raise InputError(f"matching needs at least two views, not {len(series)}")
    features = features or [detect_features(view, options.features) for view in series.views]
    pairs = list(combinations(range(len(series)), 2)) if pairs is None else pairs
    found: list[UnguidedMatches] = []
    failed: dict[tuple[int, int], MethodError] = {}
    for pair, child in zip(pairs, rng.spawn(len(pairs)), strict=True):
        try:
            found.append(match_unguided_pair(series, pair, features, options, child))
        except MethodError as error:
            failed[pair] = error
    _check_connected(len(series), found, failed)
    return tuple(found)


def match_unguided_pair(
    series: TiltSeries,
    pair: tuple[int, int],
    features: Sequence[Features],
    options: UnguidedOptions,
    rng: np.random.Generator,
) -> UnguidedMatches:
    """Match two views by descriptors alone, then keep what one epipolar geometry and the neighbours support.

    Raises
    ------
    MethodError
        With fewer matches than `options.least`, or without parallax.
    """
    first, second = features[pair[0]], features[pair[1]]
    names = " and ".join(view_name(series, view) for view in pair)
    candidates = match_all(first, second, options.matches)
    if len(candidates) < options.least:
        raise MethodError(_few(len(candidates), names, first, second))
    try:
        epipolar = fit_affine_epipolar(candidates.xy1_px, candidates.xy2_px, rng, options.epipolar)
    except MethodError as error:
        raise MethodError(f"{names}: {error}") from error
    trusted = epipolar.inliers.copy()
    if options.check_neighbours:
        trusted[trusted] = _like_neighbours(candidates.keep(trusted), epipolar)
    if trusted.sum() < options.least:
        raise MethodError(_few(int(trusted.sum()), names, first, second))
    return UnguidedMatches(
        pair,
        candidates.keep(trusted),
        len(candidates),
        (len(np.unique(first.place)), len(np.unique(second.place))),
        epipolar.offset_px,
        epipolar.sigma_px,
        _skew(epipolar),
        epipolar,
    )


def match_all(first: Features, second: Features, options: MatchOptions) -> Matches:
    """Match by comparing everything with everything, block by block: as `matching.match_exhaustively`, in float32."""
    if not len(first) or not len(second):
        none = np.zeros(0, dtype=np.int64)
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)), none, none, np.zeros(0))
    forward = _nearest(first, second, options.same_place_px)
    return select_matches(first, second, forward, _nearest(second, first, options.same_place_px), options)


def _nearest(first: Features, second: Features, same_place_px: float) -> Nearest:
    """Best of all features of the second view and best rival at another place, for each of the first."""
    same = _neighbours(second.xy_px, same_place_px)
    parts = [_nearest_of_block(first.descriptors[i : i + BLOCK], second, same) for i in range(0, len(first), BLOCK)]
    best, dot, rival = (np.concatenate(column) for column in zip(*parts, strict=True))
    # rounding of float32 may lift the product of unit vectors above one
    distance, beyond = (np.sqrt(np.maximum(2 - 2 * one.astype(np.float64), 0)) for one in (dot, rival))
    return best, distance, beyond


def _nearest_of_block(
    descriptors: NDArray[np.float32], second: Features, same: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    similarity = descriptors @ second.descriptors.T
    rows = np.arange(len(similarity))
    best = similarity.argmax(axis=1)
    dot = similarity[rows, best]
    similarity[rows[:, None], same[best]] = -np.inf
    return best, dot, similarity.max(axis=1)


def _neighbours(xy_px: Array, radius_px: float) -> NDArray[np.int64]:
    """List what lies within a radius of each position: indices (n, most), filled up with the position itself."""
    pairs = cKDTree(xy_px).query_pairs(radius_px, output_type="ndarray")
    ends = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    counts = np.bincount(ends[:, 0], minlength=len(xy_px))
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    table = np.tile(np.arange(len(xy_px))[:, None], (1, int(counts.max()) + 1))
    table[ends[:, 0], np.arange(len(ends)) - start[ends[:, 0]] + 1] = ends[:, 1]
    return table


def _like_neighbours(matches: Matches, epipolar: AffineEpipolar) -> Mask:
    """Compare the motion along the lines, less that of an affine map of the whole picture, with the neighbours'."""
    across = epipolar.normal[2:] / np.linalg.norm(epipolar.normal[2:])
    motion = matches.xy2_px @ np.array([-across[1], across[0]])
    design = np.column_stack([matches.xy1_px, np.ones(len(motion))])
    trend = np.linalg.lstsq(design, motion, rcond=None)[0]
    return consistent_with_neighbours(matches.xy1_px, motion - design @ trend)


def _skew(epipolar: AffineEpipolar) -> tuple[float, float]:
    """Turn of the lines and growth of their spacing from the first view to the second."""
    one, two = -epipolar.normal[:2], epipolar.normal[2:]
    turn = np.arctan2(one[0] * two[1] - one[1] * two[0], one @ two)
    return float(turn), float(np.linalg.norm(one) / np.linalg.norm(two) - 1)


def _few(count: int, names: str, first: Features, second: Features) -> str:
    return (
        f"only {count} trustworthy matches between {names}, which have {len(np.unique(first.place))} and "
        f"{len(np.unique(second.place))} features: more contrast, less noise or a smaller tilt step would help"
    )


def _check_connected(views: int, found: Sequence[UnguidedMatches], failed: dict[tuple[int, int], MethodError]) -> None:
    """Raise the failure of the first pair between views that nothing else connects."""
    ends = np.array([one.pair for one in found], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(views, views))
    _, group = connected_components(graph, directed=False)
    missing = [pair for pair in failed if group[pair[0]] != group[pair[1]]]
    if missing:
        raise failed[min(missing, key=lambda pair: (pair[1] - pair[0], pair))]
