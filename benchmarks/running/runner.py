"""Run jobs through a `concurrent.futures` executor and record each as it ends; what is recorded is not run again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.running.ledger import Ledger, Row

T = TypeVar("T")
IN_FLIGHT = 16
"""Calls handed to an executor at a time: more than it has workers, so that none waits."""
_ROOT = Path(__file__).resolve().parents[2]
_DECIDING = (
    "adapt",
    "judging/evaluate",
    "scenes",
    "seed_study/contenders",
    "seed_study/study",
)
"""Modules here that can change a result; figures, tables and recordings only show it."""


@dataclass(frozen=True)
class Job:
    """A call that measures the cases of `keys` and returns a row for each.

    `function` stands at module level and `arguments` can be pickled, so that a job can run in another process.
    """

    keys: tuple[str, ...]
    function: Callable[..., list[Row]]
    arguments: tuple[Any, ...]


def run_jobs(
    jobs: Sequence[Job], executor: Executor, ledger: Ledger, on_done: Callable[[int], None] = lambda _: None
) -> None:
    """Run what the ledger lacks and record it job by job, in the order of completion.

    Parameters
    ----------
    on_done
        Called with the number of jobs that are settled: once at the start for those on record, then after each.
    """
    missing = [job for job in jobs if not all(ledger.has(key) for key in job.keys)]
    on_done(len(jobs) - len(missing))
    for rows in completed(((job.function, job.arguments) for job in missing), executor):
        ledger.record(rows)
        on_done(1)


def completed(calls: Iterable[tuple[Callable[..., T], tuple[Any, ...]]], executor: Executor) -> Iterator[T]:
    """Make calls through an executor and yield what they return, in the order of completion; raise what one raises.

    No more than `IN_FLIGHT` are handed over at a time, and nothing is kept that was yielded, so that a long run needs
    no more memory than a short one. Calls that have not begun are withdrawn when the caller stops.
    """
    waiting = iter(calls)
    under_way: set[Future[T]] = set()
    try:
        while True:
            for function, arguments in islice(waiting, IN_FLIGHT - len(under_way)):
                under_way.add(executor.submit(function, *arguments))
            if not under_way:
                return
            ended, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            done = sorted(ended, key=lambda future: future.exception() is None)
            while done:  # what came out well first: a bug in one call must not lose what ended together with it
                yield done.pop().result()
    finally:
        for future in under_way:
            future.cancel()


def seed_of(scene: str, repetition: int) -> int:
    """Seed of a repetition: never of the contender, so that all contenders see the same noise."""
    return int.from_bytes(hashlib.sha256(f"{scene}/{repetition}".encode()).digest()[:8], "big")


def digest(*parts: Any) -> str:
    """Key of a case from all that determines it (anything JSON can say, or that has a stable `repr`)."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=repr).encode()).hexdigest()[:32]


@cache
def code_version(*packages: str) -> str:
    """Digest of the sources of packages or files (of all that can change a result by default)."""
    wanted = packages or ("semsim", "semrecon", *(f"benchmarks/{name}.py" for name in _DECIDING))
    content = hashlib.sha256()
    for source in sorted(path for name in wanted for path in _sources(_ROOT / name)):
        content.update(source.relative_to(_ROOT).as_posix().encode() + b"\0" + source.read_bytes())
    return content.hexdigest()[:16]


def _sources(path: Path) -> list[Path]:
    found = [path] if path.is_file() else list(path.rglob("*.py"))
    if not found:
        raise FileNotFoundError(f"{path} is named among what decides a result, and is not there")
    return found
