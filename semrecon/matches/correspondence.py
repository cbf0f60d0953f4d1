"""From micrographs to matches that can be trusted: one way for all methods, so that they differ in geometry alone.

Features of every view; a coarse search over a wide band, because the stage shifts by an unknown amount; the shift
across the epipolar lines by vote; a fine search in a narrow band about it; then what disagrees is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from semrecon.data import Array, Mask, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.matches.drift import DriftOptions, find_window
from semrecon.matches.epipolar import Epipolar, epipolar_geometry
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.matching import Matches, MatchOptions, match_features
from semrecon.numerics.robust import consistent_with_neighbours, fit_offset


@dataclass(frozen=True)
class CorrespondenceOptions:
    """How matches are found and trusted.

    Parameters
    ----------
    features, matches
        Options of the two stages.
    drift
        How the shift of the stage is found, and how far about it the fine search goes.
    inlier_px
        Greatest distance of a match from its epipolar line.
    check_neighbours
        Leave out matches whose disparity differs from that of their neighbours: two views see no error along the lines.
    least
        Fewest matches of a pair.
    """

    features: FeatureOptions = field(default_factory=FeatureOptions)
    matches: MatchOptions = field(default_factory=MatchOptions)
    drift: DriftOptions = field(default_factory=DriftOptions)
    inlier_px: float = 2.0
    check_neighbours: bool = True
    least: int = 12


@dataclass(frozen=True)
class PairMatches:
    """Trusted matches of two views.

    Parameters
    ----------
    pair
        Indices of the views.
    matches
        What can be trusted.
    candidates
        How many matches the fine search found.
    features
        How many places each view has.
    shift_px
        Offset across the epipolar lines that the matches share.
    sigma_px
        Standard deviation across the lines: the noise of two positions together.
    skew
        How that offset changes along and across the lines, px a px: 0 where the rotation, the tilt axis and the
        magnification are as stated.
    """

    pair: tuple[int, int]
    matches: Matches
    candidates: int
    features: tuple[int, int]
    shift_px: float
    sigma_px: float
    skew: tuple[float, float]

    def keep(self, mask: Mask) -> PairMatches:
        """Select matches by a boolean mask; what was measured on all of them stays."""
        return replace(self, matches=self.matches.keep(mask))


def match_adjacent_pairs(
    series: TiltSeries, options: CorrespondenceOptions, rng: np.random.Generator
) -> tuple[PairMatches, ...]:
    """Match each view with the next one, in order of capture (the seed's section 4.1, step 2).

    Raises
    ------
    MethodError
        Where a pair has too few matches, a view is blank or two neighbours have the same tilt.
    """
    return match_pairs(series, [(i, i + 1) for i in range(len(series) - 1)], options, rng)


def match_pairs(
    series: TiltSeries,
    pairs: Sequence[tuple[int, int]],
    options: CorrespondenceOptions,
    rng: np.random.Generator,
    *,
    optional: bool = False,
) -> tuple[PairMatches, ...]:
    """Match the pairs of views asked for; each pair draws from its own stream, so that their order does not matter.

    Parameters
    ----------
    pairs
        View indices.
    optional
        Leave out pairs that have too few matches or no parallax, as long as the others connect all views.

    Raises
    ------
    InputError
        With fewer than two views.
    MethodError
        Where a pair that is needed has too few matches or no parallax, or a view is blank.
    """
    if len(series) < 2:
        raise InputError(f"a tilt series needs at least two views, not {len(series)}")
    features = [detect_features(view, options.features) for view in series.views]
    found: list[PairMatches] = []
    failed: dict[tuple[int, int], MethodError] = {}
    for pair, child in zip(pairs, rng.spawn(len(pairs)), strict=True):
        try:
            found.append(match_pair(series, pair, features, options, child))
        except MethodError as error:
            if not optional:
                raise
            failed[pair] = error
    _check_connected(series, found, failed)
    return tuple(found)


def match_pair(
    series: TiltSeries,
    pair: tuple[int, int],
    features: Sequence[Features],
    options: CorrespondenceOptions,
    rng: np.random.Generator,
) -> PairMatches:
    """Match two views: coarse search, vote, fine search, trust.

    Raises
    ------
    MethodError
        With fewer matches than `options.least`, or no more than chance would give.
    """
    epipolar = pair_geometry(series, pair)
    first, second = features[pair[0]], features[pair[1]]
    longest = max(series.optics.shape)
    window, voters = find_window(first, second, epipolar, longest, options.drift, options.matches, rng)
    if window is None or voters < options.least:
        raise _too_few(series, pair, voters, features)
    candidates = match_features(first, second, epipolar, window, options.matches)
    if len(candidates) < options.least:
        raise _too_few(series, pair, len(candidates), features)
    offsets = epipolar.offsets_px(candidates.xy1_px, candidates.xy2_px)
    fit = fit_offset(offsets[:, 0], options.inlier_px, rng)
    trusted = fit.inliers.copy()
    if options.check_neighbours:
        trusted[trusted] = consistent_with_neighbours(candidates.xy1_px[trusted], offsets[trusted, 1])
    if trusted.sum() < options.least:
        raise _too_few(series, pair, int(trusted.sum()), features)
    across = offsets[trusted, 0]
    return PairMatches(
        pair,
        candidates.keep(trusted),
        len(candidates),
        (_places(first), _places(second)),
        float(across.mean()),
        float(across.std(ddof=1)),
        _skew(epipolar.from_first(candidates.xy1_px[trusted]), across),
    )


def pair_geometry(series: TiltSeries, pair: tuple[int, int]) -> Epipolar:
    """Epipolar lines of two views from their nominal tilts.

    Raises
    ------
    MethodError
        Where both have the same tilt.
    """
    rotations = rotations_from_tilts(series.tilts_deg[list(pair)], series.tilt_axis_deg)
    try:
        return epipolar_geometry(rotations[0], rotations[1], series.optics.centre_px)
    except MethodError as error:
        names = " and ".join(view_name(series, i) for i in pair)
        raise MethodError(f"{names}: {error}") from error


def view_name(series: TiltSeries, index: int) -> str:
    """Name a view in a message."""
    return series.views[index].name or f"view {index}"


def _skew(place: Array, across: Array) -> tuple[float, float]:
    """Slope of the offset across the lines, along and across them, by least squares."""
    design = np.column_stack([place[:, 1], place[:, 0], np.ones(len(place))])
    slope = np.linalg.lstsq(design, across, rcond=None)[0]
    return float(slope[0]), float(slope[1])


def _check_connected(
    series: TiltSeries, found: Sequence[PairMatches], failed: Mapping[tuple[int, int], MethodError]
) -> None:
    """Raise the failure of the closest pair between views that nothing else connects."""
    ends = np.array([one.pair for one in found], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(series), len(series)))
    _, group = connected_components(graph, directed=False)
    missing = [pair for pair in failed if group[pair[0]] != group[pair[1]]]
    if missing:
        raise failed[min(missing, key=lambda pair: abs(series.tilts_deg[pair[1]] - series.tilts_deg[pair[0]]))]


def _places(features: Features) -> int:
    return len(np.unique(features.place))


def _too_few(series: TiltSeries, pair: tuple[int, int], agreeing: int, features: Sequence[Features]) -> MethodError:
    first, second = pair
    return MethodError(
        f"only {agreeing} trustworthy matches between {view_name(series, first)} and {view_name(series, second)}, "
        f"which have {_places(features[first])} and {_places(features[second])} features: images with more contrast or "
        "less noise or a smaller tilt step would help, and the tilt axis must be right"
    )
