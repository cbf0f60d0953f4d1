"""What the commands of the bench have in common: one sentence for what the user can put right, and progress bars."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

import typer

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""

Report = Callable[[str, int, int], None]
"""Called with the stage, steps done now (not in all) and the number of steps of the stage."""


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the user can put right into one sentence on stderr and exit status 2."""
    from semrecon.errors import InputError as ReconError
    from semrecon.errors import MethodError
    from semsim.errors import InputError as SimError

    try:
        yield
    except (ReconError, SimError, MethodError) as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(2) from None


@contextmanager
def progress() -> Iterator[Report]:
    """Show a bar for each stage, with the time left, on the standard error stream."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, steps: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.advance(tasks[stage], steps)

        yield report


def split_names(text: str) -> list[str]:
    """Split names with commas between."""
    return [name.strip() for name in text.split(",") if name.strip()]


@contextmanager
def workers_at(workers: int, scheduler: str) -> Iterator[Executor]:
    """Start processes here, or use the workers of a dask cluster where the address of its scheduler is given."""
    from benchmarks.running.executors import cluster, local

    with cluster(scheduler) if scheduler else local(workers) as executor:
        yield executor


@contextmanager
def said_when_interrupted(out: Path) -> Iterator[None]:
    """On Ctrl-C say that nothing is lost, and leave at once: workers and their cells end with this process."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"\nStopped. What was measured is in {out}; the same command goes on from there.", err=True)
        os._exit(INTERRUPTED)  # an ordinary exit would wait for the cases under way
