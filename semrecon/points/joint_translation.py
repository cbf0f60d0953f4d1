"""Translations of all views at once, for known rotations: points eliminated exactly, wrong matches weighted down.

Every sighting of point i in view v says (Eq. 2, um from the image centre, a = 1)::

    m_iv = P_v X_i + t_v + noise,     P_v = first two rows of R_v,  t_v = (t_x, t_y)

Least squares over all X_i and t_v. With weights w_iv, ``N_i = sum_v w_iv P_v^T P_v`` and its (pseudo-)inverse, the
points drop out (Schur complement) and leave 2 equations a view::

    sum_u S_vu t_u = g_v
    S_vu = delta_vu sum_i w_iv - sum_i w_iv w_iu P_v N_i^-1 P_u^T
    g_v  = sum_i w_iv (m_iv - P_v N_i^-1 sum_u w_iu P_u^T m_iu)

``X_i -> X_i + d, t_v -> t_v - P_v d`` changes no image for any vector d, so S has rank 2V - 3 at best, whatever the
number of views: more views do not fix the depth of the whole. d is spent on ``t = 0`` in the reference view and on
zero median height along its beam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np

from semrecon.data import Array, Mask, Optics, Poses, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um
from semrecon.numerics.normal_equations import multiply
from semrecon.numerics.point_bands import in_bands
from semrecon.points.beams import Views, lengths_px, parallel_intersection

Loss = Literal["cauchy", "squared"]

CAUCHY = 2.385
"""Cauchy tuning constant: 95 % efficient for Gaussian noise."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2-vector of unit normal noise."""
LONG_TRACK = 5
"""Least number of views from which a point bent to two sightings leaves more than half of them unfitted."""
PAIR_MEDIAN = 0.4769
"""Median length of a residual in two views: half the epipolar mismatch, normal with variance 1/2 at unit noise."""
LEAST_SCALE_PX = 1e-6
"""Floor of the residual scale: exact data would divide by zero."""
NULL_TOLERANCE = 1e-8
"""Eigenvalues of S below this part of the largest count as zero."""
SETTLED = 1e-9
"""Rounds stop when no translation moves by more than this part of the largest image coordinate."""


@dataclass(frozen=True)
class SeriesTranslation:
    """Translations of all views, with what the equations could and could not say.

    Parameters
    ----------
    poses
        Rotations as given; t_z = 0.
    xyz_um
        Points in the world frame, (tracks, 3); NaN where depth is unobservable (fewer than two beams).
    weights
        Last robust weight of each sighting, (tracks, views): near 0 is a wrong match, 0 is not seen.
    scale_px
        Robust standard deviation of the matching noise per coordinate, to some 10 %: from residuals, each raised by
        what its point absorbed (three of its 2 V numbers).
    rank
        Of the reduced system S: 2 V - 3 of 2 V unknowns.
    condition
        Ratio of its largest to its smallest eigenvalue that is not zero.
    gauge
        How the three null directions were fixed, in words.
    """

    poses: Poses
    xyz_um: Array
    weights: Array
    scale_px: float
    rank: int
    condition: float
    gauge: tuple[str, str, str]


@dataclass(frozen=True)
class _Round:
    """State of the iteration: points are those of the pseudo-inverse, finite everywhere."""

    translations: Array
    points: Array
    observable: Mask
    rank: int
    condition: float


def global_translations(
    tracks: Tracks,
    rotations: Array,
    optics: Optics,
    *,
    reference: int = 0,
    loss: Loss = "cauchy",
    rounds: int = 50,
) -> Poses:
    """Poses of a series of known rotations; see `solve_series`, which also says how well they are determined."""
    return solve_series(tracks, rotations, optics, reference=reference, loss=loss, rounds=rounds).poses


