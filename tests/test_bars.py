"""`python -m benchmarks bars`: what is asked is asked of fresh specimens, and a bar that fails is said to fail."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_1samp
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.bars import bar as catalogue
from benchmarks.bars import depth, left_out, real, shading, size, study, tilts
from benchmarks.bars.bar import Bar, all_bars
from benchmarks.bars.derived import at_same_points, in_pits, sampled, tilt_errors_deg
from benchmarks.bars.entrants import DENSE, SEED, OfPair, dense, pair_of, seed_of_pair
from benchmarks.bars.honesty import sigma_lines
from benchmarks.bars.limit import efficiency_lines
from benchmarks.bars.line import INF, TOLD, Asked, Line, mean_over_specimens, ratio_over_specimens, worst_of
from benchmarks.bars.plan import Found, plan_of
from benchmarks.bars.specimens import FIRST_SEED, Specimens
from benchmarks.bars.start import from_truth
from benchmarks.bars.study import Study, run_bars
from benchmarks.judging.efficiency import scene_limit
from benchmarks.judging.paired import Interval
from benchmarks.oracles import truth_as_estimate
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.cell import Limits
from benchmarks.running.ledger import Row
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import SPECIMEN_SEEDS, BenchScene, suite
from semrecon.data import Estimate, HeightMap, Optics, PointCloud, Poses, TiltSeries, View
from semrecon.errors import InputError
from semrecon.geometry import nominal_poses, rotations_from_tilts
from semrecon.methods import KnownRotation
from semrecon.methods.dense_multiview import DenseMultiview
from semrecon.reconstruction import Reconstruction
from semrecon.surface.completion import complete, points_from_heights
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests.small_grain import close_cell
from tests.troubled_methods import Troubled

LIMITS = Limits(60.0, 2.0)
GRAIN = {"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0}


def small(name: str, cache: Path, tilts_deg: Sequence[float] = (0.0, 5.0, 10.0)) -> BenchScene:
    """A grain of coarse mesh, under the name of a scene of the suite."""
    scene = Scene(name, specimen_from(GRAIN), Microscope(0.6, 160, 120), TiltSchedule(tuple(tilts_deg)))
    return BenchScene(name, "A grain.", SimulatedSource(scene, cache), ("pixel_size", "rotations", "tilt_axis"))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def grain(cache: Path) -> Specimens:
    return Specimens((small("pollen", cache),), 1)


@pytest.fixture(scope="module")
def whole(cache: Path) -> Specimens:
    """The suite as it is, with three specimens of each; nothing is rendered."""
    return Specimens(suite(cache), 3)


def found_of(scores: dict[tuple[str, str], dict[str, float] | str]) -> Found:
    """Results as if they had been measured; a sentence is a failure."""
    return Found(
        {
            at: Result("", *at, 0, "refused" if isinstance(said, str) else "", said if isinstance(said, str) else "")
            if isinstance(said, str)
            else Result("", *at, 0, metrics=said)
            for at, said in scores.items()
        }
    )


# lines and intervals


@pytest.mark.parametrize(
    ("asked", "measured", "verdict"),
    [
        (Asked(most=1.5), Interval(1.2, 1.1, 1.3), "holds"),
        (Asked(most=1.5), Interval(1.2, 0.8, 1.6), "holds, not settled"),
        (Asked(most=1.5), Interval(1.7, 1.6, 1.8), "fails"),
        (Asked(most=1.5), Interval(1.7, 1.4, 2.0), "fails, not settled"),
        (Asked(63, 73), Interval(80, 76, 84), "fails"),
        (Asked(63, 73), Interval(60, 62, 58), "fails"),
        (Asked(63, 73), Interval(60, 50, 80), "fails, not settled"),
        (Asked(least=3), Interval(3.5), "holds, no interval"),
        (Asked(least=3), Interval(INF), "holds, no interval"),
        (Asked(most=1), Interval(INF), "fails, no interval"),
        (Asked(most=1), Interval(), "not measured"),
        (TOLD, Interval(5.0), ""),
    ],
)
def test_a_verdict_says_whether_a_bar_holds_and_whether_that_is_settled(
    asked: Asked, measured: Interval, verdict: str
) -> None:
    assert Line("bar", "of", asked, measured).verdict == verdict


def test_what_is_asked_is_said() -> None:
    asked = (Asked(most=1.5), Asked(3), Asked(63, 73), TOLD, Asked(most=1 / 7, text="at most 1/7"))
    assert [str(each) for each in asked] == ["at most 1.5", "at least 3", "63 to 73", "-", "at most 1/7"]


def test_the_interval_of_one_scene_is_that_of_student() -> None:
    values = np.array([1.0, 1.4, 0.7])
    known = ttest_1samp(values, 0.0).confidence_interval(0.95)
    found = mean_over_specimens([values])
    assert (found.value, found.low, found.high) == pytest.approx((values.mean(), known.low, known.high))
    assert not mean_over_specimens([values[:1]]).known
    assert np.isnan(mean_over_specimens([]).value)
    assert mean_over_specimens([np.ones(3)]) == Interval(1.0, 1.0, 1.0)


def test_the_interval_holds_the_truth_as_often_as_it_says() -> None:
    """Two scenes of other mean and spread, three specimens each; of the scenes' own difference it knows nothing."""
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(3000, 2, 3)) * [[1.0], [0.4]] + [[0.0], [5.0]]
    intervals = [mean_over_specimens(list(each)) for each in drawn]
    held = np.mean([each.low <= 2.5 <= each.high for each in intervals])
    assert 0.935 < held < 0.98


