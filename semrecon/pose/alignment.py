"""Cameras of all views from the images: by features and bundle adjustment, by phase correlation where these are few."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from semrecon.adjustment.refinement import Refinement, refine
from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.data import Array, PointCloud, Poses, TiltSeries, Tracks
from semrecon.errors import MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.matches.correspondence import CorrespondenceOptions, PairMatches, match_pair, view_name
from semrecon.matches.features import Features, detect_features
from semrecon.matches.phase_correlation import phase_shift
from semrecon.matches.tracks import join_matches
from semrecon.numerics.history import CONVERGENCE, history

ROUNDS = 3
"""Phase correlations of a view, each after the last one's shift is taken back."""


@dataclass(frozen=True)
class Alignment:
    """Cameras of all views.

    Parameters
    ----------
    poses
        Of ideal cameras.
    distortions
        Magnification and rotation in the plane of each view against the reference view, (views, 2, 2): they act on
        image positions from the centre, after the projection of the ideal camera.
    tilts_deg, tilt_axis_deg
        As refined, (views,); as stated for views without features.
    by_features
        Which views the features tie together, the reference view among them; empty where none are.
    points
        Points that the features gave, in the world frame; their `xy_px` are positions in the reference view.
    refinement
        How well all that is known, for the views `by_features`; None where there are none.
    warnings
        Sentences for the user.
    """

    poses: Poses
    distortions: Array
    tilts_deg: Array
    tilt_axis_deg: float
    by_features: tuple[int, ...] = ()
    points: PointCloud | None = None
    refinement: Refinement | None = None
    warnings: tuple[str, ...] = ()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)


def align(
    series: TiltSeries,
    correspondence: CorrespondenceOptions,
    options: RefinementOptions,
    rng: np.random.Generator,
) -> Alignment:
    """Find the cameras of a series.

    Views that features tie to the reference view are refined together. For each other view the tilt is as stated and
    the shift comes from phase correlation with the reference view, both drawn as a flat specimen would show them.

    Raises
    ------
    MethodError
        A view has nothing in common with the reference view; or all views have one tilt.
    """
    _check_tilts(series)
    matches = trusted_matches(series, correspondence, rng)
    group = connected_views(matches, len(series), series.reference)
    found = None
    if len(group) > 1:
        try:
            found = _refined(series, matches, group, options)
        except MethodError:  # enough matches for pairs, too few for the cameras: the shifts are still to be had
            found = None
    start = _stated(series) if found is None else found
    return _with_the_rest(series, start, matches)


def trusted_matches(
    series: TiltSeries, options: CorrespondenceOptions, rng: np.random.Generator
) -> tuple[PairMatches, ...]:
    """Match all pairs of views and leave out those that have too little in common."""
    features = [_features(series, view, options) for view in range(len(series))]
    pairs = list(combinations(range(len(series)), 2))
    found = []
    for pair, child in zip(pairs, rng.spawn(len(pairs)), strict=True):
        first, second = features[pair[0]], features[pair[1]]
        if first is None or second is None:
            continue
        try:
            found.append(match_pair(series, pair, [one or first for one in features], options, child))
        except MethodError:
            continue
    return tuple(found)


def connected_views(matches: Sequence[PairMatches], views: int, reference: int) -> tuple[int, ...]:
    """Find the views that chains of matches tie to the reference view, itself included."""
    ends = np.array([one.pair for one in matches], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(views, views))
    _, label = connected_components(graph, directed=False)
    return tuple(int(view) for view in np.flatnonzero(label == label[reference]))


def _check_tilts(series: TiltSeries) -> None:
    if np.ptp(series.tilts_deg) == 0:
        names = " and ".join(view_name(series, view) for view in (0, len(series) - 1))
        raise MethodError(
            f"{names} have the same tilt of {series.tilts_deg[0]:g} degrees, as all views do: there is no parallax"
        )


def _features(series: TiltSeries, view: int, options: CorrespondenceOptions) -> Features | None:
    try:
        return detect_features(series.views[view], options.features)
    except MethodError:
        return None


def _stated(series: TiltSeries) -> Alignment:
    """Cameras as the stage states them, unshifted."""
    views = len(series)
    rotations = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)
    return Alignment(
        Poses(rotations, np.zeros((views, 3))),
        np.tile(np.eye(2), (views, 1, 1)),
        series.tilts_deg,
        series.tilt_axis_deg,
    )


