"""Numbers that scores do not hold: errors at the points of another method, tilts view by view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates, median_filter

from benchmarks.judging.evaluate import true_heights
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.case import Case
from benchmarks.running.stored import unpacked
from semrecon.data import Array, Estimate, HeightMap, Mask, Poses, TiltSeries
from semrecon.geometry import nominal_poses, project, view_from_world
from semrecon.numerics.motion import rotation_angle_rad
from semsim.truth import GroundTruth

Numbers = dict[str, float]
NAN = float("nan")
AROUND_PX, PIT_PX = 21, 3.0
"""A point lies in a pit if it is so much deeper than the median height of a square of that width about it, px."""


def same_points(ledger: Path, dense: Case, points: Case) -> tuple[tuple[str, str], Numbers]:
    """Judge a dense answer at the points of another one, beside those points; from the record, by a worker."""
    record = BenchLedger(ledger)
    one, other = (unpacked(record.answer(case).estimate) for case in (dense, points))
    source = dense.scene.source
    found = at_same_points(one, other, source.truth(), dense.scene.series(dense.repetition))
    return (dense.scene.name, dense.method.name), found


def tilts_of(ledger: Path, case: Case) -> tuple[tuple[str, str], Numbers]:
    """Judge the tilts of an answer view by view; from the record, by a worker."""
    estimate = unpacked(BenchLedger(ledger).answer(case).estimate)
    series = case.scene.series(case.repetition)
    stated = tilt_errors_deg(nominal_poses(series), case.scene.source.truth(), series.reference)
    numbers = {"tilt_stated_worst_deg": float(stated.max())}
    if estimate.poses is not None:
        errors = tilt_errors_deg(estimate.poses, case.scene.source.truth(), series.reference)
        numbers |= {"tilt_median_deg": float(np.median(errors)), "tilt_worst_deg": float(errors.max())}
    return (case.scene.name, case.method.name), numbers


def at_same_points(dense: Estimate, points: Estimate, truth: GroundTruth, series: TiltSeries) -> Numbers:
    """Median absolute depth errors of heights and of points, both at the points that have a height and a truth.

    Each has the median of its errors taken away: the offset that neither can know.

    Returns
    -------
    `same_points_dense_um`, `same_points_um`, `same_points_ratio`, and `same_points_share` of the points that took part.
    Of these, `same_points_in_pits` is the share in pits, and `same_points_dense_filled_um` and
    `same_points_filled_um` say how much higher heights and points come out there than elsewhere.
    """
    missing = dict.fromkeys(("same_points_dense_um", "same_points_um", "same_points_ratio"), NAN)
    if dense.heights is None or points.points is None or not len(points.points):
        return missing | {"same_points_share": 0.0}
    xy_px, z_um = seen_points(points, series)
    true_um = np.full(len(z_um), np.nan)
    inside = np.isfinite(xy_px).all(axis=1) & np.isfinite(z_um)
    true_um[inside] = true_heights(truth, series.reference, xy_px[inside])
    dense_um = sampled(dense.heights, xy_px)
    both = np.isfinite(dense_um) & np.isfinite(true_um)
    if not both.any():
        return missing | {"same_points_share": 0.0}
    one, other = (_median_error(each[both] - true_um[both]) for each in (dense_um, z_um))
    share = both.sum() / max(int(np.isfinite(true_um).sum()), 1)
    numbers = {"same_points_dense_um": one, "same_points_um": other, "same_points_share": float(share)}
    pits = in_pits(truth.height_map(series.reference), xy_px[both], PIT_PX * series.optics.pixel_size_um)
    filled = {
        f"same_points_{name}filled_um": _higher((each - true_um)[both], pits)
        for name, each in (("dense_", dense_um), ("", z_um))
    }
    numbers |= filled | {"same_points_in_pits": float(pits.mean())}
    return numbers | {"same_points_ratio": one / other if other > 0 else NAN}


def in_pits(true_um: Array, xy_px: Array, deeper_um: float) -> Mask:
    """Say which places (n, 2), px, lie so much deeper than what is round them, (n,).

    Parameters
    ----------
    true_um
        True heights, (rows, columns), NaN where there is nothing: that counts as the deepest place.
    """
    known = np.where(np.isfinite(true_um), true_um, np.nanmin(true_um))
    depth = median_filter(known, AROUND_PX) - known
    return np.asarray(map_coordinates(depth, xy_px[:, ::-1].T, order=0, mode="nearest") > deeper_um)


def _higher(errors_um: Array, there: Mask) -> float:
    """Median error there above that elsewhere, um; NaN where one of them has none."""
    return float(np.median(errors_um[there]) - np.median(errors_um[~there])) if 0 < there.sum() < there.size else NAN


def seen_points(estimate: Estimate, series: TiltSeries) -> tuple[Array, Array]:
    """Where the reference view sees the points of an estimate, (n, 2) px, and their heights along its beam, (n,) um."""
    assert estimate.points is not None
    pose = estimate.poses or nominal_poses(series)
    rotation, shift = pose.rotations[series.reference], pose.translations_um[series.reference]
    projected = project(estimate.points.xyz_um, rotation, shift, series.optics)
    xy_px = np.where(np.isfinite(estimate.points.xy_px), estimate.points.xy_px, projected)
    in_view = estimate.points.xyz_um @ view_from_world(rotation).T + shift * [1.0, -1.0, -1.0]
    return xy_px, np.asarray(in_view[:, 2])


def sampled(heights: HeightMap, xy_px: Array) -> Array:
    """Heights between pixels, bilinear, (n,) um; NaN where a pixel that counts has none, and outside the picture."""
    rows_columns = np.nan_to_num(xy_px[:, ::-1].T, nan=-1.0)
    values = map_coordinates(heights.z_um, rows_columns, order=1, mode="constant", cval=np.nan)
    return np.asarray(values)


def tilt_errors_deg(poses: Poses, truth: GroundTruth, reference: int) -> Array:
    """Errors of the angle between the reference view and each other one, absolute, (views - 1,) degrees."""
    true = [pose.rotation for pose in truth.poses]
    others = [view for view in range(len(true)) if view != reference]
    angles = [
        [rotation_angle_rad(rotations[view] @ rotations[reference].T) for view in others]
        for rotations in (true, list(poses.rotations))
    ]
    return np.asarray(np.rad2deg(np.abs(np.subtract(*np.array(angles)))))


def _median_error(errors_um: Array) -> float:
    return float(np.median(np.abs(errors_um - np.median(errors_um))))