def test_ratios_are_averaged_by_their_logarithms() -> None:
    values = np.array([0.5, 0.2, 0.8])
    found, turned = ratio_over_specimens([values]), ratio_over_specimens([1 / values])
    assert found.value == pytest.approx(np.cbrt(0.08))
    assert (1 / turned.value, 1 / turned.high, 1 / turned.low) == pytest.approx((found.value, found.low, found.high))
    assert ratio_over_specimens([np.array([0.1, INF])]).value == INF


def test_the_worst_line_is_the_largest_and_what_is_missing_is_worse() -> None:
    lines = [Line("b", name, Asked(most=1), Interval(value)) for name, value in (("one", 0.5), ("two", 2.0))]
    assert worst_of(lines, "all").note == "the worst is two; 1 of 2 hold"
    lines.append(Line("b", "three", Asked(most=1), Interval()))
    assert worst_of(lines, "all").verdict == "not measured"


# specimens


def test_specimens_are_those_of_no_other_study(whole: Specimens) -> None:
    development = replace(whole, purpose="development")
    seeds = {each.of("pollen")[k].source.scene.specimen_seed for each in (whole, development) for k in range(3)}
    assert len(seeds) == 6
    assert not seeds & set(SPECIMEN_SEEDS.values())
    assert [each.source.scene.specimen_seed for each in whole.of("pollen")] == [8001, 8002, 8003]
    of_suite = next(each for each in whole.scenes if each.name == "pollen")
    noise = [each.seed(0) for each in (*whole.of("pollen"), *development.of("pollen"), of_suite)]
    assert len(set(noise)) == 7
    with pytest.raises(ValueError, match="there is no scene 'moon'"):
        whole.of("moon")


def test_doses_and_misstated_tilts_share_the_surfaces(grain: Specimens) -> None:
    (plain,), (bright,) = grain.of("pollen"), grain.of("pollen", dose_e=3200.0)
    (off,) = grain.of("pollen", tilt_errors_deg=(0.0, 0.1, -0.2), said="off")
    before, noisy = plain.series(0), plain.series(1)
    assert len(list(plain.source.cache.glob("pollen-bars-*"))) == 1
    clean, again = bright.series(0), bright.series(1)
    assert len(list(plain.source.cache.glob("pollen-bars-*"))) == 1
    assert (
        len({each.identity for each in (plain, bright, off)}) == len({each.name for each in (plain, bright, off)}) == 3
    )
    assert off.series(0).tilts_deg == pytest.approx(before.tilts_deg + [0.0, 0.1, -0.2])
    for one, other in zip(off.series(0).views, before.views, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    noise = [_noise_over_contrast(*pair) for pair in ((before, noisy), (clean, again))]
    assert noise[0] / noise[1] == pytest.approx(4.0, rel=0.1)  # sixteen times the dose
    limits = [scene_limit(each.source.surfaces()).median_abs_um for each in (plain, bright)]
    assert limits[0] / limits[1] == pytest.approx(4.0, rel=1e-6)
    assert plain.source.truth().mesh is off.source.truth().mesh


def _noise_over_contrast(one: TiltSeries, other: TiltSeries) -> float:
    """Noise of a picture taken twice, in parts of what both show: black level and gain do not count."""
    covariance = np.cov(one.views[0].image.ravel(), other.views[0].image.ravel())
    return float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2 / covariance[0, 1] - 1))


