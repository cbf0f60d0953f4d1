"""The planner: its model is fitted rightly, it chooses the cheapest, and what it says is what it found."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.running.bench import contenders
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.sweeping import planner
from benchmarks.sweeping.planner import (
    Candidate,
    Checked,
    Choices,
    Model,
    Planned,
    Task,
    calibration_points,
    choose,
    fit_model,
    make_plan,
    spread_tilts,
    untried,
    write_plan_csv,
)
from benchmarks.sweeping.planner_page import plan_markdown, verdict
from benchmarks.sweeping.sweep_axes import axis_named
from benchmarks.sweeping.sweep_figures import draw_plan
from benchmarks.sweeping.sweeps import Sweep, base_scene, run_sweep
from semrecon.errors import InputError, MethodError
from tests.small_grain import GRAIN, close_cell


def candidate(views: int, spread: float, dose: float, expected: float = np.nan) -> Candidate:
    """Bound by the law of two views: over the range, over the root of dose and views."""
    return Candidate(views, spread, dose, 40 / spread / np.sqrt(views * dose), 30 / spread, 0.9, expected)


def law(model: Model) -> tuple[Candidate, ...]:
    every = [candidate(v, r, d) for v in (2, 3, 5) for r in (4.0, 8.0, 16.0) for d in (25.0, 100.0, 400.0)]
    return tuple(replace(each, expected_um=model.expected_um(each)) for each in every)


def checked(each: Candidate, error: float) -> Checked:
    return Checked(each, error, 0.9 * error, 1.1 * error, 0.95)


@pytest.mark.parametrize("model", [Model(2.0, 0.3, 0.1), Model(1.3, 0.0, 0.0), Model(0.0, 0.2, 0.4)])
def test_a_model_is_found_again_from_what_it_predicts(model: Model) -> None:
    points = [candidate(3, spread, dose) for spread in (4.0, 16.0) for dose in (25.0, 400.0)]
    found = fit_model([checked(each, model.expected_um(each)) for each in points])
    assert found.efficiency == pytest.approx(model.efficiency, abs=1e-6)
    assert found.matching_px == pytest.approx(model.matching_px, abs=1e-6)
    assert found.floor_um == pytest.approx(model.floor_um, abs=1e-6)


def test_a_method_that_never_answers_cannot_be_planned_with() -> None:
    failed = Checked(candidate(2, 4, 25), np.nan, np.nan, np.nan, 0.0, "only 3 matches")
    with pytest.raises(MethodError, match="only 3 matches"):
        fit_model([failed])


def test_the_cheapest_of_each_number_of_views_is_chosen() -> None:
    every = law(Model(2.0, 0.0, 0.05))
    chosen = choose(every, 0.3, 3)
    assert chosen[0].total_e == min(each.total_e for each in every if each.expected_um <= 0.3)
    assert all(each.expected_um <= 0.3 for each in chosen)
    assert [each.total_e for each in chosen] == sorted(each.total_e for each in chosen)
    assert len({each.views for each in chosen}) == len(chosen)


def test_where_nothing_reaches_the_target_the_best_are_tried() -> None:
    every = law(Model(2.0, 0.0, 0.5))
    chosen = choose(every, 0.1, 2)
    assert chosen[0].expected_um == min(each.expected_um for each in every)
    assert len(chosen) == 2


def test_what_no_view_shares_is_never_chosen() -> None:
    blind = Candidate(2, 120.0, 25.0, np.nan, 1.0, 0.0, np.nan)
    assert blind not in choose((blind, *law(Model(2.0, 0.0, 0.05))), 0.3, 3)


def test_tilts_are_spread_about_zero() -> None:
    assert spread_tilts(2, 8.0) == (-4.0, 4.0)
    assert spread_tilts(5, 8.0) == (-4.0, -2.0, 0.0, 2.0, 4.0)


def test_the_model_is_fitted_at_the_extremes() -> None:
    assert calibration_points(Choices((4, 8, 30), (2, 3, 5), (25, 1600))) == [
        (3, 4, 25), (3, 4, 1600), (3, 30, 25), (3, 30, 1600)
    ]  # fmt: skip


@pytest.mark.parametrize("wrong", [{"views": (1,)}, {"doses_e": (0.0,)}, {"ranges_deg": ()}, {"ranges_deg": (170.0,)}])
def test_choices_that_cannot_be_are_a_sentence(wrong: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(InputError, match="a plan needs"):
        Choices(**wrong)  # type: ignore[arg-type]


def planned(target_um: float, model: Model) -> Planned:
    every = law(model)
    tried = tuple(checked(each, each.expected_um * 1.02) for each in choose(every, target_um, 3))
    return Planned(target_um, "known_rotation", model, tried[:1], every, tried)


def test_the_verdict_names_the_cheapest_that_held_in_simulation() -> None:
    good = planned(0.3, Model(2.0, 0.0, 0.05))
    best = min(good.reached, key=lambda each: each.candidate.total_e).candidate
    assert verdict(good).startswith(f"Take {best.views} views over {best.range_deg:g} degrees at {best.dose_e:g} e")
    assert "lies above: no dose or tilt will do" in verdict(planned(0.1, Model(2.0, 0.0, 0.5)))
    lost = replace(good, checked=(Checked(best, np.nan, np.nan, np.nan, 0.0, "only 3 matches"),))
    assert verdict(lost) == "The method answers at none of the candidates: only 3 matches."


def test_a_candidate_that_the_model_promised_and_simulation_denies_is_not_recommended() -> None:
    promised = planned(0.3, Model(2.0, 0.0, 0.05))
    worse = tuple(replace(each, simulated_um=0.9) for each in promised.checked)
    assert verdict(replace(promised, checked=worse)).startswith("Nothing that was simulated reaches 0.3 um")


def test_page_table_and_map(tmp_path: Path) -> None:
    plan = planned(0.3, Model(2.0, 0.0, 0.05))
    text = plan_markdown(plan, "plane", "plan.png")
    assert "error^2 = (2 x bound)^2 + (0 x response)^2 + (0.05 um)^2" in text
    assert text.count("\n| ") == 1 + len(plan.checked)
    write_plan_csv(tmp_path / "plan.csv", plan)
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 1 + len(plan.candidates)
    draw_plan(tmp_path / "plan.png", plan, "a plan")
    assert (tmp_path / "plan.png").stat().st_size > 5000


def test_a_plan_from_end_to_end(tmp_path: Path) -> None:
    (tmp_path / "grain.toml").write_text(GRAIN)
    scene, development = (
        base_scene(str(tmp_path / "grain.toml"), tmp_path / "cache", columns=160, purpose=purpose, channels=False)
        for purpose in ("reporting", "development")
    )
    (method,) = contenders(["known_rotation"])
    task = Task(scene, development, method, 2.0, Choices((4.0, 8.0), (2,), (400.0,)), 1, 1)
    with ThreadPoolExecutor(1) as executor:
        found = make_plan(task, BenchLedger(tmp_path / "bench.sqlite"), executor, lambda *_: None)
        executor.submit(close_cell).result()
    near, far = found.candidates
    assert far.bound_um < near.bound_um
    assert far.share < near.share
    assert np.isfinite([each.simulated_um for each in (*found.fitted, *found.checked)]).all()
    assert found.checked[0].candidate in found.candidates
    assert found.checked[0].simulated_um == pytest.approx(swept_um(tmp_path, found.checked[0].candidate), rel=1e-12)


def swept_um(folder: Path, way: Candidate) -> float:
    """Measure by a sweep of one point what a plan says of a way to take the pictures."""
    text = GRAIN.replace("[0.0, 5.0]", str(list(way.tilts_deg)))
    (folder / "taken").mkdir()
    (folder / "taken" / "grain.toml").write_text(text)
    path = str(folder / "taken" / "grain.toml")
    scene = base_scene(path, folder / "cache", columns=160, purpose="reporting", channels=False)
    swept = Sweep(scene, (axis_named("dose", [way.dose_e]),), contenders(["known_rotation"]), 1)
    with ThreadPoolExecutor(1) as executor:
        found = run_sweep(swept, BenchLedger(folder / "sweep.sqlite"), executor, lambda *_: None)
        executor.submit(close_cell).result()
    return float(found.results[0][0].metrics["median_um"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--target-um", "-1"], "--target-um must be a positive number"),
        (["--target-um", "inf"], "--target-um must be a positive number"),
        (["--target-um", "1", "--views", "1", "--method", "shape_from_shading"], "a plan needs"),
        (["--target-um", "1", "--views", "2.7,3"], "--views '2.7,3' is not a list of whole numbers"),
        (["--target-um", "1", "--ranges", ","], "--ranges ',' is not a list of numbers"),
        (["--target-um", "1", "--doses", "25,nan"], "a plan needs"),
        (["--target-um", "1", "--method", "nobody"], "--method names no method 'nobody'"),
        (["--target-um", "1", "--method", "multiview_sfm", "--views", "2"], "multiview_sfm takes 3 views or more"),
        (["--target-um", "1", "--method", "oracle_matches", "--scene", "nowhere"], "neither a TOML file nor a scene"),
        (["--target-um", "1", "--scene", "nowhere"], "neither a TOML file nor a scene"),
    ],
)
def test_a_bad_command_ends_with_one_sentence(tmp_path: Path, arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["plan", *arguments, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert said in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_method_is_not_offered_fewer_views_than_it_takes() -> None:
    (method,) = contenders(["multiview_sfm"])
    assert Choices().for_method(method).views == (3, 5)
    (oracle,) = contenders(["oracle_matches"])
    assert Choices().for_method(oracle).views == (2, 3, 5)


def test_what_is_harder_in_each_respect_than_a_failure_is_not_tried() -> None:
    every = law(Model(2.0, 0.0, 0.05))
    failed = next(each for each in every if (each.views, each.range_deg, each.dose_e) == (2, 8.0, 100.0))
    left = untried(every, [Checked(failed, np.nan, np.nan, np.nan, 0.0, "only 3 matches")])
    gone = {(each.views, each.range_deg, each.dose_e) for each in set(every) - set(left)}
    assert gone == {(2, 8.0, 25.0), (2, 8.0, 100.0), (2, 16.0, 25.0), (2, 16.0, 100.0)}


def test_a_harder_specimen_than_the_one_of_the_model_is_not_given_up(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Errors are 1.5 times what the model expects: dearer candidates reach the target all the same."""
    model, target_um = Model(2.0, 0.0, 0.05), 0.3
    every, rounds = law(model), []

    def measured(_scene: object, chosen: list[Candidate], *_more: object) -> list[Checked]:
        rounds.append(chosen)
        return [checked(each, 1.5 * model.expected_um(each)) for each in chosen]

    monkeypatch.setattr(planner, "simulated", measured)
    (tmp_path / "grain.toml").write_text(GRAIN)
    scene = base_scene(str(tmp_path / "grain.toml"), tmp_path, columns=160, purpose="reporting", channels=False)
    task = Task(scene, scene, None, target_um, checks=1)
    ledger = BenchLedger(tmp_path / "bench.sqlite")
    with ThreadPoolExecutor(1) as executor:
        found = planner._tried(every, task, ledger, executor, lambda *_: None)
        assert found[-1].simulated_um <= target_um
        assert found[-1].candidate.total_e < max(each.total_e for each in every)  # not the dearest
        assert len(rounds) == 2
        rounds.clear()
        barely_um = 1.05 * min(each.expected_um for each in every)
        for out_of_reach_um, took in ((1e-3, 1), (barely_um, 2)):
            rounds.clear()
            planner._tried(every, replace(task, target_um=out_of_reach_um), ledger, executor, lambda *_: None)
            tried = [each for chosen in rounds for each in chosen]
            assert min(every, key=lambda each: each.expected_um) in tried  # a no is said of the best
            assert len(set(tried)) == len(tried) == took  # none is tried twice, nor when nothing can be hoped for
