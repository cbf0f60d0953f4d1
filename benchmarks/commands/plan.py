"""`python -m benchmarks plan`: which tilts, how many views and what dose reach a wanted depth error."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from benchmarks.commands.command_line import command_line
from benchmarks.console import one_sentence, progress, said_when_interrupted, split_names, workers_at

if TYPE_CHECKING:
    from benchmarks.running.manifest import Manifest
    from benchmarks.sweeping.planner import Choices, Planned

Number = TypeVar("Number", int, float)


def plan(
    context: typer.Context,
    target_um: Annotated[float, typer.Option(help="Wanted median absolute depth error, um.")],
    scene: Annotated[
        str, typer.Option(help="What resembles your specimen: a scene of the suite, any named scene, or a TOML file.")
    ] = "fracture_rough",
    method: Annotated[str, typer.Option(help="The method that will be used.")] = "known_rotation",
    ranges: Annotated[str, typer.Option(help="Ranges of tilt about zero, deg, with commas; 4,8,16,30.")] = "",
    views: Annotated[str, typer.Option(help="Numbers of views, with commas; 2,3,5.")] = "",
    doses: Annotated[str, typer.Option(help="Electrons a pixel and view, with commas; 25,100,400,1600.")] = "",
    columns: Annotated[int, typer.Option(min=64, help="Width of the pictures, px.")] = 427,
    checks: Annotated[
        int, typer.Option(min=1, help="Most candidates to be simulated at once; as many again if none of them will do.")
    ] = 3,
    seeds: Annotated[int, typer.Option(min=1, help="Repetitions of each simulation.")] = 2,
    window_px: Annotated[float, typer.Option(min=0, help="For the bound: Gaussian window, 1 sigma.")] = 3.0,
    out: Annotated[Path, typer.Option(help="Results folder; a plan that was stopped goes on there.")] = Path(
        "results/plan"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
    timeout: Annotated[float, typer.Option(min=0.1, help="Most seconds for one call of the method.")] = 300.0,
    memory_gib: Annotated[float, typer.Option(min=0.1, help="Most memory of a process that calls it.")] = 6.0,
    scheduler: Annotated[str, typer.Option(help="Address of a dask scheduler, instead of processes here.")] = "",
) -> None:
    """Find the cheapest way to take the pictures that reaches a depth error, by model, and check it by simulation."""
    with one_sentence():
        from benchmarks.running.bench import LEDGER, alone, check_out, contenders
        from benchmarks.running.bench_ledger import BenchLedger
        from benchmarks.running.case import needs_of
        from benchmarks.running.cell import Limits
        from benchmarks.running.manifest import PLAN_MANIFEST, write_manifest
        from benchmarks.sweeping.planner import Task, make_plan, task_manifest
        from benchmarks.sweeping.sweeps import base_scene
        from semrecon.errors import InputError

        if not 0 < target_um < math.inf:
            raise InputError(f"--target-um must be a positive number of micrometres, not {target_um:g}")
        check_out(out)
        (picked,) = contenders([method], "--method")
        choices = _choices(ranges, views, doses).for_method(picked)
        channels = "channels" in needs_of(picked)
        base, development = (
            base_scene(scene, out / "cache", columns=columns, purpose=purpose, channels=channels)
            for purpose in ("reporting", "development")
        )
        limits = Limits(timeout, memory_gib)
        task = Task(base, development, picked, target_um, choices, seeds, checks, window_px, limits)
        with alone(out), workers_at(workers, scheduler) as executor, said_when_interrupted(out), progress() as report:
            made_by = task_manifest(task, command_line(context))
            write_manifest(out, made_by, PLAN_MANIFEST)
            planned = make_plan(task, BenchLedger(out / LEDGER), executor, report)
        _show(planned, base.name, out, made_by)


def _choices(ranges: str, views: str, doses: str) -> Choices:
    from benchmarks.sweeping.planner import Choices

    usual = Choices()
    return Choices(
        _listed("--ranges", ranges, float) if ranges else usual.ranges_deg,
        _listed("--views", views, int) if views else usual.views,
        _listed("--doses", doses, float) if doses else usual.doses_e,
    )


def _listed(option: str, text: str, kind: Callable[[str], Number]) -> tuple[Number, ...]:
    """Read numbers with commas between, each once."""
    from semrecon.errors import InputError

    try:
        found = tuple(dict.fromkeys(kind(part) for part in split_names(text)))
    except ValueError:
        found = ()
    if not found:
        what, example = ("whole numbers", "2,3,5") if kind is int else ("numbers", "4,8,16")
        raise InputError(f"{option} {text!r} is not a list of {what}; write them as {example}")
    return found


def _show(planned: Planned, scene: str, out: Path, made_by: Manifest) -> None:
    from rich.console import Console
    from rich.table import Table

    from benchmarks.running.manifest import origin
    from benchmarks.sweeping.planner import write_plan_csv
    from benchmarks.sweeping.planner_page import failures, plan_markdown, plan_rows, verdict
    from benchmarks.sweeping.sweep_figures import draw_plan

    draw_plan(out / "plan.png", planned, f"{planned.method} on {scene}")
    write_plan_csv(out / "plan.csv", planned)
    page = [plan_markdown(planned, scene, "plan.png"), *origin(made_by)]
    (out / "plan.md").write_text("\n".join(page), encoding="utf-8")
    head, rows = plan_rows(planned)
    table = Table(*head, title=f"tried for {planned.target_um:g} um, cheapest first; um")
    for row in rows:
        table.add_row(*row)
    Console().print(table)
    for said in failures(planned):
        typer.echo(f"- {said}")
    typer.echo(verdict(planned))
    typer.echo(f"Results are in {out}; open plan.md first.")
