"""Claims on paired comparison: intervals hold what they say, no claim without them, failures count for nobody."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.judging.paired import LEAST, Line, lines, mean_interval
from benchmarks.reporting.paired_sides import Paired
from benchmarks.reporting.paired_tables import markdown, notes, rows, sentences, verdict
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import Answer, Case, Outcome
from benchmarks.running.cell import Limits
from benchmarks.running.manifest import CaseRecord, Manifest, MethodRecord, SceneRecord, write_manifest
from benchmarks.suite import suite
from semrecon.data import Array
from semrecon.methods import all_methods

SCENES = 8
METHODS = {method.name: method for method in all_methods()}


def results(method: str, values: Array, scenes: int = 1, metric: str = "median_um") -> list[Result]:
    """Scores (scenes x repetitions,) of a method, scene by scene; a NaN is a failure."""
    answer = []
    for i, value in enumerate(values):
        scene, repetition = divmod(i, len(values) // scenes)
        kind = "refused" if math.isnan(value) else ""
        numbers = {} if kind else {metric: float(value)}
        answer.append(
            Result(f"{method}{i}", f"s{scene}", method, repetition, kind, kind and "will not", metrics=numbers)
        )
    return answer


def line(first: Array, second: Array, scenes: int = 1, metric: str = "median_um") -> Line:
    """The line over all."""
    return lines(results("a", first, scenes, metric), results("b", second, scenes, metric), [metric])[0]


def shown(one: Line) -> str:
    """Its verdict."""
    return verdict(one, Paired("a", "b", "", (one.metric,), (one,), ()))


@pytest.mark.parametrize("count", [LEAST, 12])
def test_the_interval_holds_the_truth_as_often_as_it_says(count: int) -> None:
    rng = np.random.default_rng(11)
    held = np.mean([abs(mean_interval(rng.normal(size=count)).side(0.0)) == 0 for _ in range(800)])
    assert 0.915 < held < 0.975  # 0.95 +- 3 standard deviations of 800 trials, and the 0.015 that six values cost


@given(st.lists(st.floats(-100, 100), min_size=LEAST, max_size=15))
@settings(max_examples=50, deadline=None)
def test_turned_round_it_says_the_opposite(values: list[float]) -> None:
    there, back = mean_interval(np.array(values)), mean_interval(-np.array(values))
    assert (back.value, back.low, back.high) == (-there.value, -there.high, -there.low)


def test_fewer_pairs_than_carry_an_interval_make_no_claim() -> None:
    second = np.linspace(1.0, 2.0, LEAST)
    few, enough = line(0.5 * second[:-1], second[:-1]), line(0.5 * second, second)
    assert (few.better, few.claim) == (LEAST - 1, 0)
    assert not few.difference.known
    assert "no claim: 5 pairs, 6 needed" in shown(few)
    assert enough.claim == 1
    assert enough.ratio.value == pytest.approx(0.5)


def test_repetitions_of_few_scenes_do_not_stand_for_many_scenes() -> None:
    rng = np.random.default_rng(3)
    second = rng.uniform(1, 2, 40)
    one = line(0.5 * second, second, scenes=4)
    assert (one.scene, one.pairs, one.units, one.claim) == ("", 40, 4, 0)
    assert shown(one) == "no claim: 4 scenes, 6 needed"
    each = [of for of in lines(results("a", 0.5 * second, 4), results("b", second, 4), ["median_um"]) if of.scene]
    assert [of.claim for of in each] == [1, 1, 1, 1]


def test_pairing_takes_away_what_both_share() -> None:
    rng = np.random.default_rng(5)
    hardness = np.exp(rng.normal(0, 2, 12))
    better, worse = hardness * 0.8 * np.exp(rng.normal(0, 0.05, 12)), hardness
    assert line(better, worse).claim == 1
    assert line(better, rng.permutation(worse)).claim == 0


def test_of_equal_contenders_few_are_told_apart() -> None:
    rng = np.random.default_rng(17)
    claims = [line(*np.exp(rng.normal(size=(2, 8)))).claim for _ in range(400)]
    assert np.mean(np.abs(claims)) < 0.10
    assert {-1, 1} <= set(claims)


@pytest.mark.parametrize(
    ("metric", "claim", "said"),
    [("median_um", -1, "b better"), ("completeness", 1, "a better"), ("split_offset_um", 1, "a larger")],
)
def test_what_is_better_depends_on_the_score(metric: str, claim: int, said: str) -> None:
    second = np.linspace(0.1, 0.3, 8)
    one = line(2 * second, second, metric=metric)
    assert one.claim == claim
    assert shown(one) == said
    swapped = line(second, 2 * second, metric=metric)
    assert (swapped.claim, swapped.better, swapped.worse) == (-one.claim, one.worse, one.better)


def test_a_failure_is_in_no_pair_and_is_never_zero() -> None:
    second = np.linspace(1.0, 2.0, 8)
    first = 2 * second
    first[2] = np.nan
    one = line(first, second)
    assert (one.pairs, one.only_first, one.only_second, one.neither) == (7, 0, 1, 0)
    assert one.first == pytest.approx(np.nanmean(first))
    assert one.second == pytest.approx(np.delete(second, 2).mean())
    assert one.claim == -1
    both = line(np.full(8, np.nan), second)
    assert (both.pairs, both.only_second) == (0, 8)
    assert shown(both) == "no pair"
    assert math.isnan(both.first)


def test_infinitely_wrong_is_worse_than_any_number_and_two_of_them_are_alike() -> None:
    second = np.linspace(1.0, 2.0, 8)
    first = second.copy()
    first[0] = np.inf
    one = line(first, second, metric="penalised_median_um")
    assert (one.better, one.worse, one.claim) == (0, 1, 0)
    assert one.difference.high == np.inf
    assert line(first, first, metric="penalised_median_um").same
    all_wrong = line(np.full(8, np.inf), second, metric="penalised_median_um")
    assert (all_wrong.claim, all_wrong.worse) == (-1, 8)


def test_the_same_to_the_last_digit_is_said_as_such() -> None:
    second = np.array([1.0, 2.0])
    assert shown(line(second, second)) == "the same in every pair"
    assert line(second, second + 1e-15 * second).pairs == 2
    assert "the same" not in shown(line(second, second * (1 + 1e-12)))


def run_folder(folder: Path, values: dict[str, Array], code: str = "", **changes: object) -> Path:
    """Write the record of a run with these scores, (scenes x repetitions,), of methods; NaN is a failure."""
    every = suite(folder / "cache", quick=True)[:SCENES]
    ledger, cases = BenchLedger(folder / LEDGER), []
    for name, scores in values.items():
        for i, score in enumerate(scores):
            scene, repetition = divmod(i, len(scores) // SCENES)
            case = Case(every[scene], METHODS[name], repetition, f"{name}{i}")
            failed = math.isnan(score)
            answer = Answer(case.key, *(("refused", "sees nothing") if failed else ("", "")), 1.0, 10.0)
            numbers = {} if failed else {"median_um": float(score), "common_median_um": float(score)}
            ledger.record(Outcome(case, answer, "judge", numbers), Limits())
            cases.append(CaseRecord(case.key, every[scene].name, name, repetition))
    methods = tuple(MethodRecord(name, (), tuple(METHODS[name].gauge), options=code) for name in values)
    about = tuple(SceneRecord(each.name, each.about, "same") for each in every)
    repetitions = len(next(iter(values.values()))) // SCENES
    begun = "2026-01-01T00:00"
    manifest = Manifest(
        True, "reporting", repetitions, 1.0, 1.0, "judge", begun, code, {}, {}, methods, about, tuple(cases)
    )
    write_manifest(folder, replace(manifest, **changes))  # type: ignore[arg-type]  # names of fields, by the tests
    return folder


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three methods on eight scenes twice: disparity is a tenth worse and fails once, affine factorization alike."""
    good = np.exp(np.random.default_rng(1).normal(size=16))
    worse = 1.1 * good * np.exp(np.random.default_rng(2).normal(0, 0.02, 16))
    worse[5] = np.nan
    values = {"known_rotation": good, "disparity": worse, "affine_factorization": good}
    return run_folder(tmp_path_factory.mktemp("compare") / "run", values)


