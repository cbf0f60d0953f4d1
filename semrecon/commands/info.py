"""`semrecon info`: what files say of themselves before anybody reconstructs from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semrecon.console import one_sentence, warn

if TYPE_CHECKING:
    from rich.table import Table

    from semrecon.data import Image
    from semrecon.input.intake import Facts


def info(
    inputs: Annotated[list[Path], typer.Argument(help="One series folder, or image files.")],
) -> None:
    """Show what images, or a series folder, state of themselves, where it was read, and what looks wrong."""
    with one_sentence():
        from rich.console import Console

        from semrecon.input.doubts import doubts
        from semrecon.input.images import read_image
        from semrecon.input.intake import facts_of

        facts = facts_of(inputs)
        images = [read_image(facts.folder / entry.image) for entry in facts.entries]
        console = Console()
        console = console if console.is_terminal else Console(width=200)
        console.print(_info_table(facts, images))
        for line in _read_from(facts):
            typer.echo(line)
        for sentence in doubts(facts, images):
            warn(sentence)


def _info_table(facts: Facts, images: list[Image]) -> Table:
    """One row an image."""
    from rich.table import Table

    heads = ("image", "size px", "depth", "pixel um", "tilt deg", "axis deg", "WD mm", "stated by", "detector")
    table = Table(*heads, box=None)
    for entry, one, image in zip(facts.entries, facts.stated, images, strict=True):
        wd_mm = None if one.working_distance_um is None else one.working_distance_um / 1000
        numbers = [one.pixel_size_um, one.tilt_deg, one.tilt_axis_deg, wd_mm]
        size, depth = f"{image.shape[1]} x {image.shape[0]}", f"{8 * image.dtype.itemsize} bit"
        shown = ["-" if number is None else f"{number:.5g}" for number in numbers]
        table.add_row(entry.image, size, depth, *shown, one.source or "-", one.detector)
    return table


def _read_from(facts: Facts) -> list[str]:
    """Say once for each kind of file which entry each value was read from."""
    spoken: dict[str, dict[str, str]] = {}
    for one in facts.stated:
        if one.tags:
            spoken.setdefault(one.source, {}).update(one.tags)
    return [
        f"{source}: " + ", ".join(f"{field} from {tag}" for field, tag in tags.items())
        for source, tags in spoken.items()
    ]