def test_tilts_are_off_by_what_is_said(whole: Specimens) -> None:
    scene = whole.of("pollen")[0].source.scene
    assert tilts.errors_deg(scene, tilts.MISSTATED[0]) == pytest.approx((0, 0.25 / 3, 0.5 / 3, 0.25))
    assert tilts.errors_deg(scene, tilts.MISSTATED[1]) == pytest.approx((0, -0.25, 0.25, -0.25))
    middle = whole.of("pyramid")[0].source.scene
    assert tilts.errors_deg(middle, tilts.MISSTATED[0]) == pytest.approx((-0.25, 0, 0.25))
    with pytest.raises(ValueError, match="tilts are off in proportion"):
        tilts.errors_deg(scene, "sideways")


# who is asked


@pytest.mark.parametrize(
    ("tilts_deg", "reference", "adjacent", "widest"),
    [((0, 3, 6, 9), 0, (0, 1), (0, 3)), ((-9, -6, 0, 7), 2, (1, 2), (0, 2)), ((5, 0), 1, (0, 1), (0, 1))],
)
def test_a_pair_holds_the_reference(tilts_deg, reference: int, adjacent, widest) -> None:
    assert pair_of(tilts_deg, reference, False) == adjacent
    assert pair_of(tilts_deg, reference, True) == widest


def test_a_pair_is_answered_as_if_there_were_no_other_view(grain: Specimens) -> None:
    series = grain.of("pollen")[0].series(0)
    method = OfPair(KnownRotation(), "pair", widest=True)
    found = method(series, rng=np.random.default_rng(5))
    alone = KnownRotation()(series.select(0, 2), rng=np.random.default_rng(5))
    assert found.points is not None
    np.testing.assert_array_equal(found.points.xyz_um, alone.points.xyz_um)
    assert len(found.poses) == 3
    assert np.isnan(found.poses.rotations[1]).all()
    np.testing.assert_array_equal(found.poses.rotations[[0, 2]], alone.poses.rotations)
    assert (method.gauge, method.needs, method.views) == (KnownRotation.gauge, KnownRotation.needs, KnownRotation.views)


def test_options_make_another_contender_and_defaults_do_not() -> None:
    plain = dense()
    assert dense(shading=plain.shading) == plain
    other = next(value for value in ("off", "auto", "everywhere") if value != plain.shading)
    assert (dense(shading=other).name, dense(shading=other).method.shading) == (f"{DENSE}, shading {other}", other)
    with pytest.raises(InputError, match="no option 'magic'"):
        dense(magic="true")


# numbers beside the scores


def test_at_the_same_points_truth_is_right_and_points_are_as_wrong_as_they_are(grain: Specimens) -> None:
    scene = grain.of("pollen")[0]
    series, truth = scene.series(0), scene.source.truth()
    exact = truth_as_estimate(truth, series.reference)
    noise = np.random.default_rng(1).normal(0, 0.5, len(exact.points))
    shifted = replace(exact.points, xyz_um=exact.points.xyz_um + np.outer(noise + 40, [0, 0, 1]))
    found = at_same_points(exact, replace(exact, points=shifted), truth, series)
    assert found["same_points_dense_um"] == pytest.approx(0, abs=1e-9)
    assert found["same_points_um"] == pytest.approx(0.6745 * 0.5, rel=0.03)
    assert found["same_points_share"] == 1.0
    holed = replace(exact.heights, z_um=np.where(np.arange(160) < 80, exact.heights.z_um, np.nan))
    half = at_same_points(replace(exact, heights=holed), exact, truth, series)
    assert 0.4 < half["same_points_share"] < 0.6
    assert at_same_points(Estimate(), exact, truth, series)["same_points_share"] == 0
    pits = in_pits(truth.height_map(series.reference), exact.points.xy_px, 3 * series.optics.pixel_size_um)
    filled = replace(exact.points, xyz_um=exact.points.xyz_um + np.outer(np.where(pits, 7.0, 0.0), [0, 0, 1]))
    raised = at_same_points(exact, replace(exact, points=filled), truth, series)
    assert raised["same_points_filled_um"] == pytest.approx(7, abs=1e-6)
    assert raised["same_points_dense_filled_um"] == pytest.approx(0, abs=1e-6)
    assert raised["same_points_in_pits"] == pits.mean()