def solve_series(
    tracks: Tracks,
    rotations: Array,
    optics: Optics,
    *,
    reference: int = 0,
    loss: Loss = "cauchy",
    rounds: int = 50,
) -> SeriesTranslation:
    """Solve for the translations of all views by joint linear least squares, robustly.

    Under perspective each round first brings the positions to parallel projection, ``m (1 + k Z)``, with the depths of
    the round before; the depth gauge is then an assumption on the working distance.

    Parameters
    ----------
    tracks
        Two views or more; missing sightings are NaN.
    rotations
        R_cam_from_world of every view, (views, 3, 3).
    reference
        View whose translation is zero and along whose beam the median height is zero.
    loss
        "cauchy" reweights by the reprojection residual; "squared" is plain least squares.
    rounds
        Most reweightings.

    Raises
    ------
    InputError
        Shapes do not fit.
    MethodError
        Views look along one beam, or some are tied to the others by too few tracks.
    """
    if tracks.xy_px.shape[1] != len(rotations):
        raise InputError(f"tracks cover {tracks.xy_px.shape[1]} views, but there are {len(rotations)} rotations")
    if np.linalg.matrix_rank(rotations[:, :2].reshape(-1, 3), tol=1e-6) < 3:
        raise MethodError("all views look along the same beam: without a tilt between them depth cannot be seen")
    measured = np.where(tracks.seen[..., None], centred_um(tracks.xy_px, optics), 0.0)
    seen = tracks.seen.astype(np.float64)
    weights, positions = seen, measured
    last = np.full((len(rotations), 2), np.inf)
    for _ in range(max(rounds, 1)):
        state = _round(weights, positions, rotations, reference)
        if np.abs(state.translations - last).max() <= SETTLED * np.abs(measured).max():
            break
        last = state.translations
        positions = measured * (1 + optics.inverse_working_distance * (state.points @ rotations[:, 2].T))[..., None]
        scale = max(
            _scale(seen, weights, positions, state.translations, rotations), LEAST_SCALE_PX * optics.pixel_size_um
        )
        if loss == "cauchy":
            lengths = _residual_lengths(state.points, state.translations, positions, rotations)
            weights = seen / (1 + (lengths / (CAUCHY * scale)) ** 2)
    return _report(state, weights, scale / optics.pixel_size_um, rotations, reference)


def _round(weights: Array, positions: Array, rotations: Array, reference: int) -> _Round:
    projections, standing = rotations[:, :2], np.zeros((len(rotations), 2))
    untranslated, inverses, observable = _intersected(weights, positions, rotations, standing)
    reduced, right = _reduced_system(weights, projections, positions, inverses, untranslated)
    translations, rank, condition = _solve_reduced(reduced, right)
    translations -= projections @ (projections[reference].T @ translations[reference])
    points, _, _ = _intersected(weights, positions, rotations, translations)
    beam = rotations[reference, 2]
    shift = -np.median(points[observable] @ beam) * beam if observable.any() else np.zeros(3)
    return _Round(translations - projections @ shift, points + shift, observable, rank, condition)


def _intersected(weights: Array, positions: Array, rotations: Array, translations: Array) -> tuple[Array, Array, Mask]:
    """Points ``N_i^-1 sum_v w_iv P_v^T (m_iv - t_v)``, the pseudo-inverses, and where depth is observable."""
    return parallel_intersection(positions, weights, _views(rotations, translations))


def _views(rotations: Array, translations: Array) -> Views:
    """Parallel cameras whose pixels are um from the image centre."""
    still = np.tile(np.eye(2), (len(rotations), 1, 1))
    return Views(np.ascontiguousarray(rotations), np.pad(translations, ((0, 0), (0, 1))), still, np.zeros(2), 1.0, 0.0)


