"""`python -m benchmarks report`: a run as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import one_sentence, progress


def report(
    run: Annotated[Path, typer.Option(help="Results folder of a run.")] = Path("results/run"),
    out: Annotated[Path | None, typer.Option(help="The page; report.html in the folder of the run by default.")] = None,
    sweep: Annotated[
        list[Path] | None, typer.Option(help="Results folder of a sweep to be shown too; may be given again.")
    ] = None,
) -> None:
    """Write a run as one HTML page that needs no network: leaderboard, maps, failures, sweeps; no method is called."""
    with one_sentence():
        from benchmarks.reporting.report import PAGE, write_report

        page = out or run / PAGE
        with progress() as bar:
            size = write_report(run, page, sweep or [], bar)
    typer.echo(f"{page} is written, {size / 1e6:.1f} MB; open it in a browser.")