def call(*arguments: object) -> tuple[int, str]:
    """Exit status and all that was printed of the command."""
    done = CliRunner().invoke(app, ["compare", *map(str, arguments)], env={"COLUMNS": "200"})
    return done.exit_code, done.output


def test_two_methods_of_a_run(record: Path, tmp_path: Path) -> None:
    status, said = call("known_rotation", "disparity", "--run", record, "--out", tmp_path / "out")
    assert status == 0, said
    assert "known_rotation is better than disparity on the median absolute depth error over all scenes" in said
    assert (
        f"disparity has no answer in 1 case that the other side answered ({_scene_names(record)[2]}): sees nothing"
        in said
    )
    with (tmp_path / "out" / "compare.csv").open() as file:
        table = list(csv.DictReader(file))
    over_all = next(row for row in table if row["metric"] == "median_um" and not row["scene"])
    assert (over_all["pairs"], over_all["units"], over_all["only_first"]) == ("15", "8", "1")
    assert 1 / 1.15 < float(over_all["ratio_low"]) < float(over_all["ratio_high"]) < 1 / 1.05
    assert {row["scene"] for row in table if row["metric"] == "seconds"} == {"", *_scene_names(record)}
    assert "| score | pairs | known_rotation |" in (tmp_path / "out" / "compare.md").read_text()
    status, again = call("known_rotation", "disparity", "--run", record, "--out", tmp_path / "out")
    assert (status, again) == (0, said)


