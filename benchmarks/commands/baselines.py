"""`python -m benchmarks baselines`: commit to the accuracy of today, or check it against what was committed to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.console import one_sentence, split_names

if TYPE_CHECKING:
    from benchmarks.gate.commitment import Part, Shift

MOVED = 1
"""Exit status of a check that found something moved."""


def baselines(
    methods: Annotated[str, typer.Option(help="Names with commas between: the methods to commit to in --file.")] = "",
    scenes: Annotated[str, typer.Option(help="Names with commas between; all on which the methods answer.")] = "",
    file: Annotated[
        Path | None, typer.Option(help="Baselines of your own; without, those of this project are meant.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Write nothing; exit status 1 if anything moved.")] = False,
    seeds: Annotated[int, typer.Option(min=2, help="Repetitions a mean is over, in --file.")] = 3,
    columns: Annotated[int, typer.Option(min=64, help="Width of the pictures, px, in --file.")] = 427,
    only: Annotated[str, typer.Option(help="Of this project's: kernels, methods or study; all by default.")] = "",
    times: Annotated[bool, typer.Option("--times", help="Write this project's times anew instead.")] = False,
) -> None:
    """Commit to the accuracy of methods in a file, or check with --check that it is where it was."""
    with one_sentence():
        _refuse_what_does_not_fit(methods, scenes, file, only, check=check, times=times)
        if times:
            _write_times()
        elif check:
            _check(file, split_names(only))
        elif file is not None:
            _write(file, split_names(methods), split_names(scenes), seeds, columns)
        else:
            _renew(split_names(only))


def _refuse_what_does_not_fit(
    methods: str, scenes: str, file: Path | None, only: str, *, check: bool, times: bool
) -> None:
    from benchmarks.gate.project import PARTS
    from semrecon.errors import InputError

    if check and (methods or scenes):
        raise InputError("--check takes methods and scenes from the baselines; leave --methods and --scenes out")
    if file is None and (methods or scenes):
        raise InputError("--methods and --scenes are for baselines of your own; name their file with --file")
    if file is not None and not check and not methods:
        raise InputError("--file needs --methods: the names of the methods to commit to")
    if file is not None and (only or times):
        raise InputError("--only and --times are for this project's own baselines; leave --file out")
    if times and (check or only):
        raise InputError("--times writes times and nothing else; they are checked by `./dev bench`")
    for name in split_names(only):
        if name not in PARTS:
            raise InputError(f"--only names no part {name!r}; there are {', '.join(PARTS)}")


def _write(file: Path, methods: list[str], scenes: list[str], seeds: int, columns: int) -> None:
    from benchmarks.gate.commitment import FOR_SPREAD, write_commitment
    from benchmarks.gate.methods import committed, small_scenes
    from benchmarks.running.bench import contenders
    from semrecon.errors import InputError

    if not file.parent.is_dir():
        raise InputError(f"--file {file}: there is no folder {file.parent}; make it, or name another file")
    chosen = contenders(methods)
    with _scratch() as cache:
        pairs = [(scene, chosen) for scene in small_scenes(cache, scenes, columns)]
        part = committed(pairs, seeds, FOR_SPREAD * seeds, _say)
    write_commitment({"methods": part}, file)
    typer.echo(f"Wrote {_count(part)} to {file}.")


def _renew(only: list[str]) -> None:
    from benchmarks.gate.commitment import read_commitment, write_commitment
    from benchmarks.gate.project import ACCURACY, PARTS, accuracy

    kept = read_commitment(ACCURACY) if only else {}
    with _scratch() as cache:
        made = accuracy(cache, only or PARTS, _say)
    write_commitment(kept | made, ACCURACY)
    typer.echo(f"Wrote {ACCURACY}.")


def _write_times() -> None:
    from benchmarks.gate.pace import write_paces
    from benchmarks.gate.project import TIME
    from benchmarks.gate.project import times as measured_times

    with _scratch() as cache:
        write_paces(measured_times(cache, _say), TIME)
    typer.echo(f"Wrote {TIME}.")


def _check(file: Path | None, only: list[str]) -> None:
    from benchmarks.gate.commitment import read_commitment, report
    from benchmarks.gate.methods import checked
    from benchmarks.gate.project import ACCURACY, RENEW, moved
    from semrecon.errors import InputError

    commitment = read_commitment(file or ACCURACY)
    if file is not None and "methods" not in commitment:
        raise InputError(f"{file} commits to no methods; write it anew with --methods and --file")
    with _scratch() as cache:
        found: list[Shift]
        if file is not None:
            found = checked(commitment["methods"], cache)
        else:
            found = moved({name: part for name, part in commitment.items() if not only or name in only}, cache)
    if found:
        again = RENEW if file is None else f"{RENEW} --methods ... --scenes ... --file {file}"
        typer.echo(report(found, again), err=True)
        raise typer.Exit(MOVED)
    kept = ", ".join(_count(part) for name, part in commitment.items() if not only or name in only)
    typer.echo(f"Nothing moved: {kept}.")


def _count(part: Part) -> str:
    figures = sum(len(metrics) for contenders in part.bounds.values() for metrics in contenders.values())
    return f"{figures} figures on {', '.join(part.bounds)}"


@contextmanager
def _scratch() -> Iterator[Path]:
    """Make a folder for surfaces that goes when done."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _say(stage: str) -> None:
    typer.echo(f"measuring {stage}", err=True)
