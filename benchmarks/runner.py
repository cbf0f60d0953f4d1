"""Run jobs through a `concurrent.futures` executor and record each as it ends; what is recorded is not run again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.ledger import Ledger, Row

_ROOT = Path(__file__).resolve().parent.parent
_DECIDING = ("adapt", "contenders", "evaluate", "scenes", "study")
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
    futures: list[Future[list[Row]]] = [executor.submit(job.function, *job.arguments) for job in missing]
    try:
        for future in as_completed(futures):
            ledger.record(future.result())
            on_done(1)
    finally:
        for future in futures:
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
    return [path] if path.is_file() else list(path.rglob("*.py"))
