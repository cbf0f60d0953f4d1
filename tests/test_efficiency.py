"""Efficiency is 1 at the limit, 2 at twice the limit, over the pixels answered; where there is no limit, a reason."""

from __future__ import annotations

import csv
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.judging.efficiency import NO_PARALLAX, ONE_VIEW, SceneLimit, scene_limit
from benchmarks.judging.limits import bound_summary
from benchmarks.reporting.leaderboard import entries, limit_notes, markdown, write_table_csv
from benchmarks.running import bounds
from benchmarks.running.bench import LEDGER, Plan
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.bounds import add_bounds, reasons
from benchmarks.running.case import Answer, Outcome, judge_version, score
from benchmarks.running.cell import Limits
from benchmarks.running.export import columns
from benchmarks.running.stored import packed
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from semrecon.data import Estimate, HeightMap
from semrecon.methods.base import Gauge
from semsim.capture import prepare
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from

LIMITS = Limits(5.0, 1.0)
STILL = TiltSchedule((0.0, 0.0), shifts_um=((0.0, 0.0), (3.0, 0.0)))


@dataclass(frozen=True)
class Known:
    """An estimator whose errors are normal, `times` the limit, at all pixels or at the easiest share of them."""

    name: str
    times: float
    easiest: float = 1.0
    needs: tuple[str, ...] = ("pixel_size",)
    gauge: tuple[Gauge, ...] = ("offset",)
    views: tuple[int, int | None] = (1, None)


METHODS = (
    Known("at_limit", 1.0),
    Known("twice", 2.0),
    Known("easy_fifth", 1.0, 0.2),
    Known("truth", 0.0),
    Known("oracle_like", 0.5),
)


def photographed(schedule: TiltSchedule, cache: Path, working_distance_um: float | None = None) -> BenchScene:
    grain = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    microscope = Microscope(0.6, 160, 120, working_distance_um=working_distance_um)
    source = SimulatedSource(Scene("grain-reporting", grain, microscope, schedule), cache)
    return BenchScene("grain", "A grain.", source, ("pixel_size",))


def answers(plan: Plan, ledger: BenchLedger) -> None:
    """Record what the estimators answer; where there is no limit, an error of 1 um at every pixel."""
    for case in plan.cases:
        source, method = case.scene.source, case.method
        limit = scene_limit(source.surfaces())
        true = source.truth().height_map(source.scene.schedule.reference)
        sigma_um = np.ones(true.shape) if limit.reason else np.nan_to_num(limit.sigma_um, nan=1.0)
        rng = np.random.default_rng(case.scene.seed(case.repetition))
        z_um = true + 7.0 + method.times * sigma_um * rng.normal(size=true.shape)
        z_um[sigma_um > np.quantile(sigma_um, method.easiest)] = np.nan
        answer = Answer(
            case.key, seconds=1.0, peak_mib=1.0, estimate=packed(Estimate(heights=HeightMap(z_um, z_um, 0.6)))
        )
        ledger.record(Outcome(case, answer, judge_version(), score(case, answer)), LIMITS)


def bounded(plan: Plan, ledger: BenchLedger) -> dict[str, Result]:
    with ThreadPoolExecutor(1) as executor:
        return {each.method: each for each in add_bounds(plan, ledger, executor, lambda *_: None)}


