"""Results in a folder that cannot be written are read, whole or not at all, and stay as they are."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import scenes
from benchmarks.__main__ import app
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.cell import Limits
from benchmarks.scenes import SimulatedSource
from semrecon.errors import InputError
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests.test_bench_compare import run_folder

VALUES = {name: number * np.linspace(1.0, 2.0, 8) for number, name in enumerate(("known_rotation", "disparity"), 1)}


def forbid(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Answer as the system does for a read-only mount; permissions alone do not stop who is root."""
    real = os.access

    def access(path: str | Path, mode: int) -> bool:
        return not (mode & os.W_OK and Path(path).is_relative_to(folder)) and real(path, mode)

    patch.setattr(os, "access", access)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run in a folder with a name that an address must escape."""
    folder = run_folder(tmp_path / "run #1? 50%", VALUES)
    forbid(folder, monkeypatch)
    return folder


def content(folder: Path) -> dict[str, tuple[int, int]]:
    return {each.name: (each.stat().st_size, each.stat().st_mtime_ns) for each in folder.iterdir()}


def test_a_ledger_is_read_without_a_file_beside_it(run: Path) -> None:
    before = content(run)
    ledger = BenchLedger(run / LEDGER)
    with ledger._connection() as connection:
        assert connection.execute("SELECT count(*) FROM answers").fetchone() == (16,)
        assert content(run) == before  # in WAL mode two files would stand here as long as it is open
    assert ledger.settled("disparity3", Limits())
    assert [each.metrics["median_um"] for each in ledger.results(["disparity0"], "judge")] == [2.0]
    with pytest.raises(sqlite3.OperationalError, match="readonly"):
        ledger.record_score("disparity3", "other", {})
    assert content(run) == before


def test_a_ledger_that_can_be_written_is(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", VALUES)
    ledger = BenchLedger(folder / LEDGER)
    with ledger._connection() as connection:
        connection.execute("SELECT count(*) FROM answers").fetchone()
        assert f"{LEDGER}-wal" in content(folder)


def test_what_still_stands_in_the_log_is_not_left_out_in_silence(run: Path) -> None:
    (run / f"{LEDGER}-wal").write_bytes(b"x")
    with pytest.raises(InputError, match="copy the folder to where you can write"):
        BenchLedger(run / LEDGER)


def test_an_older_or_another_ledger_is_one_sentence(run: Path) -> None:
    with sqlite3.connect(run / LEDGER) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("DROP TABLE bounds")
    connection.close()
    with pytest.raises(InputError, match="older version and lacks bounds"):
        BenchLedger(run / LEDGER)
    (run / LEDGER).write_bytes(b"no ledger, whatever the name says" * 99)
    with pytest.raises(InputError, match="is no ledger of a run"):
        BenchLedger(run / LEDGER)


def test_two_methods_are_compared_and_nothing_is_left_behind(run: Path) -> None:
    before = content(run)
    done = CliRunner().invoke(app, ["compare", "known_rotation", "disparity", "--run", str(run)])
    assert done.exit_code == 0, done.output
    assert "known_rotation is better than disparity" in " ".join(done.output.split())
    assert content(run) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["report", "--run", "{run}"],
        ["record", "--run", "{run}"],
        ["record", "--run", "{run}", "--out", "{run}"],
        ["compare", "known_rotation", "disparity", "--run", "{run}", "--out", "{run}/compared"],
        ["run", "--quick", "--out", "{run}", "--scenes", "pollen", "--methods", "disparity", "--workers", "1"],
    ],
)
def test_what_would_write_there_says_so_before_it_begins(arguments: list[str], run: Path) -> None:
    before = content(run)
    done = CliRunner().invoke(app, [each.format(run=run) for each in arguments])
    assert done.exit_code == 2, done.output
    assert "cannot be written" in done.stderr
    assert "--out" in done.stderr
    assert done.stderr.count("Error:") == 1
    assert content(run) == before


def test_a_report_goes_elsewhere(run: Path, tmp_path: Path) -> None:
    before = content(run)
    done = CliRunner().invoke(app, ["report", "--run", str(run), "--out", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "page.html").stat().st_size > 10_000
    assert content(run) == before


def test_surfaces_are_made_again_where_they_cannot_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = specimen_from({"name": "pollen", "edge_um": 2.0, "frame_width_um": 96.0, "frame_height_um": 72.0})
    scene = Scene("grain", shape, Microscope(1.2, 80, 60), TiltSchedule((0.0, 5.0)))
    kept, bare = (SimulatedSource(scene, tmp_path / name) for name in ("kept", "bare"))
    wanted = kept.truth().height_map(0)
    forbid(tmp_path, monkeypatch)
    np.testing.assert_array_equal(bare.truth().height_map(0), wanted)
    assert not bare.cache.exists()
    scenes._loaded.cache_clear()
    np.testing.assert_array_equal(kept.truth().height_map(0), wanted)  # read, not made: `prepare` may write nothing
