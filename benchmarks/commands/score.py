"""`python -m benchmarks score`: the surface of any other software against the truth of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.console import one_sentence, split_names

if TYPE_CHECKING:
    from benchmarks.judging.submission import Subject
    from benchmarks.judging.submitted import Scored


def score(
    surface: Annotated[Path, typer.Argument(help="PLY, STL, OBJ, XYZ, TIFF of heights, or a reconstruction folder.")],
    scene: Annotated[str, typer.Option(help="A scene of the suite, or a series folder with truth/.")],
    quick: Annotated[bool, typer.Option("--quick", help="The scene was written with --quick.")] = False,
    development: Annotated[bool, typer.Option("--development", help="The scene was written with it.")] = False,
    unit_um: Annotated[float, typer.Option(help="Length of one unit of the file, um: 0.001 for nm.")] = 1.0,
    pixel_size_um: Annotated[
        float | None, typer.Option(help="Of a height map on a grid of its own that states none.")
    ] = None,
    missing: Annotated[float | None, typer.Option(help="Number that stands for no height, beside NaN.")] = None,
    frame: Annotated[
        str, typer.Option(help="world: z to the gun; camera: y down, z into the specimen; unknown: either side up.")
    ] = "unknown",
    align: Annotated[
        str, typer.Option(help="none, offset, plane, rigid, similarity; rigid unless it stands on the pixels.")
    ] = "",
    gauge: Annotated[
        str, typer.Option(help="Of a height map on the pixels: any of offset,plane,scale,mirror; offset.")
    ] = "",
    mirror: Annotated[bool, typer.Option("--mirror", help="Allow an alignment to turn it inside out.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for score.json, score.md and error.tif.")] = None,
    cache: Annotated[Path, typer.Option(help="Folder where rendered surfaces are kept.")] = Path("results/run/cache"),
) -> None:
    """Judge a surface that any software made from the pictures of a scene; see `scene` for those pictures."""
    with one_sentence():
        from benchmarks.judging.submission import Options
        from benchmarks.judging.submitted import score_submission
        from benchmarks.reporting.scored import FILES, write_scored
        from semrecon.errors import InputError
        from semrecon.folder import check_target

        if not surface.exists():
            raise InputError(f"{surface} does not exist; give a PLY, STL, OBJ, XYZ or TIFF file, or a reconstruction")
        options = Options(unit_um, pixel_size_um, missing, frame, align, tuple(split_names(gauge)), mirror)

        def ours(folder: Path) -> bool:
            return {path.name for path in folder.iterdir()} <= set(FILES)

        if out is not None:
            check_target(out, ours)
        subject = _subject(scene, cache, quick=quick, development=development)
        scored = score_submission(surface, subject, options)
        _show(scored, subject)
        if out is not None:
            write_scored(out, scored, subject, ours)
            typer.echo(f"Scores and the map of the error are in {out}.")


def _subject(scene: str, cache: Path, *, quick: bool, development: bool) -> Subject:
    """Find truth and nominal series: of the suite, or of a folder that was written with its truth."""
    from benchmarks.judging.submission import subject_of
    from benchmarks.suite import chosen, suite
    from semrecon.input.series import read_series
    from semsim.io import read_truth

    if Path(scene).is_dir():
        return subject_of(Path(scene).name, read_truth(scene), read_series(scene))
    every = suite(cache, quick=quick, purpose="development" if development else "reporting")
    (picked,) = chosen(every, [scene])
    return subject_of(scene, picked.source.truth(), picked.series(0))


def _show(scored: Scored, subject: Subject) -> None:
    from rich.console import Console
    from rich.table import Table

    from benchmarks.reporting.scored import rows, words

    for line in words(scored, subject):
        typer.echo(line)
    head, *rest = rows(scored)
    table = Table(*head, title=f"{scored.name} against the truth of {subject.name}")
    for row in rest:
        table.add_row(*row)
    Console().print(table)
    for note in scored.notes:
        typer.echo(f"note: {note}")