def _scene_names(record: Path) -> list[str]:
    return [each.name for each in suite(record / "cache", quick=True)[:SCENES]]


def test_methods_with_unlike_gauges_are_said_not_to_be_judged_alike(record: Path) -> None:
    status, said = call("known-rotation", "affine_factorization", "--run", record)
    assert status == 0
    assert "do not declare the same as unobservable" in " ".join(said.split())
    assert "have the same number, to the last digit" in " ".join(said.split())


def test_two_runs_are_before_and_after(record: Path, tmp_path: Path) -> None:
    good = np.exp(np.random.default_rng(1).normal(size=16))
    values = {"known_rotation": 0.7 * good, "affine_factorization": good}
    after = run_folder(tmp_path / "after", values, code="new", judge="other")
    BenchLedger(after / LEDGER).record_score("known_rotation0", "other", {"median_um": 1.0})
    status, said = call(record, after)
    flat = " ".join(said.split())
    assert status == 0
    assert "The judge changed between the runs" in flat
    assert "Only before has: methods disparity" in flat
    alike = run_folder(tmp_path / "alike", values, code="new")
    status, said = call(record, alike)
    flat = " ".join(said.split())
    assert "after is better than before on the median absolute depth error of known_rotation over all scenes" in flat
    assert "the same, to the last digit, in every pair of: affine_factorization" in flat
    assert "Other options, or other defaults, than before: known_rotation, affine_factorization" in flat
    status, said = call(record, alike, "--method", "affine_factorization", "--scenes", "pollen")
    assert (status, "known_rotation" in said.replace("Other options", "")) == (0, False)


def test_runs_of_other_pictures_are_refused_or_marked(record: Path, tmp_path: Path) -> None:
    values = {"known_rotation": np.ones(16)}
    status, said = call(record, run_folder(tmp_path / "full", values, quick=False))
    assert (status, "not of the same pictures" in said) == (2, True)
    changed = tuple(SceneRecord(name, "", "other") for name in _scene_names(record))
    status, said = call(record, run_folder(tmp_path / "other", values, scenes=changed))
    assert (status, "the pictures may differ" in " ".join(said.split())) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nobody", "disparity"), "'nobody' is neither a method of the run"),
        (("disparity", "disparity"), "both sides are disparity"),
        (("known_rotation", "disparity", "--metric", "beauty"), "names no score 'beauty'"),
        (("known_rotation", "disparity", "--scenes", "moon"), "names 'moon'"),
        (("known_rotation", "disparity", "--method", "x"), "--method is for two runs"),
        (("{run}", "disparity"), "disparity is not the folder of a run"),
        (("{run}", "{run}"), "name the folders of two runs"),
        (("known_rotation", "disparity", "--out", "{run}"), "holds something else"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(record: Path, arguments: tuple[str, ...], sentence: str) -> None:
    status, said = call(*(each.format(run=record) for each in arguments), "--run", record)
    assert status == 2
    assert sentence in said
    assert said.count("\n") == 1


def test_tables_have_a_cell_for_every_heading() -> None:
    second = np.linspace(1.0, 2.0, 12)
    found = lines(results("a", 0.5 * second, 6), results("b", second, 6), ["median_um"])
    paired = Paired("a", "b", "About.", ("median_um",), tuple(found), ("A note.",))
    table = rows(paired, found)
    assert {len(row) for row in table} == {len(table[0])}
    assert sentences(paired) == [
        "a is better than b on the median absolute depth error over all scenes: a has 0.5 [0.5, 0.5] times the number "
        "of b; it has the better number in 12 of 12 pairs on 6 scenes."
    ]
    assert notes(paired)[-1] == "A note."
    assert "## Scene by scene" in markdown(paired)
