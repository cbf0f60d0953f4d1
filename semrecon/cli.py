"""The `semrecon` command. Everything slow is imported inside the command that needs it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semrecon import DEFAULT_METHOD
from semrecon.errors import InputError, MethodError

if TYPE_CHECKING:
    from rich.table import Table

    from semrecon.data import Image
    from semrecon.intake import Facts, Intake
    from semrecon.reconstruction import Reconstruction

BAD_INPUT = 2
"""Exit status for what the user can put right."""

app = typer.Typer(
    name="semrecon",
    help="Reconstruct a surface from tilted SEM micrographs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Inputs = Annotated[list[Path], typer.Argument(help="One series folder, or two or more image files.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write; new, empty, or a former reconstruction.")]
MethodName = Annotated[str, typer.Option("--method", "-m", help="Name of a method; `semrecon methods` lists them.")]
Tilts = Annotated[
    str | None, typer.Option(help="Stage tilt of every image in degrees, as -9,-6,-3; wins over the files.")
]
TiltAxis = Annotated[
    float | None, typer.Option(help="Tilt axis in the image: 0 is up (default), 90 is right; wins over the files.")
]
PixelSize = Annotated[float | None, typer.Option(help="Edge of a pixel in micrometres; wins over the files.")]
FlipTilt = Annotated[bool, typer.Option("--flip-tilt", help="Count tilts the other way: turns the relief inside out.")]
Crop = Annotated[
    int | None,
    typer.Option(help="Rows to cut off at the bottom of every image; unset, a data bar that is certain; 0 is none."),
]
Seed = Annotated[int, typer.Option(help="Seed of the random choices; the same seed gives the same surface.", min=0)]
Rerun = Annotated[bool, typer.Option("--rerun", help="Also write reconstruction.rrd for the rerun viewer.")]
Also = Annotated[str | None, typer.Option(help="Further formats to write, with commas between: stl, xyz, sdf, x3p.")]
Mesh = Annotated[str, typer.Option(help="How to make the mesh: triangles of the reference view, or poisson (smooth).")]


@app.command()
def reconstruct(
    inputs: Inputs,
    out: Out,
    method: MethodName = DEFAULT_METHOD,
    tilts: Tilts = None,
    tilt_axis_deg: TiltAxis = None,
    pixel_size_um: PixelSize = None,
    flip_tilt: FlipTilt = False,
    crop_bottom: Crop = None,
    seed: Seed = 0,
    rerun: Rerun = False,
    also: Also = None,
    mesh: Mesh = "triangles",
) -> None:
    """Reconstruct a height map, a point cloud and a mesh.

    Tilts and pixel size come from series.toml in a folder, from the metadata of the images where their microscope wrote
    them, and from the options, which win.
    """
    with one_sentence():
        from semrecon.export import check_formats, check_out, write_reconstruction
        from semrecon.intake import Stated, take_in
        from semrecon.methods import method_named
        from semrecon.pipeline import reconstruct as run
        from semrecon.poisson import check_meshing, with_mesh

        check_out(out)
        formats = tuple(part.strip().lower() for part in also.split(",")) if also else ()
        check_formats(formats)
        check_meshing(mesh)
        chosen = method_named(method)
        with progress() as tell:
            tell("reading images")
            stated = Stated(_angles(tilts), pixel_size_um, tilt_axis_deg, flip_tilt, crop_bottom)
            intake = take_in(inputs, stated)
            result = run(
                intake.series, chosen, seed=seed, working_distance_um=intake.working_distance_um, progress=tell
            )
            tell("mesh")
            result = with_mesh(result, mesh)
            tell("writing")
            result = _with_intake(result, intake)
            files = write_reconstruction(result, out, rerun=rerun, also=formats)
        _say_done(result, out, files)


@app.command()
def info(inputs: Inputs) -> None:
    """Show what images, or a series folder, state of themselves, where it was read, and what looks wrong."""
    with one_sentence():
        from rich.console import Console

        from semrecon.doubts import doubts
        from semrecon.images import read_image
        from semrecon.intake import facts_of

        facts = facts_of(inputs)
        images = [read_image(facts.folder / entry.image) for entry in facts.entries]
        console = Console()
        console = console if console.is_terminal else Console(width=200)
        console.print(_info_table(facts, images))
        for line in _read_from(facts):
            typer.echo(line)
        for sentence in doubts(facts, images):
            typer.echo(f"warning: {sentence}", err=True)


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


@app.command()
def methods() -> None:
    """List the methods, with what they need and where they were published."""
    from semrecon.methods import METHODS

    for method in METHODS:
        least, most = method.views
        views = f"{least} or more" if most is None else str(least) if most == least else f"{least} to {most}"
        typer.echo(f"{method.name}\n  views: {views}\n  needs: {', '.join(method.needs)}\n  {method.citation}")


@contextlib.contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the user can put right into one sentence on stderr and exit status 2."""
    try:
        yield
    except (InputError, MethodError) as error:
        _fail(str(error))
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{error.filename}: {error.strerror}")


def _fail(sentence: str) -> None:
    typer.echo(f"semrecon: {' '.join(sentence.split())}", err=True)
    raise typer.Exit(BAD_INPUT) from None


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Show the stage and the time it has taken on a terminal's stderr; elsewhere stay silent."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda stage: bar.update(task, description=stage)


def _angles(text: str | None) -> tuple[float, ...] | None:
    """Comma-separated angles."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--tilts must be angles in degrees with commas between, as -9,-6,-3, not {text!r}") from None


def _with_intake(result: Reconstruction, intake: Intake) -> Reconstruction:
    """Keep in the report who stated the geometry, and what was contradicted."""
    from dataclasses import replace

    return replace(result, sources=intake.sources, warnings=(*intake.warnings, *result.warnings))


def _say_done(result: Reconstruction, out: Path, files: tuple[Path, ...]) -> None:
    for sentence in result.warnings:
        typer.echo(f"warning: {sentence}", err=True)
    sigma = result.median_sigma_um
    typer.echo(f"{out}: {', '.join(path.name for path in files)}")
    typer.echo(
        f"{len(result.points)} points, heights on {result.completeness:.1%} of the image, "
        f"median sigma {'not stated' if math.isnan(sigma) else f'{sigma:.3g} um'}; open summary.png first"
    )


def main() -> None:
    """Run the command line."""
    app()
