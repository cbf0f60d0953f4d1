"""Direction of the tilt axis, from the images alone.

What is raised moves across the tilt axis when the stage tilts, so that the epipolar lines of any two views are across
it. The axis is found as a line, modulo 180 degrees: turning it round is the same as a change of sign of all tilts, and
that (the sign of the relief) no parallel projection shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from semrecon.data import Array, TiltSeries
from semrecon.errors import MethodError
from semrecon.matches.affine_epipolar import AffineEpipolar, EpipolarOptions, fit_affine_epipolar
from semrecon.matches.drift import largest_features
from semrecon.matches.epipolar import Epipolar, Window
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.matching import Matches, MatchOptions, match_features

SIGN_REMARK = (
    "the tilt axis is found as a line: whether the relief stands up or is inside out depends on the sign of the tilts, "
    "which no image geometry shows"
)
TWO_VIEWS_REMARK = (
    "the tilt axis rests on a single pair of views: scan distortions that both share cannot be told from it"
)


@dataclass(frozen=True)
class AxisOptions:
    """How the axis is found.

    Parameters
    ----------
    views
        How many views, spread over the tilts, are matched each with each.
    widest_deg
        Only views so near to the reference view take part, where two or more are: surfaces look different from afar.
    places
        How many features of each view, the largest, are matched.
    reach
        Greatest shift that is looked for, as a share of the image's longer side.
    worst_sigma_deg
        A direction known no better than this is no answer.
    """

    views: int = 4
    widest_deg: float = 20.0
    places: int = 3000
    reach: float = 0.25
    worst_sigma_deg: float = 5.0
    features: FeatureOptions = field(default_factory=FeatureOptions)
    matches: MatchOptions = field(default_factory=MatchOptions)
    epipolar: EpipolarOptions = field(default_factory=EpipolarOptions)


@dataclass(frozen=True)
class PairAxis:
    """What one pair of views says.

    Parameters
    ----------
    pair
        View indices.
    axis_deg, sigma_deg
        Mean of the directions of its two views, and one standard deviation by the scatter of the matches.
    turn_deg
        Direction in the second view less that in the first: their rotation in the plane.
    matches
        Matches that agree.
    parallax_px
        Standard deviation of the parallax that no affine map explains.
    noise_px
        Noise of one coordinate of a match.
    """

    pair: tuple[int, int]
    axis_deg: float
    sigma_deg: float
    turn_deg: float
    matches: int
    parallax_px: float
    noise_px: float


@dataclass(frozen=True)
class AxisEstimate:
    """Direction of the tilt axis as the images have it.

    Parameters
    ----------
    axis_deg
        In (-90, 90], clockwise from image up: 0 is up, 90 is right.
    sigma_deg
        One standard deviation, from the fits, the scatter of the pairs, and the views' rotations in the plane.
    pairs
        What each pair says.
    matches
        Matches that agree, over all pairs.
    warnings
        Sentences that the user should read.
    """

    axis_deg: float
    sigma_deg: float
    pairs: tuple[PairAxis, ...]
    matches: int
    warnings: tuple[str, ...] = ()

    @property
    def parallax_px(self) -> float:
        """Largest standard deviation of the parallax of a pair."""
        return max(one.parallax_px for one in self.pairs)


def estimate_axis(series: TiltSeries, rng: np.random.Generator, options: AxisOptions = AxisOptions()) -> AxisEstimate:
    """Find the direction of the tilt axis; `series.tilt_axis_deg` is not looked at, tilts only choose the views.

    Raises
    ------
    MethodError
        Where the images cannot tell: no two tilts, too few matches, or a specimen so flat that it has no parallax.
    """
    chosen = chosen_views(series.tilts_deg, series.reference, options)
    features = {i: largest_features(detect_features(series.views[i], options.features), options.places) for i in chosen}
    pairs = [pair for pair in combinations(chosen, 2) if series.tilts_deg[pair[0]] != series.tilts_deg[pair[1]]]
    found: list[PairAxis] = []
    failures: list[str] = []
    for pair, child in zip(pairs, rng.spawn(len(pairs)), strict=True):
        try:
            matches = match_anywhere(features[pair[0]], features[pair[1]], max(series.optics.shape), options)
            found.append(pair_axis(pair, fit_affine_epipolar(matches.xy1_px, matches.xy2_px, child, options.epipolar)))
        except MethodError as error:
            failures.append(str(error))
    if not found:
        raise _cannot(failures[0] if failures else "no two of the images have different tilts")
    return combine(found, options)


def chosen_views(tilts_deg: Array, reference: int, options: AxisOptions) -> tuple[int, ...]:
    """Choose views spread over the tilts about the reference view, in order of capture."""
    away = np.abs(tilts_deg - tilts_deg[reference])
    near = np.flatnonzero(away <= options.widest_deg)
    if not (away[near] > 0).any() and (away > 0).any():
        near = np.append(near, np.flatnonzero(away == away[away > 0].min()))
    ordered = near[np.argsort(tilts_deg[near], kind="stable")]
    places = np.linspace(0, len(ordered) - 1, min(options.views, len(ordered))).round().astype(int)
    return tuple(sorted(int(i) for i in ordered[places]))


def match_anywhere(first: Features, second: Features, longest_px: int, options: AxisOptions) -> Matches:
    """Match two views without knowing their epipolar lines: each feature with all within reach."""
    plain = Epipolar(np.eye(2), np.eye(2), 1.0, np.zeros(2))
    reach = options.reach * longest_px
    return match_features(first, second, plain, Window((-reach, reach), (-reach, reach)), options.matches)


def pair_axis(pair: tuple[int, int], fit: AffineEpipolar) -> PairAxis:
    """Read the axis from the epipolar lines of a pair."""
    first, second = fit.axes_deg
    turn = difference_deg(second, first)
    sigma = float(np.sqrt(np.full(2, 0.5) @ fit.axes_covariance_deg2 @ np.full(2, 0.5)))
    middle = principal_deg(first + turn / 2)
    return PairAxis(pair, middle, sigma, turn, int(fit.inliers.sum()), fit.parallax_px, fit.sigma_px)


def combine(pairs: Sequence[PairAxis], options: AxisOptions = AxisOptions()) -> AxisEstimate:
    """Combine what the pairs say, each by its weight.

    The pairs share views and so errors: of `n` views only `n - 1` pairs count. Scatter beyond the pairs' own sigma
    widens that of the mean (Birge); so do the views' rotations in the plane, because the direction is a mean of theirs.

    Raises
    ------
    MethodError
        Where the direction is known no better than `options.worst_sigma_deg`.
    """
    anchor = min(pairs, key=lambda one: one.sigma_deg).axis_deg
    offsets = np.array([difference_deg(one.axis_deg, anchor) for one in pairs])
    weights = np.array([one.sigma_deg for one in pairs]) ** -2.0
    mean = float(weights @ offsets / weights.sum())
    views = len({i for one in pairs for i in one.pair})
    scatter = float(weights @ (offsets - mean) ** 2) / max(len(pairs) - 1, 1)
    formal = max(scatter, 1.0) / weights.sum() * len(pairs) / (views - 1)
    sigma = float(np.sqrt(formal + _turn_variance(pairs, views)))
    if sigma > options.worst_sigma_deg:
        raise _cannot(f"its direction comes out with a standard deviation of {sigma:.1f} degrees")
    remarks = (SIGN_REMARK,) if len(pairs) > 1 else (SIGN_REMARK, TWO_VIEWS_REMARK)
    matches = sum(one.matches for one in pairs)
    return AxisEstimate(principal_deg(anchor + mean), sigma, tuple(pairs), matches, remarks)


def _turn_variance(pairs: Sequence[PairAxis], views: int) -> float:
    """Variance of the mean direction by rotations in the plane, deg^2: a pair's turn has twice that of one view."""
    weights = np.array([one.sigma_deg for one in pairs]) ** -2.0
    turns = np.array([one.turn_deg for one in pairs])
    return float(weights @ turns**2 / weights.sum()) / 2 / views


