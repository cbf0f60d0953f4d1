"""`python -m benchmarks run`: all methods on all scenes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.commands.command_line import command_line
from benchmarks.console import one_sentence, progress, said_when_interrupted, split_names, workers_at

if TYPE_CHECKING:
    from benchmarks.running.bench import Plan
    from benchmarks.running.bench_ledger import BenchLedger, Result
    from benchmarks.running.manifest import Manifest


def run(
    context: typer.Context,
    methods: Annotated[str, typer.Option(help="Names with commas between; all by default.")] = "",
    scenes: Annotated[str, typer.Option(help="Names with commas between; all by default.")] = "",
    seeds: Annotated[int | None, typer.Option(min=1, help="Repetitions; 2, or 1 with --quick.")] = None,
    out: Annotated[Path, typer.Option(help="Results folder; a run that was stopped goes on there.")] = Path(
        "results/run"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Smaller images and 1 repetition.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
    timeout: Annotated[float, typer.Option(min=0.1, help="Most seconds for one call of a method.")] = 300.0,
    memory_gib: Annotated[float, typer.Option(min=0.1, help="Most memory of a process that calls methods.")] = 6.0,
    scheduler: Annotated[str, typer.Option(help="Address of a dask scheduler, instead of processes here.")] = "",
    development: Annotated[
        bool, typer.Option("--development", help="Specimens and noise for tuning, not those that are reported.")
    ] = False,
) -> None:
    """Run methods on scenes, judge them against truth, write the leaderboard; what is on record is not run again."""
    with one_sentence():
        from benchmarks.running.bench import LEDGER, Plan, alone, check_out, contenders, measure
        from benchmarks.running.bench_ledger import BenchLedger
        from benchmarks.running.bounds import add_bounds
        from benchmarks.running.cell import Limits
        from benchmarks.running.manifest import manifest_of, write_manifest
        from benchmarks.suite import Purpose, chosen, suite

        check_out(out)
        purpose: Purpose = "development" if development else "reporting"
        every = suite(out / "cache", quick=quick, purpose=purpose)
        repetitions = seeds or (1 if quick else 2)
        picked = chosen(every, split_names(scenes))
        plan = Plan(picked, contenders(split_names(methods)), repetitions, Limits(timeout, memory_gib))
        with alone(out), workers_at(workers, scheduler) as executor, said_when_interrupted(out), progress() as report:
            made_by = manifest_of(plan, quick=quick, purpose=purpose, command=command_line(context))
            write_manifest(out, made_by)
            ledger = BenchLedger(out / LEDGER)
            measure(plan, ledger, executor, report)
            results = add_bounds(plan, ledger, executor, report)
        _show(plan, results, ledger, made_by, out)


def _show(plan: Plan, results: list[Result], ledger: BenchLedger, made_by: Manifest, out: Path) -> None:
    """Write tables and print the one over all scenes."""
    from benchmarks.reporting.leaderboard import (
        entries,
        limit_notes,
        markdown,
        notes,
        rows_over_scenes,
        write_table_csv,
    )
    from benchmarks.running.bounds import reasons
    from benchmarks.running.case import is_oracle
    from benchmarks.running.export import write_csv, write_parquet
    from benchmarks.running.manifest import origin
    from benchmarks.suite import described
    from semrecon.errors import InputError

    every = entries(results, plan.methods)
    unlimited = reasons([(scene.name, scene.identity) for scene in plan.scenes], ledger)
    said = [*notes(results, any(is_oracle(method) for method in plan.methods)), *limit_notes(unlimited)]
    about = {scene.name: described(scene) for scene in plan.scenes}
    page = [markdown(every, about, said), *origin(made_by)]
    (out / "leaderboard.md").write_text("\n".join(page), encoding="utf-8")
    write_table_csv(out / "leaderboard.csv", every)
    write_csv(out / "results.csv", results)
    try:
        write_parquet(out / "results.parquet", results)
    except InputError as error:
        typer.echo(f"note: {error}", err=True)
    _print_table(rows_over_scenes(every))
    for each in every:
        if each.failures and not each.outcome.startswith("needs "):
            typer.echo(f"{each.scene}, {each.method}: {each.outcome}")
    typer.echo(f"Results are in {out}; open leaderboard.md first.")


def _print_table(rows: list[list[str]]) -> None:
    """Print medians, as many scenes side by side as the terminal is wide; what each method needs comes last."""
    from rich.console import Console
    from rich.table import Table

    from benchmarks.reporting.leaderboard import side_by_side

    console = Console()
    typer.echo("Median absolute depth error, um, declared gauge removed, and what each method needs:")
    for head, *lines in side_by_side(rows, console.width):
        table = Table(*head)
        for line in lines:
            table.add_row(*line)
        console.print(table)
