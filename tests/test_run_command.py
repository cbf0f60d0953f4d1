"""`python -m benchmarks run`: every case is a row, nothing is lost or done twice, and tables say what happened."""

from __future__ import annotations

import csv
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.reporting.leaderboard import entries, markdown, notes, side_by_side
from benchmarks.running import bench
from benchmarks.running.bench import LEDGER, Plan, alone, contenders, measure
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.case import run_case
from benchmarks.running.cell import Limits
from benchmarks.running.export import write_csv, write_parquet
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from semrecon.errors import InputError
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests.troubled_methods import Troubled

ROOT = Path(__file__).resolve().parent.parent
LIMITS = Limits(20.0, 0.75)
KILLS = [int(number) for number in os.environ.get("SEM_KILLS", "3").split(",")]
"""How often a run is killed in the test of that; SEM_KILLS=50 takes minutes."""
WAYS = ("level", "refuses", "hangs", "eats", "crashes", "breaks", "empty")


def small_scene(cache: Path) -> BenchScene:
    """A pollen grain of coarse mesh on a small field: a second to prepare."""
    grain = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    scene = Scene("grain-reporting", grain, Microscope(0.6, 160, 120), TiltSchedule((0.0, 5.0)))
    return BenchScene("grain", "A grain.", SimulatedSource(scene, cache), ("pixel_size", "rotations", "tilt_axis"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> BenchScene:
    return small_scene(tmp_path_factory.mktemp("cache"))


def quiet(_stage: str, _steps: int, _total: int) -> None:
    pass


def measured(plan: Plan, ledger: BenchLedger):
    with ThreadPoolExecutor(1) as executor:
        return measure(plan, ledger, executor, quiet)


@pytest.fixture(scope="module")
def troubled(scene: BenchScene, tmp_path_factory: pytest.TempPathFactory):
    """All ways for a method to end, in one run; the small crop of the warm-up is refused by most."""
    methods = tuple(Troubled(way, f"troubled_{way}") for way in WAYS)
    ledger = BenchLedger(tmp_path_factory.mktemp("run") / LEDGER)
    plan = Plan((scene,), methods, 1, LIMITS)
    return plan, ledger, {each.method.removeprefix("troubled_"): each for each in measured(plan, ledger)}


def test_every_way_to_end_is_a_row_with_a_sentence(troubled) -> None:
    _, _, rows = troubled
    assert {way: rows[way].kind for way in WAYS} == {
        "level": "",
        "refuses": "refused",
        "hangs": "timeout",
        "eats": "memory",
        "crashes": "crash",
        "breaks": "bug",
        "empty": "refused",
    }
    assert rows["refuses"].failure == "there is nothing to see"
    assert rows["hangs"].failure == "took longer than 20 s and was ended"
    assert rows["eats"].failure == "needed more than 0.75 GiB of memory and was ended"
    assert rows["breaks"].failure == "broke off: ZeroDivisionError: a bug"
    assert all("\n" not in row.failure for row in rows.values())
    assert all(not rows[way].metrics for way in WAYS[1:])


def test_an_answer_has_scores_time_and_memory(troubled) -> None:
    row = troubled[2]["level"]
    assert row.metrics["completeness"] == 1.0
    assert row.metrics["median_um"] > 1
    assert 0 < row.seconds < np.inf
    assert 0 <= row.peak_mib < np.inf


def test_what_is_on_record_is_neither_run_nor_judged_again(troubled, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, ledger, rows = troubled

    def forbidden(*_: object) -> None:
        raise AssertionError("was run again")

    for name in ("run_case", "_rescored", "_prepared"):
        monkeypatch.setattr(bench, name, forbidden)
    again = measured(plan, ledger)
    assert {row.key: row for row in again}.keys() == {row.key for row in rows.values()}
    assert ledger.count() == len(WAYS)


def test_another_judge_judges_anew_without_the_methods(troubled, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, ledger, rows = troubled
    monkeypatch.setattr(bench, "run_case", None)
    monkeypatch.setattr(bench, "judge_version", lambda: "another")
    again = {row.method: row for row in measured(plan, ledger)}
    assert again["troubled_level"].metrics == rows["level"].metrics
    assert ledger.judged(rows["level"].key, "another")


def test_more_time_is_another_chance(troubled) -> None:
    _, ledger, rows = troubled
    assert ledger.settled(rows["hangs"].key, LIMITS)
    assert not ledger.settled(rows["hangs"].key, Limits(21.0, 0.75))
    assert ledger.settled(rows["eats"].key, Limits(21.0, 0.75))
    assert not ledger.settled(rows["eats"].key, Limits(20.0, 4.0))
    assert ledger.settled(rows["level"].key, Limits(99.0, 99.0))


def test_the_same_case_gives_the_same_answer(scene: BenchScene) -> None:
    (case,) = Plan((scene,), (Troubled(),), 1, LIMITS).cases
    one, other = run_case(case, LIMITS), run_case(case, LIMITS)
    assert one.answer.estimate == other.answer.estimate
    assert one.metrics == other.metrics


def test_a_second_run_on_one_folder_is_refused(tmp_path: Path) -> None:
    with (
        alone(tmp_path),
        pytest.raises(InputError, match=f"process {os.getpid()} is running the bench"),
        alone(tmp_path),
    ):
        pass
    with alone(tmp_path):
        pass


def test_tables_say_what_happened(troubled, tmp_path: Path) -> None:
    plan, _, rows = troubled
    results = list(rows.values())
    every = entries(results, plan.methods)
    assert every[0].method == "troubled_level"
    text = markdown(every, {"grain": "A grain."}, notes(results, marked=False))
    assert "7 cases, of which 6 have no answer" in text
    assert "broke off: ZeroDivisionError: a bug" in text
    assert "| troubled_hangs | pixel_size | - |" in text
    write_csv(tmp_path / "results.csv", results)
    with (tmp_path / "results.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [each["kind"] for each in read] == [each.kind for each in results]
    assert float(read[0]["median_um"]) == results[0].metrics["median_um"]


def test_parquet_holds_what_the_csv_holds(troubled, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    results = list(troubled[2].values())
    write_parquet(tmp_path / "results.parquet", results)
    table = parquet.read_table(tmp_path / "results.parquet").to_pydict()
    assert table["failure"] == [each.failure for each in results]
    assert table["median_um"][0] == results[0].metrics["median_um"]
    assert np.isnan(table["median_um"][1])


def test_a_mean_does_not_leave_out_what_has_no_number(troubled) -> None:
    row = troubled[2]["level"]
    from dataclasses import replace

    hollow = replace(row, repetition=1, metrics={**row.metrics, "median_um": float("nan")})
    (entry,) = entries([row, hollow], [Troubled(name="troubled_level")])
    assert np.isnan(entry.values["median_um"])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--methods", "magic"], "no method 'magic'; there are "),
        (["--scenes", "moon"], "no scene 'moon'; there are pollen"),
        (["--out", "{full}"], "holds something else than a run"),
        (["--out", "{full}/file.txt"], "is a file"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_2(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "file.txt").write_text("mine")
    filled = ["--out", str(tmp_path / "new"), *(each.format(full=full) for each in arguments)]
    result = CliRunner().invoke(app, ["run", *filled])
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_the_command_runs_goes_on_and_writes_tables(
    scene: BenchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import benchmarks.suite

    monkeypatch.setattr(benchmarks.suite, "suite", lambda *_args, **_more: (scene,))
    arguments = ["run", "--methods", "shape-from-shading,disparity", "--out", str(tmp_path / "out"), "--workers", "1"]
    first = CliRunner().invoke(app, [*arguments, "--seeds", "1"])
    assert first.exit_code == 0, first.output
    for name in ("leaderboard.md", "leaderboard.csv", "results.csv", LEDGER):
        assert (tmp_path / "out" / name).stat().st_size > 0, name
    assert BenchLedger(tmp_path / "out" / LEDGER).count() == 2
    assert CliRunner().invoke(app, [*arguments, "--seeds", "2"]).exit_code == 0
    assert BenchLedger(tmp_path / "out" / LEDGER).count() == 4


def test_contenders_are_found_by_either_spelling() -> None:
    assert [each.name for each in contenders(["known-rotation", "disparity"])] == ["known_rotation", "disparity"]
    assert len(contenders([])) >= 3


KILLED = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from benchmarks.running import bench
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.case import Answer, Outcome
from tests.test_run_command import small_scene
from tests.troubled_methods import Troubled

folder = Path(sys.argv[1])

def run(case, limits):
    with (folder / "log").open("a") as file:
        file.write(case.key + "\\n")
    time.sleep(0.002)
    return Outcome(case, Answer(case.key, estimate=case.key.encode() * 500), "judge", {"median_um": 1.0})

bench.run_case, bench._prepared, bench.judge_version = run, lambda scene: None, lambda: "judge"
plan = bench.Plan((small_scene(folder / "cache"),), (Troubled(),), 150)
print("ready", flush=True)
with bench.alone(folder), ThreadPoolExecutor(2) as executor:
    bench.measure(plan, BenchLedger(folder / bench.LEDGER), executor, lambda *_: None)
"""


def killed_run(folder: Path, after_s: float | None) -> int:
    """Run the plan above and kill it so long after it began; return its status."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", KILLED, str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == b"ready"
    if after_s is not None:
        time.sleep(after_s)
        os.kill(process.pid, signal.SIGKILL)
    status = process.wait()
    process.stdout.close()
    return status


@pytest.mark.parametrize("kills", KILLS)
def test_killed_at_any_moment_nothing_is_lost_and_nothing_is_there_twice(kills: int, tmp_path: Path) -> None:
    chance, ledger, deaths, before = random.Random(kills), tmp_path / LEDGER, 0, 0
    for _ in range(kills):
        deaths += killed_run(tmp_path, chance.uniform(0.0, 0.25 if kills < 10 else 0.05)) == -signal.SIGKILL
        now = BenchLedger(ledger).count() if ledger.exists() else 0
        assert now >= before  # nothing that was recorded is lost
        before = now
    assert deaths > 0
    assert killed_run(tmp_path, None) == 0
    calls = (tmp_path / "log").read_text().split()
    assert BenchLedger(ledger).count() == len(set(calls)) == 150
    assert len(calls) <= 150 + (2 + 16) * deaths  # only what was under way or handed over is done again
    assert killed_run(tmp_path, None) == 0
    assert len((tmp_path / "log").read_text().split()) == len(calls)


@pytest.mark.parametrize("width", [30, 60, 80, 500])
def test_a_narrow_terminal_gets_several_tables_that_hold_all_cells(width: int) -> None:
    scenes = [f"scene_{i}" for i in range(9)]
    rows = [["method", "needs", *scenes], ["dense_multiview", "rotations, pixel_size", *map(str, range(9))]]
    tables = side_by_side(rows, width)
    assert all(table[0][0] == "method" and table[1][0] == "dense_multiview" for table in tables)
    said = {column: value for head, line in tables for column, value in zip(head[1:], line[1:], strict=True)}
    assert said == dict(zip(rows[0][1:], rows[1][1:], strict=True))
    assert list(said)[-1] == "needs"
    for head, line in tables:
        letters = 1 + sum(3 + max(len(a), len(b)) for a, b in zip(head, line, strict=True))
        assert letters <= width or len(head) == 2