Run = tuple[Plan, BenchLedger, dict[str, Result]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("run")
    plan = Plan((photographed(TiltSchedule((0.0, 5.0, 10.0)), folder),), METHODS, 1, LIMITS)
    ledger = BenchLedger(folder / LEDGER)
    answers(plan, ledger)
    return plan, ledger, bounded(plan, ledger)


@pytest.mark.parametrize(("method", "wanted"), [("at_limit", 1.0), ("twice", 2.0), ("oracle_like", 0.5)])
def test_errors_of_so_many_times_the_limit_have_that_efficiency(run: Run, method: str, wanted: float) -> None:
    assert run[2][method].metrics["efficiency"] == pytest.approx(wanted, rel=0.04)


def test_the_truth_is_at_zero(run: Run) -> None:
    metrics = run[2]["truth"].metrics
    assert metrics["median_um"] < 1e-5  # as float32 has it
    assert metrics["efficiency"] < 1e-4


def test_who_answers_where_it_is_easy_is_held_against_what_is_easy(run: Run) -> None:
    easy, whole = run[2]["easy_fifth"].metrics, run[2]["at_limit"].metrics
    assert easy["completeness"] < 0.3
    assert easy["median_um"] < 0.8 * whole["median_um"]  # so the claim below can fail
    assert easy["efficiency"] == pytest.approx(1.0, rel=0.05)


def test_over_all_pixels_it_is_the_limit_that_sweeps_draw(run: Run) -> None:
    plan, ledger, rows = run
    source = plan.scenes[0].source
    summary = bound_summary(source.surfaces())
    limit = ledger.limit(plan.scenes[0].identity)
    assert limit is not None
    judged = source.judgeable((0, 1, 2), 1)
    assert np.array_equal(np.isfinite(limit.sigma_um), judged)  # errors and limit are over the same pixels
    assert limit.median_abs_um == pytest.approx(summary.median_abs_um, rel=1e-5)
    assert rows["at_limit"].metrics["bound_um"] == pytest.approx(summary.median_abs_um, rel=1e-5)
    assert rows["twice"].metrics["efficiency"] == pytest.approx(
        summary.efficiency(rows["twice"].metrics["median_um"]), rel=1e-5
    )


def test_the_median_is_where_half_of_the_surface_is() -> None:
    limit = SceneLimit(np.array([[0.1, 1.0, np.nan], [3.0, 0.4, np.nan]]), 3.0)
    assert limit.shares_within(np.array([0.0, limit.median_abs_um, 1e3])) == pytest.approx([0, 0.5, 1])
    assert limit.over(np.array([[True, False, True], [False] * 3])) == pytest.approx(0.067449, rel=1e-4)
    assert np.isnan(limit.over(np.array([[False, False, True], [False] * 3])))
    with pytest.raises(ValueError, match="cannot be laid over"):
        limit.over(np.ones((2, 2), dtype=bool))


def test_what_is_on_record_is_not_worked_out_again(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, ledger, rows = run

    def forbidden(*_: object) -> None:
        raise AssertionError("was worked out again")

    for name in ("_limited", "_bounded"):
        monkeypatch.setattr(bounds, name, forbidden)
    assert {name: row.metrics for name, row in bounded(plan, ledger).items()} == {
        name: row.metrics for name, row in rows.items()
    }
    monkeypatch.setattr(bounds, "limits_version", lambda: "another")
    with pytest.raises(AssertionError, match="worked out again"):
        bounded(plan, ledger)


def test_tables_have_it(run: Run, tmp_path: Path) -> None:
    _, _, rows = run
    every = entries(list(rows.values()), METHODS)
    text = markdown(every, {}, limit_notes({}))
    assert "## Efficiency: that error over the physical limit" in text
    assert "Gaussian window of 3 px" in text
    write_table_csv(tmp_path / "table.csv", every)
    with (tmp_path / "table.csv").open(newline="") as file:
        found = {row["method"]: float(row["efficiency"]) for row in csv.DictReader(file)}
    assert found["twice"] == pytest.approx(rows["twice"].metrics["efficiency"])
    table = columns(list(rows.values()))
    assert table["efficiency"] == [row.metrics["efficiency"] for row in rows.values()]
    assert "bound_um" in table


@pytest.mark.parametrize(
    ("schedule", "reason"), [(STILL, NO_PARALLAX), (TiltSchedule((0.0,)), ONE_VIEW)], ids=["shift", "one view"]
)
def test_without_a_limit_there_is_a_dash_and_a_reason(schedule: TiltSchedule, reason: str, tmp_path: Path) -> None:
    plan = Plan((photographed(schedule, tmp_path),), METHODS[:1], 1, LIMITS)
    ledger = BenchLedger(tmp_path / LEDGER)
    answers(plan, ledger)
    row = bounded(plan, ledger)["at_limit"]
    assert row.metrics["median_um"] == pytest.approx(0.674, rel=0.05)
    assert np.isnan(row.metrics["efficiency"])
    assert np.isnan(row.metrics["bound_um"])
    found = reasons([("grain", plan.scenes[0].identity)], ledger)
    assert found == {"grain": reason}
    assert limit_notes(found)[-1] == f"There is no efficiency on grain: {reason}."
    efficiencies = markdown(entries([row], METHODS), {}, []).partition("## Efficiency")[2].partition("##")[0]
    assert "| at_limit | pixel_size | - |" in efficiencies


def test_a_shift_under_perspective_has_a_limit(tmp_path: Path) -> None:
    near = photographed(STILL, tmp_path, working_distance_um=500.0)
    assert 0 < scene_limit(near.source.surfaces()).median_abs_um < 1e3
    parallel = replace(near.source.scene, microscope=replace(near.source.scene.microscope, working_distance_um=None))
    assert scene_limit(prepare(parallel)).reason == NO_PARALLAX


def test_a_record_without_limits_says_so(run: Run) -> None:
    _, ledger, _ = run
    assert "repeat the command" in reasons([("moon", "unknown")], ledger)["moon"]