def test_the_last_stages_begun_at_the_true_surface_stay_near_it(grain: Specimens) -> None:
    scene = grain.of("pollen")[0]
    series, truth = scene.series(0), scene.source.truth()
    true_um = truth.height_map(series.reference)
    errors = from_truth(DenseMultiview(), series, truth) - true_um
    seen = scene.source.judgeable((series.reference, 1, 2), 1) & np.isfinite(true_um)
    assert np.isfinite(errors).sum() == np.isfinite(true_um).sum()
    off = errors[seen] - np.median(errors[seen])
    assert 1e-3 < np.median(np.abs(off)) < 0.2 * np.std(true_um[seen])


def test_pits_are_places_deeper_than_what_is_round_them() -> None:
    true = np.zeros((60, 80))
    true[20:25, 30:35], true[40:, 60:] = -5.0, -5.0  # a pit, and ground that is merely lower
    true[0, 0] = np.nan
    places = np.array([[32.0, 22.0], [75.0, 55.0], [10.0, 10.0], [0.0, 0.0]])
    assert in_pits(true, places, 3.0).tolist() == [True, False, False, True]


def test_heights_between_pixels_are_those_of_a_plane() -> None:
    rows, columns = np.indices((6, 8), dtype=float)
    heights = HeightMap(2 * columns - rows, np.ones((6, 8)), 1.0)
    xy = np.array([[3.25, 2.5], [7.0, 5.0], [7.2, 1.0], [np.nan, 1.0]])
    np.testing.assert_allclose(sampled(heights, xy), [4.0, 9.0, np.nan, np.nan])


def test_errors_of_tilts_are_those_put_in(grain: Specimens) -> None:
    truth = grain.of("pollen")[0].source.truth()
    poses = Poses(rotations_from_tilts(np.array([1.0, 6.1, 10.8])), np.zeros((3, 3)))
    assert tilt_errors_deg(poses, truth, 0) == pytest.approx([0.1, 0.2], abs=1e-9)  # 1 degree in common is no error


# what bars say


def pair_scores(specimens: Specimens, ours: float, complete: float = 1.0) -> dict:
    other = seed_of_pair(widest=False).name
    answer: dict = {}
    for name in depth.TWO_VIEW_SCENES:
        for k, scene in enumerate(specimens.of(name)):
            error = ours * (1 + 0.1 * k)
            answer[scene.name, DENSE] = {"penalised_median_um": error, "median_um": error, "completeness": complete}
            answer[scene.name, other] = {"points_median_um": 0.8}
    return answer


def adjacent(specimens: Specimens, scores: dict) -> list[Line]:
    return depth.pair_lines(specimens, found_of(scores), bar="adjacent", widest=False)


def test_a_bar_that_holds_and_one_that_fails_are_said_to(whole: Specimens) -> None:
    good, bad = (adjacent(whole, pair_scores(whole, ours)) for ours in (0.08, 0.2))
    assert [line.verdict for line in good] == ["holds"] * 3 + ["", ""]
    assert good[0].measured.value == pytest.approx(0.1 * np.cbrt(1.1 * 1.2))
    assert [line.verdict for line in bad] == ["fails"] * 3 + ["", ""]
    holed = adjacent(whole, pair_scores(whole, 0.08, 0.9))
    assert holed[-3].what.endswith("at the pixels that dense_multiview answers")
    assert "completeness 90 %" in holed[0].note


def test_the_bar_on_adjacent_views_tells_what_a_true_start_would_bring(whole: Specimens) -> None:
    scores = pair_scores(whole, 0.2)
    begun = {"from_truth_ratio": 1.1, "from_truth_rms_ratio": 0.6}
    scores = {key: value | begun if key[1] == DENSE else value for key, value in scores.items()}
    told = [line for line in adjacent(whole, scores) if line.asked.anything]
    assert [line.measured.value for line in told] == pytest.approx([1.1, 0.6])


def test_a_specimen_without_an_answer_fails_the_bar_with_its_sentence(whole: Specimens) -> None:
    scores = pair_scores(whole, 0.05)
    scores[whole.of("pollen")[1].name, DENSE] = "there is nothing to see"
    line = adjacent(whole, scores)[0]
    assert (line.verdict, line.measured.value) == ("fails, no interval", INF)
    assert "dense_multiview on pollen, specimen 8002: there is nothing to see" in line.note


