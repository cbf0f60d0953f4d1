"""Bundle adjustment: points, shifts, tilts, tilt axis, magnification and rotation in the plane of all views at once.

Minimises, over the cameras of `camera_model` and all points, the squared reprojection errors over the variance of the
matching noise, plus for every parameter that a stage or a microscope states ``((value - stated) / sigma)^2``. Points
are eliminated exactly (`schur`); Gauss-Newton steps alternate with the intersection of the beams.

Wrong matches are met twice. First all sightings count by a robust weight; once that has settled, what the noise cannot
explain is left out and the rest counts in full, so that the inverse of the normal matrix is the covariance. A
reweighted fit's own matrix is not: it would overstate the variance by a quarter for clean data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semrecon.adjustment.camera_model import LOCAL, Cameras
from semrecon.adjustment.observability import keystone_sigmas, unobservable
from semrecon.adjustment.refined_geometry import Refinement
from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.adjustment.schur import Reduced, camera_share, reduced_equations
from semrecon.data import Array, Mask, Optics, PointCloud, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.numerics.robust import fit_noise
from semrecon.points.beams import Views, lengths_px, views_of
from semrecon.points.joint_translation import (
    CAUCHY,
    LEAST_SCALE_PX,
    LONG_TRACK,
    PAIR_MEDIAN,
    RAYLEIGH_MEDIAN,
    solve_series,
)
from semrecon.points.triangulation import intersect, rms

__all__ = ["Refinement", "RefinementOptions", "refine"]

HUBER = 1.345
"""Huber tuning constant: 95 % efficient for Gaussian noise."""
SETTLED = 1e-3
"""Steps stop when no parameter moves by more than this part of its standard deviation."""
SETTLED_ROBUST = 0.05
"""The same for the robust rounds, which only prepare the selection."""
SELECTIONS = 4
"""How often sightings are sorted into those that count and those that do not."""
START_ROUNDS = 5
"""Rounds of the translations with the tilts as stated; more would settle what moves anyway."""
LEAST_PIVOT = 1e-9
"""Diagonal elements below this part of the largest are scaled as if they were so large (a shift along the parallax)."""


LEAST_SPREAD_DEG = 0.05
"""Least difference of the tilts: below, noise makes depths a thousand times as large as the image errors."""
FARTHEST = 1.0
"""Farthest that a tilt, an axis, a turn (rad) or a logarithm of a magnification may go: beyond, nothing is refined."""
TOO_FEW = "too few matches agree to refine the views; check tilts and tilt axis, or do not refine"


@dataclass(frozen=True)
class _Problem:
    """What stays the same throughout: measurements, and the prior of every parameter (variance 0 holds it)."""

    tracks: Tracks
    optics: Optics
    stated: Cameras
    information: Array
    free: Mask
    reference: int
    options: RefinementOptions


@dataclass(frozen=True)
class _State:
    """Where the iteration stands; weights are relative (1 counts in full, 0 not at all)."""

    cameras: Cameras
    weights: Array
    sigma_px: float
    covariance: Array
    last_step: float
    history_px: tuple[float, ...] = ()

    @property
    def steps(self) -> int:
        """How many were taken: each adds the residual that it started from."""
        return len(self.history_px)


def refine(
    tracks: Tracks,
    tilts_deg: Array,
    optics: Optics,
    *,
    tilt_axis_deg: float = 0.0,
    reference: int | None = None,
    options: RefinementOptions | None = None,
) -> Refinement:
    """Refine the geometry of a tilt series by bundle adjustment.

    Parameters
    ----------
    tracks
        Two views or more; missing sightings are NaN.
    tilts_deg, tilt_axis_deg
        As the stage states them: start and prior.
    reference
        View with shift 0, magnification 1 and rotation 0, along whose beam the median depth is 0; by default the one
        nearest zero tilt.

    Raises
    ------
    InputError
        Shapes do not fit, or a prior is not positive.
    MethodError
        Views look along one beam, or too few tracks tie them together.
    """
    options = options or RefinementOptions()
    _check(tracks, tilts_deg, options)
    tracks = Tracks(np.where(tracks.seen[..., None], tracks.xy_px, np.nan))
    reference = int(np.argmin(np.abs(tilts_deg))) if reference is None else reference
    nominal = rotations_from_tilts(tilts_deg, tilt_axis_deg)
    start = solve_series(tracks, nominal, optics, reference=reference, rounds=START_ROUNDS)
    problem = _problem(tracks, tilts_deg, tilt_axis_deg, optics, reference, options, start.poses.translations_um)
    weights = np.where(tracks.seen, start.weights, 0.0) if options.loss == "cauchy" else tracks.seen.astype(np.float64)
    weights[~_solvable(problem, weights, problem.stated)] = 0.0
    size = len(problem.free)
    state = _State(problem.stated, weights, max(start.scale_px, LEAST_SCALE_PX), np.zeros((size, size)), np.inf)
    if options.loss != "squared":
        state = _robust_rounds(problem, state)
    for _ in range(SELECTIONS):
        selected = _select(problem, state)
        same = np.array_equal(selected.weights, state.weights)
        state = _plain_rounds(problem, selected)
        if same and abs(state.sigma_px - selected.sigma_px) <= SETTLED * state.sigma_px:
            break
    if optics.inverse_working_distance == 0:  # under perspective depth is tied to the working distance
        state = replace(state, cameras=_depth_held(state.cameras, problem, state.weights))
    return _report(problem, state)


def _check(tracks: Tracks, tilts_deg: Array, options: RefinementOptions) -> None:
    if tracks.xy_px.shape[1] != len(tilts_deg):
        raise InputError(f"tracks cover {tracks.xy_px.shape[1]} views, but there are {len(tilts_deg)} tilts")
    if not np.isfinite(tilts_deg).all():
        raise InputError(f"every view needs a tilt in degrees to start from, not {list(tilts_deg)}")
    if np.ptp(tilts_deg) < LEAST_SPREAD_DEG:
        raise MethodError(
            f"all views look along the same beam to {LEAST_SPREAD_DEG:g} degree: without a tilt between them there is "
            "no depth to refine"
        )
    for name in ("tilt_sigma_deg", "axis_sigma_deg", "magnification_sigma", "rotation_sigma_deg"):
        value = getattr(options, name)
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number, not {value}; to hold a parameter switch it off")


def _problem(
    tracks: Tracks,
    tilts_deg: Array,
    axis_deg: float,
    optics: Optics,
    reference: int,
    options: RefinementOptions,
    translations_um: Array,
) -> _Problem:
    views = len(tilts_deg)
    zero = np.zeros(views)
    stated = Cameras(np.deg2rad(tilts_deg), float(np.deg2rad(axis_deg)), zero, zero, translations_um[:, :2])
    # a shift has no prior: only the images know it
    sigma = [np.deg2rad(options.tilt_sigma_deg), options.magnification_sigma, np.deg2rad(options.rotation_sigma_deg)]
    view_information = np.tile(np.append([0.0, 0.0], 1 / np.square(sigma)), (views, 1))
    free = np.tile([True, True, options.tilts, options.magnifications, options.rotations], (views, 1))
    free[reference, [0, 1, 3, 4]] = False
    information = np.append(view_information.ravel(), 1 / np.deg2rad(options.axis_sigma_deg) ** 2)
    return _Problem(tracks, optics, stated, information, np.append(free.ravel(), options.axis), reference, options)


def _robust_rounds(problem: _Problem, state: _State) -> _State:
    """Reweight and step until neither changes much."""
    for _ in range(problem.options.rounds):
        lengths = _lengths_px(problem, state.cameras, state.weights)
        scale = max(_scale_px(problem, state, lengths), LEAST_SCALE_PX)
        ratio = np.nan_to_num(lengths / scale)
        if problem.options.loss == "cauchy":
            robust = 1 / (1 + (ratio / CAUCHY) ** 2)
        else:
            robust = 1 / np.maximum(ratio / HUBER, 1.0)
        state = _step(problem, replace(state, weights=np.where(state.weights > 0, robust, 0.0), sigma_px=scale))
        if state.last_step <= SETTLED_ROBUST:
            break
    return state


def _plain_rounds(problem: _Problem, state: _State) -> _State:
    """Gauss-Newton with the weights as they are."""
    for _ in range(problem.options.rounds):
        state = _step(problem, state)
        if state.last_step <= SETTLED:
            break
    return state


def _step(problem: _Problem, state: _State) -> _State:
    """Intersect the beams and step the cameras."""
    cameras = state.cameras
    reduced, rms_px = _reduced(problem, state)
    right = reduced.right + problem.information * (problem.stated.vector - cameras.vector)
    step, covariance = _solve(reduced, right, problem)
    sigma = np.sqrt(np.diag(covariance))
    relative = np.abs(step)[sigma > 0] / sigma[sigma > 0]
    last = float(relative.max(initial=0.0))
    moved = cameras.moved(step)
    free_of_unit = np.delete(moved.vector - problem.stated.vector, _shifts(len(cameras)))
    if not np.abs(free_of_unit).max() <= FARTHEST:
        raise MethodError(TOO_FEW)
    return replace(state, cameras=moved, covariance=covariance, last_step=last, history_px=(*state.history_px, rms_px))


def _shifts(views: int) -> NDArray[np.intp]:
    """Where the shifts stand in `Cameras.vector`, the only parameters with a unit, (2 views,)."""
    return np.asarray(np.arange(LOCAL * views).reshape(views, LOCAL)[:, :2].ravel())


def _reduced(problem: _Problem, state: _State) -> tuple[Reduced, float]:
    """Equations of the cameras alone, and the weighted RMS residual from which the step starts, px."""
    xyz, _ = _intersect(problem, state.cameras, state.weights)
    weights = np.where(np.isfinite(xyz).all(axis=1, keepdims=True), state.weights, 0.0)
    variance = (state.sigma_px * problem.optics.pixel_size_um) ** 2
    beam = state.cameras.poses.rotations[problem.reference, 2]
    reduced = reduced_equations(problem.tracks, weights / variance, xyz, state.cameras, problem.optics, beam)
    return reduced, _rms_px(problem, state.cameras, xyz, weights)


def _rms_px(problem: _Problem, cameras: Cameras, xyz_um: Array, weights: Array) -> float:
    """Weighted root-mean-square distance of the sightings that count from their reprojections."""
    counted = np.where(weights > 0, weights, 0.0)
    squares = np.nan_to_num(_distances_px(problem, cameras, xyz_um)) ** 2
    return float(np.sqrt((counted * squares).sum() / max(counted.sum(), np.finfo(float).tiny)))


def _solve(reduced: Reduced, right: Array, problem: _Problem) -> tuple[Array, Array]:
    """Step and covariance of all parameters, zero where they are held; the depth of the whole does not move."""
    free = problem.free
    matrix = (reduced.matrix + np.diag(problem.information))[np.ix_(free, free)]
    diagonal = np.diag(matrix)
    size = 1 / np.sqrt(np.maximum(diagonal, LEAST_PIVOT * diagonal.max()))
    depth = reduced.depth[free] * size
    basis = np.linalg.qr(depth[:, None], mode="complete")[0][:, 1:] * size[:, None]
    inner = basis.T @ matrix @ basis
    if not np.isfinite(inner).all():
        raise MethodError(TOO_FEW)
    values = np.linalg.eigvalsh(inner)
    if values[0] <= len(values) * np.finfo(float).eps * values[-1]:
        raise MethodError(TOO_FEW)
    inverse = basis @ np.linalg.inv(inner) @ basis.T
    step, covariance = np.zeros(len(free)), np.zeros((len(free), len(free)))
    step[free] = inverse @ right[free]
    covariance[np.ix_(free, free)] = inverse
    return step, covariance


def _depth_held(cameras: Cameras, problem: _Problem, weights: Array) -> Cameras:
    """Move the whole along the reference beam to median depth zero, and the shifts with it: no image changes."""
    rotations = cameras.poses.rotations
    beam = rotations[problem.reference, 2]
    depth = np.nanmedian(_intersect(problem, cameras, weights)[0] @ beam)
    return replace(cameras, translations_um=cameras.translations_um + depth * (rotations[:, :2] @ beam))


def _intersect(problem: _Problem, cameras: Cameras, weights: Array) -> tuple[Array, Array]:
    """Points of the sightings that count, and their covariances for a noise of one pixel; NaN where too few do."""
    return intersect(problem.tracks.xy_px, weights * cameras.magnifications**2, _views(problem, cameras))


def _lengths_px(problem: _Problem, cameras: Cameras, weights: Array) -> Array:
    """Distance of every sighting, also of those that do not count, from its reprojection; NaN where there is none."""
    return _distances_px(problem, cameras, _intersect(problem, cameras, weights)[0])


def _distances_px(problem: _Problem, cameras: Cameras, xyz_um: Array) -> Array:
    return lengths_px(problem.tracks.xy_px, xyz_um, _views(problem, cameras)) * cameras.magnifications


def _views(problem: _Problem, cameras: Cameras) -> Views:
    return views_of(cameras.poses, problem.optics, np.asarray(np.linalg.inv(cameras.distortions)))


def _scale_px(problem: _Problem, state: _State, lengths: Array) -> float:
    """Robust noise of a coordinate; short tracks count evenly, lest they bend to two sightings and the scale vanish."""
    used = state.weights > 0
    views = used.sum(axis=1)
    short = (views < LONG_TRACK) & (views > 0)
    if short.any():
        steady = np.where(short[:, None], used, state.weights)
        lengths = _lengths_px(problem, state.cameras, steady)
    expected = np.where(views > 2, RAYLEIGH_MEDIAN * np.sqrt(1 - 1.5 / np.maximum(views, 2)), PAIR_MEDIAN)
    known = used & np.isfinite(lengths)
    if not known.any():
        raise MethodError(TOO_FEW)
    return float(np.median((lengths / expected[:, None])[known]))


def _select(problem: _Problem, state: _State) -> _State:
    """Sort sightings into those that count and those that do not, and estimate the noise from the former.

    A sighting of a track of four views or more may go alone; a shorter track goes as a whole, as it cannot tell which
    of its sightings is wrong.
    """
    if problem.options.loss == "squared":
        weights = state.weights
    else:
        limit = np.sqrt(2.0) * problem.options.reject_sigmas * state.sigma_px
        near = np.nan_to_num(_lengths_px(problem, state.cameras, state.weights), nan=np.inf) <= limit
        long = problem.tracks.seen.sum(axis=1) >= 4
        weights = (problem.tracks.seen & (near | ~long[:, None])).astype(np.float64)
    weights = np.where(_solvable(problem, weights, state.cameras)[:, None], weights, 0.0)
    views = (weights > 0).sum(axis=1)
    residual = _residual_px(problem, state.cameras, weights)
    noise = fit_noise(residual, np.maximum(views, 2), sigmas=problem.options.reject_sigmas)
    if problem.options.loss == "squared":
        used = views > 1
        sigma = np.sqrt(np.nansum(views * residual**2) / (2 * views[used] - 3).sum())
        return replace(state, weights=weights, sigma_px=max(float(sigma), LEAST_SCALE_PX))
    return replace(state, weights=np.where(noise.inliers[:, None], weights, 0.0), sigma_px=noise.sigma_px)


def _solvable(problem: _Problem, weights: Array, cameras: Cameras) -> Mask:
    """Tracks seen along two different beams."""
    evenly = (weights > 0).astype(np.float64)
    return np.asarray(np.isfinite(_intersect(problem, cameras, evenly)[0]).all(axis=1))


def _report(problem: _Problem, state: _State) -> Refinement:
    cameras, covariance = state.cameras, state.covariance
    sigma = np.sqrt(np.diag(covariance))
    view = sigma[:-1].reshape(-1, LOCAL)
    tilts = np.arange(2, len(sigma) - 1, LOCAL)
    points, k = _points(problem, state), problem.optics.inverse_working_distance
    noise_um = state.sigma_px * problem.optics.pixel_size_um
    ends_px = _rms_px(problem, cameras, points.xyz_um, state.weights)
    tracks = cameras.corrected(problem.tracks, problem.optics)
    tilt_covariance = np.rad2deg(np.rad2deg(covariance[np.ix_(tilts, tilts)]))
    return Refinement(
        poses=cameras.poses,
        tracks=Tracks(np.where((state.weights > 0)[..., None], tracks.xy_px, np.nan)),
        tilts_deg=np.rad2deg(cameras.tilts_rad),
        tilt_axis_deg=float(np.rad2deg(cameras.axis_rad)),
        magnifications=cameras.magnifications,
        rotations_deg=np.rad2deg(cameras.turns_rad),
        shifts_um=cameras.translations_um,
        tilt_covariance_deg2=tilt_covariance,
        tilt_sigma_deg=np.rad2deg(view[:, 2]),
        axis_sigma_deg=float(np.rad2deg(sigma[-1])),
        magnification_sigma=view[:, 3] * cameras.magnifications,
        rotation_sigma_deg=np.rad2deg(view[:, 4]),
        shift_sigma_um=view[:, :2],
        points=points,
        sigma_px=state.sigma_px,
        unobservable=unobservable(
            problem.stated.tilts_rad,
            tilt_covariance,
            problem.reference,
            problem.options,
            perspective=k > 0,
            keystone=keystone_sigmas(points.xyz_um, cameras.tilts_rad, cameras.axis_rad, k, noise_um),
        ),
        cameras=cameras,
        covariance=covariance,
        iterations=state.steps,
        converged=state.last_step <= SETTLED,
        history_px=(*state.history_px, ends_px),
    )


def _points(problem: _Problem, state: _State) -> PointCloud:
    """Intersect once more, and add to each covariance what the cameras leave open: ``H^-1 W^T C W H^-1``."""
    xyz, covariance = _intersect(problem, state.cameras, state.weights)
    counted = np.where(np.isfinite(xyz).all(axis=1, keepdims=True), state.weights, 0.0)
    weights = counted / (state.sigma_px * problem.optics.pixel_size_um) ** 2
    share = camera_share(problem.tracks, weights, xyz, state.cameras, problem.optics, state.covariance)
    xy_px = np.where(np.isfinite(xyz[:, :1]), problem.tracks.xy_px[:, problem.reference], np.nan)
    residual = _residual_px(problem, state.cameras, state.weights)
    return PointCloud(xyz, covariance * state.sigma_px**2 + share, residual, xy_px)


def _residual_px(problem: _Problem, cameras: Cameras, weights: Array) -> Array:
    """Root-mean-square distance of the sightings of each point that count, as the ideal cameras would see them."""
    lengths = _lengths_px(problem, cameras, weights) / cameras.magnifications
    return rms(np.where(weights > 0, lengths, np.nan))