def principal_deg(axis_deg: float) -> float:
    """Name a line by its angle in (-90, 90]."""
    return float(90 - (90 - axis_deg) % 180)


def difference_deg(axis_deg: float, other_deg: float) -> float:
    """Angle from one line to another, in (-90, 90]."""
    return principal_deg(axis_deg - other_deg)


@dataclass(frozen=True)
class Tolerance:
    """When a stated axis is called wrong.

    Parameters
    ----------
    sigmas
        Least difference in standard deviations of the estimate: below, chance may have made it.
    offset_px
        Least shift across the supposed epipolar lines of a point with twice the standard deviation of the parallax.
        A wrong axis moves a point by its parallax times the sine of the error; matchers look 2 px about the lines
        (`CorrespondenceOptions.inlier_px`), so that half of that begins to cost matches, the highest and deepest first.
    always_deg
        A difference that counts whatever it costs.
    never_deg
        A difference that never counts: columns are not square to rows by more.
    """

    sigmas: float = 4.0
    offset_px: float = 1.0
    always_deg: float = 1.0
    never_deg: float = 0.25


def axis_contradiction(stated_deg: float, estimate: AxisEstimate, tolerance: Tolerance = Tolerance()) -> str | None:
    """Say so where the images contradict the axis that was given.

    Returns
    -------
    A sentence, or None where they agree or the difference does no harm.
    """
    error = difference_deg(stated_deg, estimate.axis_deg)
    offset_px = 2 * estimate.parallax_px * abs(float(np.sin(np.deg2rad(error))))
    harmful = abs(error) > tolerance.always_deg or (
        abs(error) > tolerance.never_deg and offset_px > tolerance.offset_px
    )
    if not harmful or abs(error) <= tolerance.sigmas * estimate.sigma_deg:
        return None
    advice = nearest_sense(stated_deg, estimate).axis_deg
    return (
        f"the tilt axis is given as {stated_deg:g} degrees, but the images say {advice:.2f} +- "
        f"{estimate.sigma_deg:.2f}: points lie up to {offset_px:.1f} px beside "
        f"the epipolar lines of the axis given; if the images are right, "
        f"give --tilt-axis-deg {advice:.2f}"
    )


def nearest_sense(stated_deg: float, estimate: AxisEstimate) -> AxisEstimate:
    """Turn the axis round where that is nearer to what was given, so that the tilts keep their sign."""
    return replace(estimate, axis_deg=stated_deg - difference_deg(stated_deg, estimate.axis_deg))


def _cannot(reason: str) -> MethodError:
    return MethodError(f"the images do not show the direction of the tilt axis: {reason}; give --tilt-axis-deg")