def test_the_bar_on_the_diatom_tells_what_lies_in_pits(whole: Specimens) -> None:
    scenes, names = whole.of("diatom"), ("ratio", "share", "dense_um", "um", "in_pits", "dense_filled_um", "filled_um")
    numbers = dict(zip((f"same_points_{name}" for name in names), (1.2, 0.99, 1.2, 1.0, 0.4, 3.0, 2.0), strict=True))
    head, *told = depth.diatom_lines(whole, found_of({(scene.name, DENSE): numbers for scene in scenes}))
    assert (head.verdict, head.measured.value) == ("fails", pytest.approx(1.2))
    assert [line.measured.value for line in told] == pytest.approx([0.4, 3.0, 2.0])
    lone = numbers | {"same_points_filled_um": float("nan")}  # one specimen whose points are all outside of pits
    answers = {(scene.name, DENSE): numbers if k else lone for k, scene in enumerate(scenes)}
    assert depth.diatom_lines(whole, found_of(answers))[-1].measured.value == pytest.approx(2.0)


def test_on_smooth_surfaces_the_best_other_is_one_that_always_answers(whole: Specimens) -> None:
    scores: dict = {}
    for k, scene in enumerate(whole.of("fracture_smooth", channels=True)):
        for name, error in ((DENSE, 0.5), (SEED, 0.6), ("disparity", 0.4 if k else INF), ("photometric_stereo", 0.1)):
            metrics = ("penalised_median_um", "common_penalised_median_um", "median_um")
            scores[scene.name, name] = dict.fromkeys(metrics, error) | {"completeness": 1.0}
    every, alike, common = depth.smooth_lines(whole, found_of(scores))
    assert (every.verdict, every.measured.value) == ("fails", pytest.approx(5))
    assert every.note.endswith("of photometric_stereo")
    assert (alike.verdict, alike.measured.value) == ("holds", pytest.approx(0.5 / 0.6))
    assert common.note.endswith(f"of {SEED}")


def test_efficiency_is_that_of_the_worst_scene(whole: Specimens) -> None:
    scores: dict = {}
    for dose in (50.0, None, 1000.0):
        for name in ("pollen", "fracture_rough", "grains", "pyramid", "steps", "spheres"):
            for scene in whole.of(name, dose_e=dose):
                value = 2.0 if (name, dose) == ("steps", 1000.0) else 1.2
                scores[scene.name, DENSE] = {"efficiency": value, "median_um": 0.1, "completeness": 1.0}
    lines = efficiency_lines(whole, found_of(scores))
    assert [line.verdict for line in lines[:3]] == ["holds", "holds", "fails"]
    assert lines[2].note.startswith("the worst is steps at 1000 e/px; 5 of 6 hold")
    assert [line.what for line in lines[:3]] == [f"worst scene at {dose} e/px" for dose in (50, 200, 1000)]
    assert len(lines) == 3 + 18


def test_sigma_is_held_on_both_sides(whole: Specimens) -> None:
    def lines(share: float) -> list[Line]:
        scores = {
            (scene.name, DENSE): {"within_1_sigma": share, "within_2_sigma": 0.95}
            for name in whole.names
            for scene in whole.of(name)
        }
        return [line for line in sigma_lines(whole, found_of(scores)) if not line.detail]

    assert [line.verdict for line in lines(0.68)] == ["holds", "holds"]
    assert [lines(share)[0].verdict for share in (0.5, 0.8)] == ["fails", "fails"]
    assert "mean over" in lines(0.68)[0].what


def test_a_choice_that_loses_on_one_scene_fails_there(whole: Specimens, monkeypatch: pytest.MonkeyPatch) -> None:
    twice = {"shading everywhere": {"shading": "everywhere"}, "again": {"shading": "everywhere"}}
    monkeypatch.setattr(shading, "CHOICES", twice)
    alone, choice = dense(shading="off").name, dense(shading="everywhere").name
    scores: dict = {}
    for name in whole.names:
        for scene in whole.of(name):
            scores[scene.name, alone] = {"median_um": 1.0, "completeness": 0.9}
            scores[scene.name, choice] = {"median_um": 1.3 if name == "wires" else 0.8, "completeness": 0.9}
    lines = shading.shading_lines(whole, found_of(scores))
    assert lines[0].verdict == "fails"
    assert lines[0].note.startswith("the worst is shading everywhere, wires")
    assert (lines[1].verdict, lines[1].note) == ("fails", "is the same as shading everywhere, worst scene")
    assert sum(line.holds for line in lines if line.detail) == len(lines) - 3


