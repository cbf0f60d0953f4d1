"""One repetition of the seed's study: photograph, match, make clouds, register, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judging.evaluate import cloud_score, map_score, registration_score
from benchmarks.running.ledger import Row
from benchmarks.running.runner import Job, code_version, digest, seed_of
from benchmarks.scenes import Source, views_from_world
from benchmarks.seed_study.contenders import ALL_VIEWS, CONTENDERS, Contender
from semrecon.clouds.registration import SequenceRegistration, register_sequence
from semrecon.data import Array, HeightMap, Optics, PointCloud, TiltSeries
from semrecon.errors import MethodError
from semrecon.geometry import CAM_FROM_VIEW
from semrecon.judging.metrics import DepthErrors
from semrecon.matches.correspondence import CorrespondenceOptions, PairMatches, match_pairs
from semrecon.methods.disparity import adjacent_pairs
from semrecon.methods.known_rotation import KnownRotation
from semrecon.surface.meshing import height_map_from_points
from semsim.truth import GroundTruth

STUDY = "paper"
NAMES = (*(contender.name for contender in CONTENDERS), ALL_VIEWS)
MAP_STEP = 4
"""Completeness and map errors are judged on every fourth row and column: the maps are linear between matches."""


def jobs(source: Source, repetitions: int) -> list[Job]:
    """One job a repetition; its keys are those of all contenders."""
    identity, version = source.identity, code_version()
    keys = [tuple(digest(STUDY, identity, name, each, version) for name in NAMES) for each in range(repetitions)]
    return [Job(each, measure, (source, number, each)) for number, each in enumerate(keys)]


def measure(source: Source, repetition: int, keys: tuple[str, ...]) -> list[Row]:
    """Run all contenders on one repetition; where they cannot answer, the row says why.

    Parameters
    ----------
    keys
        Of the rows, in the order of `NAMES`: whoever asks decides what the rows are called.
    """
    import cv2

    cv2.setNumThreads(1)  # the jobs run side by side already
    series = source.series(repetition)
    rng = np.random.default_rng(seed_of(f"{source.name}/matching", repetition))
    pairs = list(combinations(range(len(series)), 2))
    try:
        matches = match_pairs(series, pairs, CorrespondenceOptions(), rng, optional=True)
        adjacent = adjacent_pairs(matches, len(series))
    except MethodError as error:
        rows = [Row("", STUDY, source.name, name, repetition, {}, str(error)) for name in NAMES]
    else:
        rows = [_judged(source, contender, series, adjacent, repetition) for contender in CONTENDERS]
        rows.append(_all_views(source, series, matches, repetition))
    return [replace(row, key=key) for row, key in zip(rows, keys, strict=True)]


def _judged(
    source: Source,
    contender: Contender,
    series: TiltSeries,
    matches: Sequence[PairMatches],
    repetition: int,
) -> Row:
    frames = views_from_world(series)
    clouds = contender.clouds(series, matches)
    registered = register_sequence(clouds)
    score = registration_score(clouds, registered, frames)
    metrics = {
        "clouds": len(clouds),
        "points": float(np.mean([len(cloud) for cloud in clouds])),
        "rmse_um": score.rmse_um,
        "rmse_back_um": score.rmse_back_um,
        "rre_deg": score.rre_deg,
        "icp_iterations": float(np.mean([pair.iterations or 0 for pair in registered.pairs]))
        if registered.pairs
        else 0,
    }
    arrays = _kept(clouds, registered, frames)
    if (truth := source.truth()) is not None:
        depth, errors = _against_truth(source, clouds, matches, truth, series.optics)
        metrics |= depth
        arrays |= errors
    return Row("", STUDY, source.name, contender.name, repetition, metrics, arrays=arrays)


def _against_truth(
    source: Source, clouds: Sequence[PointCloud], matches: Sequence[PairMatches], truth: GroundTruth, optics: Optics
) -> tuple[dict[str, float], dict[str, NDArray[Any]]]:
    """Depth errors, each the mean over the clouds, and the signed error of every point."""
    scores = [cloud_score(cloud, truth, found.pair[0]) for cloud, found in zip(clouds, matches, strict=True)]
    maps = [
        map_score(coarse_map(cloud, optics, MAP_STEP), truth, found.pair[0], source.judgeable(found.pair, MAP_STEP))
        for cloud, found in zip(clouds, matches, strict=True)
    ]
    errors = {f"error_{k}": score.errors_um.astype(np.float32) for k, score in enumerate(scores)}
    offsets = {f"offset_{k}": np.array(score.offset_um) for k, score in enumerate(scores)}
    return _depth_metrics([score.summary for score in scores], maps), errors | offsets


def _depth_metrics(points: Sequence[DepthErrors], maps: Sequence[DepthErrors]) -> dict[str, float]:
    metrics = {
        "depth_median_um": [each.median_abs_um for each in points],
        "depth_rms_um": [each.rms_um for each in points],
        "depth_p95_um": [each.p95_um for each in points],
        "map_median_um": [each.median_abs_um for each in maps],
        "map_p95_um": [each.p95_um for each in maps],
        "completeness": [each.completeness for each in maps],
    }
    return {name: float(np.mean(values)) for name, values in metrics.items()}


def coarse_map(cloud: PointCloud, optics: Optics, step: int) -> HeightMap:
    """Fill the mesh of a cloud, in the view frame of its first view, on every `step`-th row and column of that view."""
    height, width = -(-optics.height_px // step), -(-optics.width_px // step)
    coarse = Optics(optics.pixel_size_um * step, width, height)
    shift = (optics.centre_px - step * coarse.centre_px) * optics.pixel_size_um
    return height_map_from_points(cloud, coarse, CAM_FROM_VIEW, np.append(shift, 0.0))


def _kept(clouds: Sequence[PointCloud], registered: SequenceRegistration, frames: Array) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"merged": registered.merged.xyz_um.astype(np.float32)}
    for k, cloud in enumerate(clouds):
        arrays |= {
            f"cloud_{k}": cloud.xyz_um.astype(np.float32),
            f"xy_{k}": cloud.xy_px.astype(np.float32),
            f"frame_{k}": frames[k],
        }
    return arrays


def _all_views(source: Source, series: TiltSeries, matches: Sequence[PairMatches], repetition: int) -> Row:
    """Judge the proposed geometry with all views at once."""
    found = KnownRotation().from_matches(series, matches)
    assert found.points is not None
    metrics: dict[str, float] = {"points": len(found.points), "sigma_px": found.diagnostics["sigma_px"]}
    arrays = {"merged": found.points.xyz_um.astype(np.float32)}
    if (truth := source.truth()) is not None:
        reference = series.reference
        inside = np.asarray(np.isfinite(found.points.xy_px).all(axis=1))
        turned = _turned(found.points.keep(inside), views_from_world(series)[reference])
        point = cloud_score(turned, truth, reference).summary
        others = tuple(i for i in range(len(series)) if i != reference)
        judged = source.judgeable((reference, *others), MAP_STEP)
        filled = map_score(coarse_map(turned, series.optics, MAP_STEP), truth, reference, judged)
        metrics |= _depth_metrics([point], [filled])
    return Row("", STUDY, source.name, ALL_VIEWS, repetition, metrics, arrays=arrays)


def _turned(cloud: PointCloud, rotation: Array) -> PointCloud:
    turned = rotation @ cloud.covariance_um2 @ rotation.T
    return PointCloud(cloud.xyz_um @ rotation.T, turned, cloud.residual_px, cloud.xy_px)