def _reduced_system(
    weights: Array, projections: Array, positions: Array, inverses: Array, untranslated: Array
) -> tuple[Array, Array]:
    """S as (views, 2, views, 2) and g as (views, 2)."""
    views = len(projections)
    coupling = np.empty((3, 3, views, views))
    sums = sum(in_bands(lambda first, last: _coupled(weights, inverses, first, last), len(weights)))
    for (a, b), lower in zip(
        ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), np.broadcast_to(sums, (6, views, views)), strict=True
    ):
        coupling[a, b] = coupling[b, a] = lower + np.tril(lower, -1).T
    reduced = -np.einsum("vxa,abvu,uyb->vxuy", projections, coupling, projections, optimize=True)
    index = np.arange(views)
    for axis in (0, 1):
        reduced[index, axis, index, axis] += weights.sum(axis=0)
    right = np.einsum("iv,ivx->vx", weights, positions) - multiply(projections, weights.T @ untranslated)
    return reduced, right


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[untyped-decorator]
def _coupled(weights: Array, inverses: Array, first: int, last: int) -> Array:
    """Sum ``w_iv N_i^-1 w_iu`` over a band of points: lower triangles over v, u of its six different elements."""
    views = weights.shape[1]
    sums = np.zeros((6, views, views))
    for i in range(first, last):
        n = inverses[i]
        for v in range(views):
            w = weights[i, v]
            if not w > 0:
                continue
            for element, value in enumerate((n[0, 0], n[0, 1], n[0, 2], n[1, 1], n[1, 2], n[2, 2])):
                row, factor = sums[element, v], w * value
                for u in range(v + 1):
                    row[u] += factor * weights[i, u]
    return sums


def _solve_reduced(reduced: Array, right: Array) -> tuple[Array, int, float]:
    """Minimum-norm translations (views, 2), with rank and condition number of S."""
    views = len(right)
    values, vectors = np.linalg.eigh(reduced.reshape(2 * views, 2 * views))
    kept = values > NULL_TOLERANCE * values[-1]
    if values[-1] <= 0 or kept.sum() < 2 * views - 3:
        extra = 2 * views - 3 - int(kept.sum())
        raise MethodError(
            f"the tracks do not tie the views together: {extra} direction(s) of the translations stay open beyond the "
            "three that no track can fix; tracks seen in three views or more are needed"
        )
    translations = vectors[:, kept] @ (vectors[:, kept].T @ right.ravel() / values[kept])
    return translations.reshape(views, 2), int(kept.sum()), float(values[-1] / values[kept][0])


def _residual_lengths(points: Array, translations: Array, positions: Array, rotations: Array) -> Array:
    """Distance of each sighting from its reprojection, um, (tracks, views)."""
    return lengths_px(positions, points, _views(rotations, translations))


def _scale(seen: Array, weights: Array, positions: Array, translations: Array, rotations: Array) -> float:
    """Robust standard deviation of a coordinate, um, from the median residual length.

    Short tracks are intersected with equal weights: robust ones can bend the point to two of three sightings, and a
    scale drawn from them would shrink from round to round until it vanished. Long tracks keep their weights, lest one
    wrong sighting be smeared over all.
    """
    views = seen.sum(axis=1)
    steady = np.where((views >= LONG_TRACK)[:, None], weights, seen)
    points, _, _ = _intersected(steady, positions, rotations, translations)
    lengths = _residual_lengths(points, translations, positions, rotations)
    expected = np.where(views > 2, RAYLEIGH_MEDIAN * np.sqrt(1 - 1.5 / np.maximum(views, 2)), PAIR_MEDIAN)
    return float(np.median((lengths / expected[:, None])[(seen > 0) & (views > 1)[:, None]]))


def _report(state: _Round, weights: Array, scale_px: float, rotations: Array, reference: int) -> SeriesTranslation:
    poses = Poses(rotations, np.pad(state.translations, ((0, 0), (0, 1))))
    points = np.where(state.observable[:, None], state.points, np.nan)
    gauge = (
        f"t_x = 0 in view {reference}",
        f"t_y = 0 in view {reference}",
        f"median height 0 along the beam of view {reference}",
    )
    return SeriesTranslation(poses, points, weights, scale_px, state.rank, state.condition, gauge)