def test_a_scene_that_nobody_answers_is_no_loss_and_the_same_choice_is_none(
    whole: Specimens, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        shading, "CHOICES", {"shading everywhere": {"shading": "everywhere"}, "alone": {"shading": "off"}}
    )
    alone, choice = dense(shading="off").name, dense(shading="everywhere").name
    scores: dict = {}
    for name in whole.names:
        for scene in whole.of(name):
            for who in (alone, choice):
                score = {"median_um": 1.0, "completeness": 0.9}
                scores[scene.name, who] = "there is nothing to see" if name == "wires" else score
    worst, same = [line for line in shading.shading_lines(whole, found_of(scores)) if not line.detail]
    assert [line.verdict for line in (worst, same)] == ["holds", "holds"]
    assert same.note == "is the same"
    scores |= {(scene.name, alone): {"median_um": 1.0, "completeness": 0.9} for scene in whole.of("wires")}
    failed = shading.shading_lines(whole, found_of(scores))[0]
    assert (failed.verdict, failed.measured.value) == ("fails, no interval", INF)
    assert "there is nothing to see" in failed.note


def test_an_option_that_is_gone_is_a_sentence(whole: Specimens, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shading, "CHOICES", {"magic": {"magic": "true"}})
    (line,) = shading.shading_lines(whole, Found({}))
    assert line.verdict == "not measured"
    assert "no option 'magic'" in line.note
    assert {who.name for _, who in shading.shading_questions(whole)} == {dense(shading="off").name}


def test_all_bars_ask_what_can_be_answered_and_each_case_once(whole: Specimens) -> None:
    questions = [each for bar in all_bars(quick=False) for each in bar.questions(whole)]
    plan = plan_of(questions, LIMITS)
    keys = [case.key for case in plan.cases]
    assert len(set(keys)) == len(keys) < len(questions)
    assert {(case.scene.name, case.method.name) for case in plan.cases} == {(s.name, m.name) for s, m in questions}
    assert all(set(m.needs) <= set(scene.offers) for scene, m in questions if m.name.startswith((DENSE, SEED)))
    assert min(scene.source.scene.specimen_seed for scene, _ in questions) == FIRST_SEED["reporting"]


# time and memory, real pictures


def test_a_call_is_timed_and_a_refusal_is_a_sentence(grain: Specimens) -> None:
    series = grain.of("pollen")[0].series(0)
    plain = replace(series, views=tuple(replace(view, channels={}) for view in series.views))
    ready: list[int] = []
    found = size.called((Troubled("slow"), plain), lambda: ready.append(1))
    assert isinstance(found, dict)
    assert 0.5 <= found["seconds"] < 60
    assert 0 < found["peak_gib"] < 64
    assert ready == [1]
    assert size.called((Troubled("refuses"), plain), lambda: None) == "there is nothing to see"


def test_sizes_are_held_against_what_is_asked(whole: Specimens) -> None:
    rows = {}
    for each, seconds, gib in zip(size.SIZES, (40.0, 200.0), (1.0, 9.0), strict=True):
        for which in range(each.specimens):
            name = size.series_scene(each, which, whole, False).name
            numbers = {"seconds": seconds + which, "peak_gib": gib, "threads": 2.0, "load": 0.1}
            rows["size", name, DENSE] = Row("", "size", name, DENSE, which, numbers)
    lines = size.size_lines(whole, Found({}, rows=rows), quick=False)
    assert [line.what for line in lines][::2] == ["854 x 640 px, 4 views: s", "2560 x 1920 px, 3 views: s"]
    assert [line.verdict for line in lines] == ["fails", "", "holds, no interval", "fails, no interval"]
    assert "2 threads, 0.1 at work when it began" in lines[0].note
    job = size.size_jobs(replace(whole, meshes=1), quick=True)[0]
    assert job.arguments[0].microscope.width_px == 214


