"""The recipe of `python -m benchmarks run`: all methods on all scenes, into a ledger, out as tables."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import ORACLE, Case, cases, judge_version, run_case, score
from benchmarks.running.cell import Limits
from benchmarks.running.read_only import can_be_written
from benchmarks.running.runner import completed
from benchmarks.suite import BenchScene
from semrecon.errors import InputError

LEDGER, LOCK = "bench.sqlite", "bench.lock"
Report = Callable[[str, int, int], None]
"""Called with the stage, steps done now (not in all) and the number of steps of the stage."""


@dataclass(frozen=True)
class Plan:
    """What is to be run: all methods on all scenes, so many repetitions each, within limits."""

    scenes: tuple[BenchScene, ...]
    methods: tuple[Any, ...]
    repetitions: int
    limits: Limits = field(default_factory=Limits)

    @property
    def cases(self) -> list[Case]:
        """Every case, scene by scene."""
        return cases(self.scenes, self.methods, self.repetitions)


def contenders(names: Sequence[str], option: str = "--methods") -> tuple[Any, ...]:
    """Pick methods and oracles by name, all if none is named; raises `InputError` for a name that is none."""
    from semrecon.methods import all_methods

    known = {method.name: method for method in (*all_methods(), *oracles())}
    wanted = [name.replace("-", "_") for name in names]
    for name in wanted:
        if name not in known:
            raise InputError(f"{option} names no method {name!r}; there are {', '.join(known)}")
    return tuple(known[name] for name in wanted) if wanted else tuple(known.values())


def oracles() -> tuple[Any, ...]:
    """Find what is handed part of the truth; see `benchmarks.oracles`."""
    from benchmarks import oracles as module

    return tuple(each for each in getattr(module, "ORACLES", ()) if each.name.startswith(ORACLE))


def measure(plan: Plan, ledger: BenchLedger, executor: Executor, report: Report) -> list[Result]:
    """Prepare scenes, run the cases that have no answer, judge those that have no score; return all results."""
    wanted, judge = plan.cases, judge_version()
    unanswered = [case for case in wanted if not ledger.settled(case.key, plan.limits)]
    lacking = {case.key for case in unanswered}
    unjudged = [case for case in wanted if case.key not in lacking and not ledger.judged(case.key, judge)]
    _prepare([each for each in plan.scenes if any(case.scene == each for case in unanswered)], executor, report)
    report("cases", len(wanted) - len(unanswered), len(wanted))
    for outcome in completed(((run_case, (case, plan.limits)) for case in unanswered), executor):
        ledger.record(outcome, plan.limits)
        report("cases", 1, len(wanted))
    for key, metrics in completed(((_rescored, (case, ledger.path)) for case in unjudged), executor):
        ledger.record_score(key, judge, metrics)
        report("judging anew", 1, len(unjudged))
    return ledger.results([case.key for case in wanted], judge)


def _prepare(scenes: Sequence[BenchScene], executor: Executor, report: Report) -> None:
    """Render what is not rendered yet, several scenes at once."""
    for _ in completed(((_prepared, (each,)) for each in scenes), executor):
        report("preparing scenes", 1, len(scenes))


def _prepared(scene: BenchScene) -> None:
    scene.source.prepare()


def _rescored(case: Case, ledger: Path) -> tuple[str, dict[str, float]]:
    """Judge an answer on record; the worker reads it, so that estimates do not wait in a queue."""
    return case.key, score(case, BenchLedger(ledger).answer(case))


def check_out(out: Path) -> None:
    """Refuse a folder that holds something else than a run; raises `InputError`."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file; name a folder for the results")
    if out.is_dir() and any(out.iterdir()) and not (out / LEDGER).is_file() and not (out / LOCK).is_file():
        raise InputError(f"--out {out} holds something else than a run; name a new or empty folder")


@contextmanager
def alone(out: Path) -> Iterator[None]:
    """Hold the lock of a results folder; a second run there is refused, and a killed one leaves nothing locked."""
    if not can_be_written(out):
        raise InputError(f"--out {out} cannot be written; name another folder for the results")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK).open("a+", encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise InputError(
                f"process {file.read().strip() or 'unknown'} is running the bench in {out}; "
                "let it end, or name another --out"
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
