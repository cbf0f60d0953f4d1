"""`python -m benchmarks bars`: whether the dense method keeps what is promised of it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.commands.command_line import command_line
from benchmarks.console import one_sentence, progress, said_when_interrupted, split_names, workers_at

if TYPE_CHECKING:
    from benchmarks.bars.line import Line
    from benchmarks.bars.study import Study
    from benchmarks.running.manifest import Manifest


def bars(
    context: typer.Context,
    only: Annotated[str, typer.Option(help="Names of bars with commas between; all by default.")] = "",
    meshes: Annotated[int | None, typer.Option(min=1, help="Specimens of each kind; 3, or 1 with --quick.")] = None,
    out: Annotated[Path, typer.Option(help="Results folder; a run that was stopped goes on there.")] = Path(
        "results/bars"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Smaller images and 1 specimen: for trying.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
    timeout: Annotated[float, typer.Option(min=0.1, help="Most seconds for one call of a method.")] = 600.0,
    memory_gib: Annotated[float, typer.Option(min=0.1, help="Most memory of a process that calls methods.")] = 6.0,
    development: Annotated[
        bool, typer.Option("--development", help="Specimens and noise for tuning, not those that are reported.")
    ] = False,
) -> None:
    """Measure what dense_multiview is to keep, bar by bar, on specimens that nobody tuned on."""
    with one_sentence():
        from benchmarks import suite
        from benchmarks.bars.bar import all_bars, chosen
        from benchmarks.bars.specimens import Specimens
        from benchmarks.bars.study import MANIFEST, Study, run_bars
        from benchmarks.running.bench import alone, check_out
        from benchmarks.running.cell import Limits
        from benchmarks.running.manifest import manifest_of, write_manifest

        check_out(out)
        purpose: suite.Purpose = "development" if development else "reporting"
        picked = chosen(all_bars(quick=quick), split_names(only))
        scenes = suite.suite(out / "cache", quick=quick, purpose=purpose)
        specimens = Specimens(scenes, meshes or (1 if quick else 3), purpose)
        study = Study(picked, specimens, Limits(timeout, memory_gib))
        with alone(out), workers_at(workers, "") as executor, said_when_interrupted(out), progress() as report:
            made_by = manifest_of(study.plan, quick=quick, purpose=purpose, command=command_line(context))
            write_manifest(out, made_by, MANIFEST)
            lines = run_bars(study, out, executor, report)
        _show(study, lines, made_by, out)


def _show(study: Study, lines: list[Line], made_by: Manifest, out: Path) -> None:
    """Write page and CSV, and print the table at a glance."""
    from rich.console import Console
    from rich.table import Table

    from benchmarks.bars.table import HEAD, markdown, row_of, write_csv
    from benchmarks.running.manifest import origin

    page = [markdown(study.bars, lines, study.about), *origin(made_by)]
    (out / "bars.md").write_text("\n".join(page), encoding="utf-8")
    write_csv(out / "bars.csv", lines)
    table = Table(*HEAD)
    for line in lines:
        if not line.detail:
            table.add_row(*row_of(line))
    Console().print(table)
    typer.echo(f"Results are in {out}; open bars.md first.")
