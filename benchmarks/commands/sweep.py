"""`python -m benchmarks sweep`: what one or two settings do to the error of methods."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from benchmarks.commands.command_line import command_line
from benchmarks.console import one_sentence, progress, said_when_interrupted, split_names, workers_at

if TYPE_CHECKING:
    from benchmarks.running.manifest import Manifest
    from benchmarks.sweeping.sweep_axes import Axis
    from benchmarks.sweeping.sweeps import Swept

DEFAULT_METHODS = "known_rotation,dense_multiview"


def sweep(
    context: typer.Context,
    axes: Annotated[
        list[str],
        typer.Argument(
            help="One or two of tilt, dose, tilt-error, magnification, rotation, drift, spot, texture, perspective, "
            "views, pixel-size; or a setting such as signal.exponent; or a TOML file."
        ),
    ],
    scene: Annotated[str, typer.Option(help="A scene of the suite, any named scene, or a scene's TOML file.")] = "",
    methods: Annotated[str, typer.Option(help="Names with commas between.")] = "",
    values: Annotated[
        list[str] | None, typer.Option(help="Numbers with commas between, once an axis; else usual ones.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Repetitions; 3 by default.")] = None,
    columns: Annotated[int | None, typer.Option(min=64, help="Width of the pictures, px; 427 by default.")] = None,
    matching_noise_px: Annotated[float, typer.Option(min=0, help="For the predicted response.")] = 0.4,
    window_px: Annotated[float, typer.Option(min=0, help="For the bound: Gaussian window, 1 sigma.")] = 3.0,
    out: Annotated[
        Path | None, typer.Option(help="Results folder; a sweep that was stopped goes on there. results/sweep-NAME.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
    timeout: Annotated[float, typer.Option(min=0.1, help="Most seconds for one call of a method.")] = 300.0,
    memory_gib: Annotated[float, typer.Option(min=0.1, help="Most memory of a process that calls methods.")] = 6.0,
    scheduler: Annotated[str, typer.Option(help="Address of a dask scheduler, instead of processes here.")] = "",
    development: Annotated[bool, typer.Option("--development", help="Specimens and noise for tuning.")] = False,
) -> None:
    """Vary one or two settings of a scene; draw the error with its predicted response and the bound."""
    with one_sentence():
        from benchmarks.running.bench import LEDGER, alone, check_out, contenders
        from benchmarks.running.bench_ledger import BenchLedger
        from benchmarks.running.case import needs_of
        from benchmarks.running.cell import Limits
        from benchmarks.running.manifest import SWEEP_MANIFEST, manifest_of, write_manifest
        from benchmarks.suite import Purpose
        from benchmarks.sweeping.sweeps import Sweep, TheoryOptions, base_scene, run_sweep, sweep_settings

        asked = _asked(axes, values or [])
        swept_axes: tuple[Axis, ...] = asked["axes"]
        folder = out or Path("results") / f"sweep-{'-'.join(axis.name for axis in swept_axes)}"
        check_out(folder)
        picked = contenders(split_names(methods) or asked.get("methods", split_names(DEFAULT_METHODS)))
        purpose: Purpose = "development" if development else "reporting"
        name, width = scene or asked.get("scene", "fracture_rough"), columns or asked.get("columns", 427)
        channels = any("channels" in needs_of(method) for method in picked)
        base = base_scene(name, folder / "cache", columns=width, purpose=purpose, channels=channels)
        theory = TheoryOptions(matching_noise_px, window_px)
        repetitions = seeds or asked.get("repetitions", 3)
        planned = Sweep(base, swept_axes, picked, repetitions, theory, Limits(timeout, memory_gib))
        settings = sweep_settings(planned, name, columns=width, channels=channels)
        # the points are made here: a value that a scene cannot take is said before anything is rendered
        made_by = manifest_of(
            planned.plan, quick=False, purpose=purpose, command=command_line(context), settings=settings
        )
        with (
            alone(folder),
            workers_at(workers, scheduler) as executor,
            said_when_interrupted(folder),
            progress() as bar,
        ):
            write_manifest(folder, made_by, SWEEP_MANIFEST)
            found = run_sweep(planned, BenchLedger(folder / LEDGER), executor, bar)
        _show(found, folder, made_by)


def _asked(axes: list[str], values: list[str]) -> dict[str, Any]:
    """Read names and values of the axes, or a file that has them."""
    from benchmarks.sweeping.sweep_axes import axis_named
    from benchmarks.sweeping.sweeps import read_sweep
    from semrecon.errors import InputError

    if len(axes) == 1 and axes[0].endswith(".toml"):
        if values:
            raise InputError(f"{axes[0]} states the values itself; leave --values out")
        return read_sweep(Path(axes[0]))
    if not 1 <= len(axes) <= 2 or len(set(axes)) < len(axes):
        raise InputError(f"a sweep has one axis or two different ones, not {', '.join(axes)}")
    if len(values) > len(axes):
        raise InputError(f"--values is given {len(values)} times for {len(axes)} axes; give it once an axis")
    numbers = [_numbers(text) for text in values] + [[]] * (len(axes) - len(values))
    return {"axes": tuple(axis_named(name, each) for name, each in zip(axes, numbers, strict=True))}


def _numbers(text: str) -> list[float]:
    from semrecon.errors import InputError

    try:
        return [float(part) for part in split_names(text)]
    except ValueError:
        raise InputError(f"--values {text!r} is not a list of numbers; write them as 1,2,4") from None


def _show(swept: Swept, out: Path, made_by: Manifest) -> None:
    """Write figure, table and page, and print the table."""
    from rich.console import Console
    from rich.table import Table

    from benchmarks.running.manifest import origin
    from benchmarks.sweeping.sweep_figures import draw_sweep
    from benchmarks.sweeping.sweep_summary import summary_rows, sweep_markdown, write_sweep_csv

    for ending in ("svg", "png"):
        draw_sweep(out / f"sweep.{ending}", swept)
    write_sweep_csv(out / "sweep.csv", swept)
    page = [sweep_markdown(swept, "sweep.svg"), *origin(made_by)]
    (out / "sweep.md").write_text("\n".join(page), encoding="utf-8")
    head, rows = summary_rows(swept)
    table = Table(*head, title="median absolute depth error, um")
    for row in rows:
        table.add_row(*row)
    Console().print(table)
    typer.echo(f"Results are in {out}; open sweep.md first.")
