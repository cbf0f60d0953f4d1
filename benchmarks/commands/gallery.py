"""`python -m benchmarks gallery`: pictures and tables of the page on methods, from the record of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import one_sentence, progress


def gallery(
    run: Annotated[Path, typer.Option(help="Results folder of a finished run.")] = Path("results/run"),
    out: Annotated[Path, typer.Option(help="Folder for the pictures, one a method.")] = Path("docs/img/methods"),
    page: Annotated[
        Path | None, typer.Option(help="Markdown page whose tables are made anew, as docs/methods.md.")
    ] = None,
    front: Annotated[
        Path | None, typer.Option(help="Markdown page whose one table of medians is made anew, as README.md.")
    ] = None,
) -> None:
    """Draw the error maps of every method on every scene of a run, and fill the tables of a page; nothing is rerun."""
    with one_sentence():
        from benchmarks.reporting.error_figures import draw_strip
        from benchmarks.reporting.error_maps import read_run, strips
        from benchmarks.reporting.methods_page import FRONT_BEGIN, FRONT_END, filled_page, leaderboard, medians
        from semrecon.errors import InputError

        record = read_run(run)
        text = "" if page is None else filled_page(_read(page, "--page"), "")
        opening = "" if front is None else filled_page(_read(front, "--front"), "", FRONT_BEGIN, FRONT_END)
        if out.exists() and not out.is_dir():
            raise InputError(f"--out {out} is a file; name a folder for the pictures")
        with progress() as report:
            drawn = strips(record, report)
        for strip in drawn:
            draw_strip(out / f"{strip.method.name}.jpg", strip)
        if page is not None:
            page.write_text(filled_page(text, leaderboard(record, drawn)), encoding="utf-8")
        if front is not None:
            front.write_text(filled_page(opening, medians(record), FRONT_BEGIN, FRONT_END), encoding="utf-8")
    new = "".join(f" The tables of {each} are new." for each in (page, front) if each is not None)
    typer.echo(f"{len(drawn)} pictures are in {out}.{new}")


def _read(page: Path, option: str) -> str:
    from semrecon.errors import InputError

    try:
        return page.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{option} {page} cannot be read ({error.strerror}); name a Markdown page") from error