def test_of_small_pictures_no_time_is_asked(whole: Specimens) -> None:
    few = replace(whole, meshes=1)
    names = [size.series_scene(each, 0, few, True).name for each in size.SIZES]
    numbers = {"seconds": 1.0, "peak_gib": 1.0, "threads": 1.0, "load": 1.0}
    rows = {("size", name, DENSE): Row("", "size", name, DENSE, 0, numbers) for name in names}
    assert {line.verdict for line in size.size_lines(few, Found({}, rows=rows), quick=True)} == {""}


def test_places_are_paired_if_each_is_the_other_s_nearest() -> None:
    first = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    second = np.array([[20.4, 0.0], [0.5, 0.0], [0.2, 0.0], [11.5, 0.0]])
    one, other = real.mutual_nearest(first, second, 1.0)
    assert (one.tolist(), other.tolist()) == ([0, 2], [2, 0])


def reconstruction(z_um: np.ndarray, points: PointCloud | None = None) -> Reconstruction:
    """A height map as if it had been reconstructed from two views."""
    image = np.zeros(z_um.shape, dtype=np.uint8)
    optics = Optics(0.5, z_um.shape[1], z_um.shape[0])
    series = TiltSeries((View(image, 0.0, "a"), View(image, 5.0, "b")), optics, 0.0)
    heights = HeightMap(z_um, np.full(z_um.shape, 0.1), 0.5)
    poses = nominal_poses(series)
    if points is None:
        points = points_from_heights(heights, series, poses.rotations[0], poses.translations_um[0])
    estimate = Estimate(points=points, heights=heights, poses=poses)
    return Reconstruction(series, "m", {}, estimate, *complete(estimate, series))


def test_halves_disagree_by_the_noise_of_both() -> None:
    rows, columns = np.indices((80, 100))
    rng = np.random.default_rng(4)
    form = 3 * np.sin(columns / 9) + 2 * np.cos(rows / 7)
    one, other = (reconstruction(form + rng.normal(0, 0.2, form.shape)) for _ in range(2))
    found = real.disagreement(one, other)
    assert found["map_um"] == pytest.approx(0.6745 * np.sqrt(2) * 0.2, rel=0.05)
    assert found["points_um"] == pytest.approx(found["map_um"], rel=0.05)
    assert found["at_points_um"] == pytest.approx(found["map_um"], rel=0.01)
    assert found["pairs"] > 0.9 * form.size


def test_sparse_halves_are_judged_where_they_have_points() -> None:
    """Every point is right; what lies between the points of either half is wrong by up to 2 um."""
    rows, columns = np.indices((80, 100))
    form = 2.0 * np.cos(columns * np.pi / 4)
    whole = reconstruction(form)
    halves = []
    for first in (0, 4):
        kept = (columns % 8 == first) & (rows % 4 == 0)
        points = whole.estimate.points.keep(kept.ravel())
        estimate = Estimate(points=points, poses=whole.estimate.poses)
        halves.append(Reconstruction(whole.series, "m", {}, estimate, *complete(estimate, whole.series)))
    crests, troughs = halves
    apart = real.compare(real.surface_of(crests), real.surface_of(troughs), gauge="offset")
    own = real.map_differences_um(crests, apart)
    assert np.isfinite(own).sum() > 100
    assert np.nanmax(np.abs(own - np.nanmedian(own))) < 1e-6  # even surfaces: what is left is the offset
    assert len(real.point_differences_um(crests, troughs, apart)) == 0  # no point of one half lies on one of the other
    same = real.compare(real.surface_of(crests), real.surface_of(crests), gauge="offset")
    assert np.abs(real.point_differences_um(crests, crests, same)).max() < 1e-9


def test_a_series_is_parted_and_cut() -> None:
    views = tuple(View(np.full((20, 30), k, np.uint8), float(k), str(k)) for k in range(5))
    series = TiltSeries(views, Optics(1.0, 30, 20), 0.0)
    even, odd = real.halves(series)
    assert ([view.name for view in even.views], [view.name for view in odd.views]) == (["0", "2", "4"], ["1", "3"])
    assert real.middle(series, 0.5).optics.shape == real.middle(series, 0.5).views[0].image.shape == (10, 15)


def test_without_real_pictures_that_bar_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SEM_REAL_DATA", raising=False)
    (line,) = real.real_lines(Found({}))
    assert (line.verdict, line.note) == ("not measured", "SEM_REAL_DATA names no folder with potamogeton")
    assert real.real_jobs(quick=True) == left_out.left_out_jobs(quick=True) == left_out.left_out_lines(Found({})) == []


