"""`python -m benchmarks record`: a run or a sweep as recordings for the rerun viewer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import one_sentence, progress, split_names

Report = Callable[[str, int, int], None]


def record(
    run: Annotated[Path | None, typer.Option(help="Results folder of a run; results/run by default.")] = None,
    sweep: Annotated[Path | None, typer.Option(help="Results folder of a sweep, instead of a run.")] = None,
    scenes: Annotated[str, typer.Option(help="Of the run, names with commas between; all by default.")] = "",
    methods: Annotated[str, typer.Option(help="Names with commas between; all by default.")] = "",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the recordings; recordings in the results folder by default.")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Every height and point on record, whatever size that makes.")
    ] = False,
) -> None:
    """Write recordings for the rerun viewer, one a scene of a run or one of a sweep; no method is called."""
    with one_sentence():
        from benchmarks.running.read_only import check_target
        from semrecon.errors import InputError

        if run is not None and sweep is not None:
            raise InputError("--run and --sweep are given both; name one of them")
        if sweep is not None and scenes:
            raise InputError("--scenes picks scenes of a run; a sweep has one, so leave it out")
        folder = sweep or run or Path("results/run")
        target = out or folder / "recordings"
        if target.exists() and not target.is_dir():
            raise InputError(f"--out {target} is a file; name a folder for the recordings")
        check_target("--out", target, folder=True)
        with progress() as bar:
            names = split_names(methods)
            written = (
                _sweep(folder, target, names, bar, full=full)
                if sweep is not None
                else _run(folder, target, split_names(scenes), names, bar, full=full)
            )
    for path, size in written:
        typer.echo(f"{path} is written, {size / 1e6:.1f} MB.")
    typer.echo(f"Open one with: rerun {written[0][0]}")


def _run(
    folder: Path, out: Path, scenes: Sequence[str], methods: Sequence[str], bar: Report, *, full: bool
) -> list[tuple[Path, int]]:
    from benchmarks.recording.run_recording import narrowed, record_scene
    from benchmarks.reporting.error_maps import read_run
    from benchmarks.suite import suite
    from semrecon.errors import InputError

    read = read_run(folder)
    _check_names("--methods", "method", methods, [each.name for each in read.methods], folder)
    every = [each.name for each in read.manifest.scenes]
    _check_names("--scenes", "scene", scenes, every, folder)
    known = {
        each.name: each for each in suite(folder / "cache", quick=read.manifest.quick, purpose=read.manifest.purpose)
    }
    wanted = [name for name in every if name in scenes] if scenes else every
    for name in wanted:
        if name not in known:
            raise InputError(f"the specimen of {name} is not at hand; set SEM_REAL_DATA as it was for the run")
    written = []
    for name in wanted:
        path = out / f"{name}.rrd"
        written.append((path, record_scene(path, narrowed(read, methods), known[name], full=full)))
        bar("recordings", 1, len(wanted))
    return written


def _sweep(folder: Path, out: Path, methods: Sequence[str], bar: Report, *, full: bool) -> list[tuple[Path, int]]:
    from benchmarks.recording.sweep_recording import narrowed_sweep, read_swept, record_sweep

    read = read_swept(folder)
    _check_names("--methods", "method", methods, [each.name for each in read.record.methods], folder)
    path = out / f"sweep-{'-'.join(axis.name for axis in read.axes)}.rrd"
    return [(path, record_sweep(path, narrowed_sweep(read, methods), bar, full=full))]


def _check_names(option: str, what: str, names: Sequence[str], known: Sequence[str], folder: Path) -> None:
    from semrecon.errors import InputError

    for name in names:
        if name not in known:
            raise InputError(f"{option} names no {what} {name!r} of {folder}; there are {', '.join(known)}")
