"""The judge is right: truth scores zero, what is missing never helps, gauges remove what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.judging.judge import TOLERANCES_PX, filled, judge, pose_errors
from benchmarks.oracles import truth_as_estimate
from benchmarks.running.stored import packed, unpacked
from benchmarks.scenes import SimulatedSource
from semrecon.data import Estimate, HeightMap, Poses, TiltSeries
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from semsim.truth import GroundTruth


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSource:
    grain = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    scene = Scene("grain", grain, Microscope(0.6, 160, 120), TiltSchedule((0.0, 5.0, 10.0)))
    return SimulatedSource(scene, tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def truth(source: SimulatedSource) -> GroundTruth:
    return source.truth()


@pytest.fixture(scope="module")
def series(source: SimulatedSource) -> TiltSeries:
    return source.series(0)


def scored(estimate, truth, series, source, gauge=("offset",)):
    return judge(estimate, truth, series, gauge, source)


def with_heights(z_um, sigma_um=None) -> Estimate:
    return Estimate(heights=HeightMap(z_um, np.full(z_um.shape, np.nan) if sigma_um is None else sigma_um, 0.6))


def test_the_truth_as_an_estimate_scores_exactly_zero_and_complete(truth, series, source) -> None:
    found = scored(truth_as_estimate(truth, 0), truth, series, source)
    for name in ("median_um", "rms_um", "p95_um", "penalised_median_um", "common_median_um", "common_rms_um"):
        assert found[name] == 0.0, name
    assert found["completeness"] == 1.0
    assert found["normal_deg"] == 0.0
    assert found["rre_deg"] < 1e-12
    assert [found[f"fscore_{each:g}px"] for each in TOLERANCES_PX] == [1.0] * 4
    assert (found["split_scale"], found["split_offset_um"]) == (pytest.approx(1.0), 0.0)
    assert found["points_median_um"] < 1e-9
    assert found["points_precision_1px"] == pytest.approx(1.0, abs=2e-3)


def test_a_gauge_is_removed_where_declared_and_nothing_else(truth, series, source) -> None:
    true = truth.height_map(0)
    lifted = scored(with_heights(true + 9.0), truth, series, source)
    assert lifted["median_um"] < 1e-12
    assert lifted["split_offset_um"] == pytest.approx(9.0)
    halved = scored(with_heights(0.5 * true), truth, series, source)
    assert halved["median_um"] > 1
    assert halved["split_scale"] == pytest.approx(0.5)
    assert halved["common_median_um"] < 1e-9
    assert halved["fscore_1px"] < 0.5
    free = scored(with_heights(-0.5 * true), truth, series, source, ("offset", "scale", "mirror"))
    assert free["median_um"] < 1e-9
    assert free["fscore_1px"] > 0.99
    assert free["normal_deg"] < 1e-6


def test_what_is_missing_never_helps(truth, series, source) -> None:
    rng = np.random.default_rng(0)
    noisy = truth.height_map(0) + rng.normal(0, 0.5, truth.height_map(0).shape)
    gone = noisy.copy()
    gone[np.abs(noisy - truth.height_map(0)) > 0.4] = np.nan  # the worst: this is how a median is flattered
    whole, part = (scored(with_heights(each), truth, series, source) for each in (noisy, gone))
    assert part["median_um"] < whole["median_um"]
    assert part["completeness"] < 0.7 < 0.999 < whole["completeness"]
    assert part["penalised_median_um"] >= 0.99 * whole["penalised_median_um"]
    for each in TOLERANCES_PX:
        assert part[f"recall_{each:g}px"] <= whole[f"recall_{each:g}px"]


def test_nothing_at_all_scores_nothing(truth, series, source) -> None:
    found = scored(with_heights(np.full(truth.height_map(0).shape, np.nan)), truth, series, source)
    assert found["completeness"] == 0.0
    assert np.isnan(found["median_um"])
    assert found["penalised_median_um"] == np.inf
    assert all(found[f"fscore_{each:g}px"] == 0.0 for each in TOLERANCES_PX)


def test_an_honest_sigma_is_found_honest(truth, series, source) -> None:
    true = truth.height_map(0)
    noisy = true + np.random.default_rng(1).normal(0, 0.3, true.shape)
    for stated, one, two in ((0.3, 0.683, 0.954), (0.6, 0.954, 1.0), (0.15, 0.383, 0.683)):
        found = scored(with_heights(noisy, np.full(true.shape, stated)), truth, series, source)
        assert found["within_1_sigma"] == pytest.approx(one, abs=0.02)
        assert found["within_2_sigma"] == pytest.approx(two, abs=0.02)
    assert found["median_um"] == pytest.approx(0.6745 * 0.3, rel=0.05)


def test_points_alone_are_filled_and_judged(truth, series, source) -> None:
    whole = truth_as_estimate(truth, 0)
    assert whole.points is not None
    sparse = Estimate(points=whole.points.keep(np.arange(0, len(whole.points), 5)))
    assert filled(sparse, series) is not None
    found = scored(sparse, truth, series, source)
    assert found["points"] == len(sparse.points)
    assert found["points_median_um"] < 1e-9
    assert 0.9 < found["completeness"] <= 1
    assert 0 < found["median_um"] < 0.6  # between the points the map is linear
    assert "rre_deg" not in found


def test_poses_are_judged_by_their_steps(truth) -> None:
    true = np.stack([pose.rotation for pose in truth.poses])
    flip = np.diag([1.0, 1.0, -1.0])
    mirrored = Poses(flip @ true @ flip, np.zeros((3, 3)))
    assert pose_errors(mirrored, truth, True)["rre_deg"] < 1e-9
    assert pose_errors(mirrored, truth, False)["rre_deg"] == pytest.approx(
        10.0
    )  # the tilt steps of 5 degrees turned about
    still = Poses(np.stack([true[0]] * 3), np.zeros((3, 3)))
    assert pose_errors(still, truth, False) == {
        "rre_deg": pytest.approx(5.0),
        "tilt_step_error_deg": pytest.approx(5.0),
    }


def test_what_is_kept_is_judged_the_same(truth, series, source) -> None:
    estimate = truth_as_estimate(truth, 0)
    noisy = replace(estimate, heights=replace(estimate.heights, z_um=estimate.heights.z_um + 0.1))
    blob = packed(noisy)
    back = unpacked(blob)
    assert np.array_equal(np.isnan(back.heights.z_um), np.isnan(noisy.heights.z_um))
    fresh, again = scored(noisy, truth, series, source), scored(back, truth, series, source)
    assert fresh.keys() == again.keys()
    for name in ("median_um", "rms_um", "completeness", "fscore_1px", "rre_deg"):
        assert again[name] == pytest.approx(fresh[name], abs=2e-6)
    assert packed(unpacked(blob)) == blob
    assert unpacked(packed(Estimate())) == Estimate()