def test_a_picture_left_out_is_held_against_who_comes_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(left_out, "real_files", lambda: (Path("a.tif"),))
    rows = {}
    for view in left_out.LEFT_OUT:
        for k, name in enumerate(left_out.RIVALS):
            ours = {"ncc_dense": 0.9, "local_ncc_dense": 0.6, "rms_grey_dense": 8.0, "median_grey_dense": 4.0}
            theirs = {"ncc": 0.8 - 0.1 * k, "local_ncc": 0.65 - 0.1 * k, "rms_grey": 9.0 + k, "median_grey": 5.0}
            where = left_out.scene_name(view)
            rows["real", where, name] = Row("", "real", where, name, view, ours | theirs)
    lines = left_out.left_out_lines(Found({}, rows=rows))
    assert [line.verdict.partition(",")[0] for line in lines] == ["holds", "fails", "holds", "holds"]
    assert [line.measured.value for line in lines] == pytest.approx([0.1, -0.05, 8 / 9, 0.8])
    assert "of known_rotation" in lines[1].note


def test_halves_that_failed_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(real, "real_files", lambda: (Path("a.tif"),))
    rows = {("real", real.SERIES, name): Row("", "real", real.SERIES, name, 0, {}, "blank") for name in (DENSE, SEED)}
    (line,) = real.real_lines(Found({}, rows=rows))
    assert (line.verdict, line.note) == ("not measured", f"{DENSE}: blank; {SEED}: blank")


# the recipe and the command


def toy_lines(specimens: Specimens, found: Found) -> list[Line]:
    scenes = specimens.of("pollen")
    values = found.numbers(scenes, "level", "median_um")
    said = [each for who in ("level", "refuses") for each in found.failures(scenes, who)]
    return [Line("toy", "a level", Asked(most=0.01), mean_over_specimens([values]), "; ".join(said))]


def toy_questions(specimens: Specimens) -> list:
    return [(scene, Troubled(way, way)) for scene in specimens.of("pollen") for way in ("level", "refuses")]


TOY = Bar("toy", "A level is no grain.", toy_lines, toy_questions)


def test_bars_are_measured_once_and_a_failure_is_told(
    grain: Specimens, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Study((TOY,), grain, LIMITS)
    stages: set[str] = set()
    with ThreadPoolExecutor(1) as executor:
        (line,) = run_bars(plan, tmp_path, executor, lambda stage, *_: stages.add(stage))
        executor.submit(close_cell).result()
        assert (line.verdict, line.note) == (
            "fails, no interval",
            "refuses on pollen, specimen 8001: there is nothing to see",
        )
        monkeypatch.setattr("benchmarks.running.bench.run_case", None)
        assert run_bars(plan, tmp_path, executor, lambda *_: None) == [line]
    assert BenchLedger(tmp_path / LEDGER).count() == 2
    assert "cases" in stages


def test_the_command_writes_tables_and_goes_on(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.suite.suite", lambda *_args, **_more: (small("pollen", cache),))
    monkeypatch.setattr(catalogue, "all_bars", lambda **_: (TOY,))
    out = tmp_path / "out"
    with ThreadPoolExecutor(1) as executor:  # one thread and its cell instead of processes, which start slowly
        monkeypatch.setattr("benchmarks.commands.bars.workers_at", lambda *_: nullcontext(executor))
        for meshes, cases in ((1, 2), (2, 4)):
            result = CliRunner().invoke(app, ["bars", "--out", str(out), "--meshes", str(meshes)])
            assert result.exit_code == 0, result.output
            assert BenchLedger(out / LEDGER).count() == cases
        executor.submit(close_cell).result()
    page = (out / "bars.md").read_text()
    assert "specimens 8001 to 8002" in page
    assert "| toy | a level | at most 0.01 |" in page
    with (out / "bars.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["verdict"], row["bar"]) == ("fails", "toy")
    assert float(row["low"]) < float(row["value"]) < float(row["high"])
    assert (out / study.MANIFEST).is_file()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--only", "adjacent,moon"], "--only names no bar 'moon'; there are adjacent, widest, "),
        (["--out", "{full}"], "holds something else than a run"),
        (["--out", "{full}/file.txt"], "is a file"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_2(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "file.txt").write_text("mine")
    filled = ["--out", str(tmp_path / "new"), *(each.format(full=full) for each in arguments)]
    result = CliRunner().invoke(app, ["bars", *filled])
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()
