"""Judge an estimate against truth: its declared gauge is removed, and beside that a gauge common to all methods."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from benchmarks.judging.evaluate import true_heights
from benchmarks.judging.surface_score import cloud_in_world, f_scores, normal_error_deg, world_points
from benchmarks.scenes import SimulatedSource
from semrecon.data import Array, Estimate, HeightMap, Mask, PointCloud, Poses, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import nominal_poses, project, view_from_world
from semrecon.judging.error_split import error_split
from semrecon.judging.gauge import GaugeFit, gauge_fit
from semrecon.judging.metrics import DepthErrors, depth_errors, relative_rotation_error_deg
from semrecon.methods.base import Gauge
from semrecon.numerics.motion import rotation_angle_rad
from semsim.truth import GroundTruth

Metrics = dict[str, float]
"""Numbers by name, units in the names; NaN is what cannot be told."""
COMMON: tuple[Gauge, ...] = ("offset", "plane", "scale", "mirror")
"""Taken from every method's heights for the comparison of all: what the least informed of them cannot observe."""
TOLERANCES_PX = (0.5, 1.0, 2.0, 5.0)
"""Tolerances of the F-score, in pixel sizes."""
NAN = float("nan")


def judge(
    estimate: Estimate, truth: GroundTruth, series: TiltSeries, gauge: Sequence[Gauge], source: SimulatedSource
) -> Metrics:
    """Judge heights, points and poses, whichever there are; what there is not is NaN or, where shares count, 0.

    Heights are judged on the grid of the reference view where all views see the surface; a method that gives points
    alone has them filled first, as `semrecon` does for its users.

    Parameters
    ----------
    series
        What the method was given; only its optics and nominal tilts are used.
    gauge
        What the method declares unobservable.
    source
        Keeps what is judgeable from one call to the next.
    """
    view = series.reference
    judged = source.judgeable((view, *(each for each in range(len(series)) if each != view)), 1)
    heights = estimate.heights or filled(estimate, series)
    true = np.where(judged, truth.height_map(view), np.nan)
    xy = grid_um(judged.shape, series.optics.pixel_size_um)
    if heights is None or heights.z_um.shape != judged.shape:
        heights = HeightMap(np.full(judged.shape, np.nan), np.full(judged.shape, np.nan), series.optics.pixel_size_um)
    fit = gauge_fit(heights.z_um, true, gauge, xy, "absolute", narrower=False)
    answer = _depth("", depth_errors(heights.z_um, true, gauge, xy))
    answer |= _depth("common_", depth_errors(heights.z_um, true, COMMON, xy))
    answer |= _split(heights.z_um, true, xy)
    answer |= _honesty(heights, fit, true, xy)
    answer |= _shape(heights, fit, truth, series, judged, xy)
    if estimate.points is not None and len(estimate.points):
        answer |= _points(estimate.points, estimate.poses, truth, series, gauge)
    if estimate.poses is not None and len(estimate.poses) == len(series):
        answer |= pose_errors(estimate.poses, truth, "mirror" in gauge)
    return answer


def filled(estimate: Estimate, series: TiltSeries) -> HeightMap | None:
    """Heights between the points of an estimate that has no others; None where they make no surface."""
    from semrecon.surface.meshing import height_map_from_points

    if estimate.points is None or not len(estimate.points):
        return None
    poses = estimate.poses or nominal_poses(series)
    try:
        return height_map_from_points(
            estimate.points, series.optics, poses.rotations[series.reference], poses.translations_um[series.reference]
        )
    except (InputError, MethodError):
        return None


def grid_um(shape: tuple[int, ...], pixel_size_um: float) -> Array:
    """Places of pixels about the centre of the image, x right and y up, (rows, columns, 2) um."""
    rows, columns = np.indices(shape, dtype=np.float64)
    return np.stack([columns - (shape[1] - 1) / 2, (shape[0] - 1) / 2 - rows], axis=-1) * pixel_size_um


def _depth(prefix: str, found: DepthErrors) -> Metrics:
    names = ("median_abs_um", "rms_um", "p95_um", "bias_um", "penalised_median_abs_um", "completeness")
    return {prefix + name.replace("median_abs", "median"): float(getattr(found, name)) for name in names}


def _split(z_um: Array, true: Array, xy: Array) -> Metrics:
    names = ("offset_um", "scale", "tilt_x_deg", "tilt_y_deg", "remainder_rms_um", "total_rms_um")
    try:
        found = error_split(z_um, true, xy)
    except InputError:
        return dict.fromkeys((f"split_{name}" for name in names), NAN)
    return {f"split_{name}": float(getattr(found, name)) for name in names}


