"""The bench on a dask cluster: a real scheduler and two workers on loopback, one of which is killed at work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.running.bench import LEDGER, Plan, measure
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.cell import Limits
from benchmarks.running.executors import cluster
from semrecon.errors import InputError
from tests.test_run_command import ROOT, small_scene
from tests.troubled_methods import Troubled

pytest.importorskip("distributed")
CASES = 12
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a part of a cluster until the block ends."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def address_in(file: Path) -> str:
    """Wait for the scheduler to say where it listens."""
    import json

    for _ in range(600):
        if file.is_file() and file.stat().st_size:
            return str(json.loads(file.read_text())["address"])
        time.sleep(0.1)
    raise AssertionError("the scheduler did not come up")


@pytest.mark.slow
def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    scene = small_scene(tmp_path / "cache")
    methods = tuple(Troubled("slow", f"troubled_{number}") for number in range(CASES))
    plan = Plan((scene,), methods, 1, Limits(60.0, 2.0))
    ledger = BenchLedger(tmp_path / LEDGER)
    where = tmp_path / "scheduler.json"
    worker = ("dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--scheduler-file", str(where))
    scheduler = ("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file")
    with dask(*scheduler, str(where)):
        address = address_in(where)
        with dask(*worker) as first, dask(*worker), cluster(address) as executor:
            done: list[int] = []

            def report(stage: str, steps: int, _: int) -> None:
                done.append(steps if stage == "cases" else 0)
                if sum(done) == 2 and first.poll() is None:
                    os.kill(first.pid, signal.SIGKILL)

            results = measure(plan, ledger, executor, report)
            assert first.wait() == -signal.SIGKILL
    assert [row.kind for row in results] == [""] * CASES
    assert ledger.count() == CASES


def test_a_scheduler_that_is_not_there_is_one_sentence() -> None:
    with pytest.raises(InputError, match="no dask scheduler answers"), cluster("tcp://127.0.0.1:1"):
        pass
