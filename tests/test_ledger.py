"""The ledger keeps what was measured, whole, whoever is killed or writes beside it."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from benchmarks.running.ledger import Ledger, Row
from benchmarks.running.runner import Job, completed, digest, run_jobs, seed_of


def row(key: str, repetition: int = 0, **metrics: float) -> Row:
    return Row(key, "study", "scene", "contender", repetition, metrics, "", {"cloud": np.arange(6.0).reshape(2, 3)})


def test_rows_come_back_as_they_went_in(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "ledger.sqlite")
    ledger.record([row("a", rmse_um=0.1, rre_deg=float("nan"))])
    (back,) = ledger.rows(["a", "never measured"])
    assert back.metrics["rmse_um"] == 0.1
    assert np.isnan(back.metrics["rre_deg"])
    assert np.array_equal(back.arrays["cloud"], np.arange(6.0).reshape(2, 3))


def test_a_job_is_recorded_whole_or_not_at_all(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "ledger.sqlite")
    broken = Row("b", "study", "scene", "contender", 0, {}, None)  # type: ignore[arg-type]
    with pytest.raises(Exception, match="NOT NULL"):
        ledger.record([row("a"), broken])
    assert not ledger.has("a")


def measure(key: str, log: Path) -> list[Row]:
    with log.open("a") as file:
        file.write(key + "\n")
    if key == "fails":
        raise RuntimeError("a bug")
    return [row(key)]


def test_what_is_on_record_is_not_run_again(tmp_path: Path) -> None:
    ledger, log = Ledger(tmp_path / "ledger.sqlite"), tmp_path / "log"
    jobs = [Job((key,), measure, (key, log)) for key in "abc"]
    with ThreadPoolExecutor(1) as executor:
        run_jobs(jobs[:2], executor, ledger)
        done: list[int] = []
        run_jobs(jobs, executor, ledger, done.append)
    assert log.read_text().split() == ["a", "b", "c"]
    assert done == [2, 1]


def test_a_bug_in_one_job_loses_nothing_of_those_before(tmp_path: Path) -> None:
    ledger, log = Ledger(tmp_path / "ledger.sqlite"), tmp_path / "log"
    jobs = [Job((key,), measure, (key, log)) for key in ("a", "fails", "c")]
    with ThreadPoolExecutor(1) as executor, pytest.raises(RuntimeError, match="a bug"):
        run_jobs(jobs, executor, ledger)
    assert ledger.has("a")


def test_a_bug_loses_nothing_that_ended_together_with_it() -> None:
    """All calls have ended before the first is asked for; whatever the order of a set, the sound ones come first."""

    class AtOnce(Executor):
        def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]
            future: Future[int] = Future()
            try:
                future.set_result(fn(*args, **kwargs))
            except ZeroDivisionError as error:
                future.set_exception(error)
            return future

    answers = completed(((operator.floordiv, (12, by)) for by in (0, 1, 2, 3)), AtOnce())
    assert sorted(next(answers) for _ in range(3)) == [4, 6, 12]
    with pytest.raises(ZeroDivisionError):
        next(answers)


KILLED = """
import sys, time
from pathlib import Path
from benchmarks.running.ledger import Ledger, Row
ledger = Ledger(Path(sys.argv[1]))
for number in range(100000):
    ledger.record([Row(f"k{number}/{each}", "s", "s", "c", number, {}) for each in range(3)])
    print(number, flush=True)
"""


def test_killed_in_the_middle_everything_said_is_there(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(5)]
    os.kill(process.pid, signal.SIGKILL)
    said = lines + process.stdout.readlines()
    process.stdout.close()
    process.wait()
    last = max(int(line) for line in said if line.strip())
    ledger = Ledger(path)
    assert all(ledger.has(f"k{number}/{each}") for number in range(last + 1) for each in range(3))
    beyond = [ledger.has(f"k{last + 1}/{each}") for each in range(3)]
    assert all(beyond) or not any(beyond)


def test_seeds_depend_on_scene_and_repetition_only() -> None:
    assert seed_of("pollen", 0) == seed_of("pollen", 0)
    assert len({seed_of(scene, i) for scene in ("pollen", "diatom") for i in range(20)}) == 40


def test_a_key_changes_with_every_part() -> None:
    keys = {digest("a", 1), digest("a", 2), digest("b", 1), digest("a", "1"), digest("a")}
    assert len(keys) == 5


POOL = """
import os, sys, time
from semsim.workers import process_pool

if __name__ == "__main__":
    with process_pool(2) as executor:
        print(executor.submit(os.getpid).result(), flush=True)
        time.sleep(600)
"""


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    os.kill(worker, 0)  # raises if it does not live
    process.kill()
    process.wait()
    process.stdout.close()
    for _ in range(100):
        if not _lives(worker):
            return
        time.sleep(0.1)
    pytest.fail(f"worker {worker} outlived its parent by 10 seconds")


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