def _honesty(heights: HeightMap, fit: GaugeFit | None, true: Array, xy: Array) -> Metrics:
    """Shares of heights whose error is within 1 and 2 of the sigma stated for them: 0.683 and 0.954 if it is right."""
    if fit is None:
        return {"within_1_sigma": NAN, "within_2_sigma": NAN}
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(fit.error(heights.z_um, true, xy)) / (abs(fit.scale) * heights.sigma_um)
    known = ratio[np.isfinite(ratio)]
    return {f"within_{n}_sigma": float(np.mean(known <= n)) if known.size else NAN for n in (1, 2)}


def _shape(
    heights: HeightMap, fit: GaugeFit | None, truth: GroundTruth, series: TiltSeries, judged: Mask, xy: Array
) -> Metrics:
    """F-score at the tolerances and the error of the normals, after the declared gauge is removed."""
    view, size = series.reference, series.optics.pixel_size_um
    aligned = np.full(judged.shape, np.nan) if fit is None else fit.error(heights.z_um, np.zeros(judged.shape), xy)
    every = world_points(aligned, truth, view, series.optics)
    scores = f_scores(every, truth, truth.buffers[view].position_um[judged], [size * each for each in TOLERANCES_PX])
    answer = {"normal_deg": normal_error_deg(aligned, truth.height_map(view), judged, size)}
    for tolerance, each in zip(TOLERANCES_PX, scores, strict=True):
        named = zip(("fscore", "precision", "recall"), each, strict=True)
        answer |= {f"{name}_{tolerance:g}px": value for name, value in named}
    return answer


def _points(
    points: PointCloud, poses: Poses | None, truth: GroundTruth, series: TiltSeries, gauge: Sequence[Gauge]
) -> Metrics:
    """Depth and distance of the points themselves, where the reference view sees them."""
    view = series.reference
    pose = poses or nominal_poses(series)
    rotation, shift = pose.rotations[view], pose.translations_um[view]
    projected = project(points.xyz_um, rotation, shift, series.optics)
    xy_px = np.where(np.isfinite(points.xy_px), points.xy_px, projected)
    in_view = points.xyz_um @ view_from_world(rotation).T + shift * [1.0, -1.0, -1.0]
    true = np.full(len(points), np.nan)
    inside = np.isfinite(xy_px).all(axis=1) & np.isfinite(in_view).all(axis=1)
    true[inside] = true_heights(truth, view, xy_px[inside])
    if not np.isfinite(true).any():
        return {"points": float(len(points))}
    found = depth_errors(in_view[:, 2], true, gauge, in_view[:, :2])
    fit = gauge_fit(in_view[:, 2], true, gauge, in_view[:, :2], "absolute", narrower=False)
    answer = {"points": float(len(points)), "points_median_um": found.median_abs_um, "points_rms_um": found.rms_um}
    if fit is not None:
        z_um = fit.error(in_view[inside, 2], np.zeros(int(inside.sum())), in_view[inside, :2])
        placed = cloud_in_world(np.column_stack([in_view[inside, :2], z_um]), truth, view)
        (_, precision, _), *_ = f_scores(placed, truth, placed, [series.optics.pixel_size_um])
        answer["points_precision_1px"] = precision * float(inside.mean())
    return answer


def pose_errors(poses: Poses, truth: GroundTruth, mirrored_too: bool) -> Metrics:
    """Errors of the rotation steps between neighbouring views, means over the steps.

    Parameters
    ----------
    mirrored_too
        The sign of the relief is free, and with it that of all tilts: the better of both counts.
    """
    flip = np.diag([1.0, 1.0, -1.0])
    true = [pose.rotation for pose in truth.poses]
    choices = [list(poses.rotations)]
    if mirrored_too:
        choices.append([flip @ rotation @ flip for rotation in poses.rotations])
    found = []
    for rotations in choices:
        steps = [(b @ a.T, d @ c.T) for (a, b), (c, d) in zip(pairwise(true), pairwise(rotations), strict=True)]
        if not steps or not np.isfinite(poses.rotations).all():
            return {"rre_deg": NAN, "tilt_step_error_deg": NAN}
        rre = float(np.mean([relative_rotation_error_deg(*step) for step in steps]))
        angles = np.rad2deg([[rotation_angle_rad(one) for one in step] for step in steps])
        found.append((rre, float(np.mean(np.abs(angles[:, 1] - angles[:, 0])))))
    rre, step_error = min(found)
    return {"rre_deg": rre, "tilt_step_error_deg": step_error}
