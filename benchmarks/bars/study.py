"""The recipe of `python -m benchmarks bars`: ask, judge, work out the rest, hold against what is asked."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from benchmarks.bars.bar import Answered, Bar
from benchmarks.bars.line import Line
from benchmarks.bars.plan import BarsPlan, Found, plan_of
from benchmarks.bars.specimens import FIRST_SEED, Specimens
from benchmarks.running.bench import LEDGER, Report, measure
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.bounds import add_bounds
from benchmarks.running.cell import Limits
from benchmarks.running.ledger import Ledger, Row
from benchmarks.running.runner import Job, completed, run_jobs

ROWS, MANIFEST = "bars.sqlite", "bars.json"
"""Beside the ledger of cases: what is measured otherwise, and what it is of."""


@dataclass(frozen=True)
class Study:
    """Which bars are measured, on what, and within which limits of a call."""

    bars: tuple[Bar, ...]
    specimens: Specimens
    limits: Limits

    @property
    def about(self) -> list[str]:
        """Say what is measured, and on which specimens."""
        first, last = (FIRST_SEED[self.specimens.purpose] + each for each in (0, self.specimens.meshes - 1))
        tuning = "" if self.specimens.purpose == "reporting" else " These are for tuning and no result to report."
        return [
            f"What `dense_multiview` is to keep, measured on specimens {first} to {last} of each kind, with noise of "
            f"their own: neither is that of another study, nor of development.{tuning}"
        ]

    @property
    def plan(self) -> BarsPlan:
        """All cases of all bars."""
        return plan_of([each for bar in self.bars for each in bar.questions(self.specimens)], self.limits)


def run_bars(study: Study, out: Path, executor: Executor, report: Report) -> list[Line]:
    """Measure what is not on record, in processes side by side and then, for times, alone; return all lines."""
    ledger, plan = BenchLedger(out / LEDGER), study.plan
    results = {each.key: each for each in measure(plan, ledger, executor, report)}
    limited = [each for bar in study.bars if bar.efficiency for each in bar.questions(study.specimens)]
    if limited:
        found = add_bounds(plan_of(limited, study.limits), ledger, executor, report)
        results |= {each.key: each for each in found}
    derived = _derived(study, plan, list(results.values()), ledger, executor, report)
    rows = _rows([bar for bar in study.bars if not bar.alone], study, out, executor, report, "without truth")
    with ThreadPoolExecutor(1) as alone:
        rows += _rows([bar for bar in study.bars if bar.alone], study, out, alone, report, "times, one by one")
    by_case = {(each.scene, each.method): each for each in results.values()}
    by_row = {(row.study, row.scene, row.contender): row for row in rows}
    return [line for bar in study.bars for line in bar.lines(study.specimens, Found(by_case, derived, by_row))]


def _derived(
    study: Study, plan: BarsPlan, results: Sequence[Result], ledger: BenchLedger, executor: Executor, report: Report
) -> dict[tuple[str, str], dict[str, float]]:
    """Work out the numbers that scores do not hold; they are a view of the record, so they are made anew each time."""
    at = {each.key: each for each in results if not each.kind}
    answered: Answered = {(case.scene.name, case.method.name): case for case in plan.cases if case.key in at}
    calls = [each for bar in study.bars for each in bar.derivations(study.specimens, answered, ledger.path)]
    answer: dict[tuple[str, str], dict[str, float]] = {}
    for name, numbers in completed(calls, executor):
        answer.setdefault(name, {}).update(numbers)
        report("points and tilts", 1, len(calls))
    return answer


def _rows(bars: Sequence[Bar], study: Study, out: Path, executor: Executor, report: Report, stage: str) -> list[Row]:
    """Run the jobs of some bars, and return the rows of all of them."""
    jobs: list[Job] = [job for bar in bars for job in bar.jobs(study.specimens)]
    if not jobs:
        return []
    ledger = Ledger(out / ROWS)
    run_jobs(jobs, executor, ledger, lambda done: report(stage, done, len(jobs)))
    return ledger.rows([key for job in jobs for key in job.keys])