def _refined(
    series: TiltSeries, matches: Sequence[PairMatches], group: Sequence[int], options: RefinementOptions
) -> Alignment:
    """Refine the views of `group`; the others keep what is stated, about the refined axis."""
    inside = [one for one in matches if one.pair[0] in group]
    tracks = Tracks(join_matches(inside, len(series)).xy_px[:, list(group)])
    refined = refine(
        tracks,
        series.tilts_deg[list(group)],
        series.optics,
        tilt_axis_deg=series.tilt_axis_deg,
        reference=group.index(series.reference),
        options=options,
    )
    tilts, distortions = series.tilts_deg.copy(), np.tile(np.eye(2), (len(series), 1, 1))
    translations, sigma = np.zeros((len(series), 3)), np.full(len(series), options.tilt_sigma_deg)
    tilts[list(group)], sigma[list(group)] = refined.tilts_deg, refined.tilt_sigma_deg
    translations[list(group)] = refined.poses.translations_um
    turns = np.deg2rad(refined.rotations_deg)
    for n, view in enumerate(group):
        c, s = np.cos(turns[n]), np.sin(turns[n])
        distortions[view] = refined.magnifications[n] * np.array([[c, -s], [s, c]])
    rotations = rotations_from_tilts(tilts, refined.tilt_axis_deg)
    rotations[list(group)] = refined.poses.rotations
    points = refined.points.keep(np.isfinite(refined.points.residual_px))
    return Alignment(
        Poses(rotations, translations),
        distortions,
        tilts,
        refined.tilt_axis_deg,
        tuple(group),
        points,
        refined,
        diagnostics=_diagnostics(inside, tracks, refined, points)
        | {"tilts_deg": tilts, "tilt_sigma_deg": sigma}
        | {"magnifications": np.sqrt(np.linalg.det(distortions))},
    )


def _with_the_rest(series: TiltSeries, start: Alignment, matches: Sequence[PairMatches]) -> Alignment:
    """Shift the views that features do not tie to the reference view."""
    rest = [view for view in range(len(series)) if view not in start.by_features and view != series.reference]
    if not rest:
        return start
    translations = start.poses.translations_um.copy()
    for view in rest:
        translations[view, :2] = _shift_um(series, start, view, matches)
    names = ", ".join(view_name(series, view) for view in rest)
    warning = (
        f"too few features tie {names} to {view_name(series, series.reference)}: the tilt is taken as stated and the "
        "shift from the likeness of the whole pictures, which is less exact"
    )
    return Alignment(
        Poses(start.poses.rotations, translations),
        start.distortions,
        start.tilts_deg,
        start.tilt_axis_deg,
        start.by_features,
        start.points,
        start.refinement,
        (warning,),
        {**start.diagnostics, "aligned_by_likeness": [view_name(series, view) for view in rest]},
    )


def _shift_um(series: TiltSeries, start: Alignment, view: int, matches: Sequence[PairMatches]) -> Array:
    """Shift of one view from phase correlation with the reference view, on the plane of height zero."""
    reference = series.reference
    relative = (start.poses.rotations[view] @ start.poses.rotations[reference].T)[:2, :2]
    shift_px, sure = np.zeros(2), False
    for _ in range(ROUNDS):
        found = phase_shift(series.views[reference], series.views[view], relative, shift_px)
        if found is None:
            break
        shift_px, sure = shift_px + relative @ found, True
    if not sure:
        agreeing = max((len(one.matches) for one in matches if view in one.pair), default=0)
        raise MethodError(
            f"{view_name(series, view)} and {view_name(series, reference)} have nothing recognisable in common "
            f"({agreeing} trustworthy matches): images with more contrast or less noise or a smaller tilt step would "
            "help, and the tilts, the tilt axis and the masks must be right"
        )
    return np.asarray(shift_px * series.optics.pixel_size_um)


def _diagnostics(
    matches: Sequence[PairMatches], tracks: Tracks, refined: Refinement, points: PointCloud
) -> dict[str, Any]:
    """Say what is known of the cameras, by the names that the summary page reads."""
    views = tracks.seen.sum(axis=1)
    return {
        "pairs": [
            {"views": list(one.pair), "matches": len(one.matches), "sigma_across_px": one.sigma_px} for one in matches
        ],
        "tracks": len(tracks),
        "tracks_by_views": {str(n): int((views == n).sum()) for n in np.unique(views)},
        "points": len(points),
        "sigma_px": refined.sigma_px,
        "tilt_axis_deg": refined.tilt_axis_deg,
        "tilt_axis_sigma_deg": refined.axis_sigma_deg,
        "rotations_deg": refined.rotations_deg,
        "unobservable": refined.unobservable,
        CONVERGENCE: [history("bundle adjustment of the cameras", refined.history_px)],
    }
