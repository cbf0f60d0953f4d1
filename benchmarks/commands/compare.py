"""`python -m benchmarks compare`: two methods, or two runs, pair by pair."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.console import one_sentence, split_names

if TYPE_CHECKING:
    from benchmarks.judging.paired import Line
    from benchmarks.reporting.paired_sides import Paired


def compare(
    first: Annotated[str, typer.Argument(help="A method of the run, or the folder of a run: before a change.")],
    second: Annotated[str, typer.Argument(help="Another method of the run, or the folder of another run: after it.")],
    run: Annotated[Path, typer.Option(help="Results folder of the run in which two methods are compared.")] = Path(
        "results/run"
    ),
    scenes: Annotated[str, typer.Option(help="Names with commas between; all by default.")] = "",
    method: Annotated[str, typer.Option(help="Of two runs: names with commas between; all by default.")] = "",
    metric: Annotated[str, typer.Option(help="Scores with commas between, the first one scene by scene.")] = "",
    out: Annotated[Path | None, typer.Option(help="Folder for compare.md and compare.csv.")] = None,
) -> None:
    """Compare two methods, or two runs, on the same pictures: with intervals, and no claim that they do not bear."""
    with one_sentence():
        from benchmarks.reporting.paired_sides import Asked, compare_methods, compare_runs, is_run
        from benchmarks.reporting.paired_tables import FILES, markdown, write_csv
        from benchmarks.running import read_only
        from semrecon.errors import InputError
        from semrecon.folder import check_target, whole_folder

        def ours(folder: Path) -> bool:
            return {path.name for path in folder.iterdir()} <= set(FILES)

        if out is not None:
            check_target(out, ours)
            read_only.check_target("--out", out)
        asked = Asked(*(tuple(split_names(text)) for text in (scenes, method, metric)))
        folders = [is_run(name) for name in (first, second)]
        if any(folders) and not all(folders):
            raise InputError(
                f"{first if folders[1] else second} is not the folder of a run, and the other one is; name two methods "
                "or two runs"
            )
        paired = (
            compare_runs(Path(first), Path(second), asked)
            if all(folders)
            else compare_methods(first, second, run, asked)
        )
        _show(paired)
        if out is not None:
            with whole_folder(out, ours) as folder:
                (folder / FILES[1]).write_text(markdown(paired), encoding="utf-8")
                write_csv(folder / FILES[0], paired)
            typer.echo(f"Every score of every scene is in {out / FILES[0]}, the tables in {out / FILES[1]}.")


def _show(paired: Paired) -> None:
    from benchmarks.reporting.paired_tables import by_scene, changed, notes, overall, sentences, title

    if each := changed(overall(paired)):
        _print(paired, each, f"{paired.first} against {paired.second}")
    if each := changed(by_scene(paired)):
        _print(paired, each, f"scene by scene: {title(paired.metrics[0])}")
    for said in sentences(paired):
        typer.echo(f"- {said}")
    for note in notes(paired):
        typer.echo(f"note: {note}")


def _print(paired: Paired, lines: list[Line], caption: str) -> None:
    from rich.console import Console
    from rich.table import Table

    from benchmarks.reporting.paired_tables import rows

    head, *rest = rows(paired, lines)
    table = Table(*head, title=caption)
    for row in rest:
        table.add_row(*row)
    Console().print(table)
