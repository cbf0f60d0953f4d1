"""`semrecon compare`: how far two reconstructions of one specimen agree."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semrecon.console import one_sentence, progress


def compare(
    first: Annotated[Path, typer.Argument(help="A reconstruction folder; its grid is the one compared on.")],
    second: Annotated[Path, typer.Argument(help="Another reconstruction of the same specimen.")],
    gauge: Annotated[
        str, typer.Option(help="What may differ without counting: offset, plane, rigid or similarity.")
    ] = "offset",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the difference map and a picture.")
    ] = None,
) -> None:
    """Compare two reconstructions: even with odd views, one method with another, yesterday with today."""
    with one_sentence():
        from semrecon.agreement.comparison import check_comparison_out, write_comparison
        from semrecon.agreement.comparison import compare as run

        if out is not None:
            check_comparison_out(out)
        with progress() as tell:
            tell("comparing")
            comparison = run(first, second, gauge=gauge)
            if out is not None:
                write_comparison(comparison, out)
        typer.echo(str(comparison))
