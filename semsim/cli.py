"""The `semsim` command."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semsim.errors import InputError

if TYPE_CHECKING:
    from semsim.capture import Capture
    from semsim.microscope import Microscope
    from semsim.scene import Scene
    from semsim.surface import Backend

    Report = Callable[[str, int, int], None]

app = typer.Typer(
    help="Photograph a known mesh the way a scanning electron microscope would, and keep the exact truth.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
SceneName = Annotated[str, typer.Argument(help="A named scene (see `semsim scenes`) or a TOML file.")]
BackendName = Annotated[str, typer.Option(help="What finds the surface under each pixel; see docs/simulating.md.")]
Scale = Annotated[float, typer.Option(help="The same field with this many times the columns and rows.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="Change a setting: section.key=value. Repeatable.", metavar="K=V")
]


@app.command()
def render(
    scene: SceneName,
    out: Annotated[Path, typer.Option(help="Folder for the tilt series: new, empty, or an earlier series.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    backend: BackendName = "auto",
    scale: Scale = 1.0,
    settings: Settings = None,
) -> None:
    """Render a scene into a tilt-series folder with its truth."""
    from semsim.io import require_free, write_series

    checked = _backend(backend)
    require_free(out)
    capture = _watched(_asked(scene, settings, scale), seed, checked)
    write_series(capture, out, seed)
    typer.echo(f"{out}: {len(capture.images)} views, {_size(capture.scene.microscope)}")


@app.command()
def show(
    series: Annotated[Path, typer.Argument(help="A tilt-series folder, simulated or real.", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Picture to write (.png, .jpg, .pdf, .svg); else DIR.png.")] = None,
) -> None:
    """Draw a contact sheet of a series: images and, where there is truth, heights and visibility."""
    from semsim.figures import write_contact_sheet

    picture = write_contact_sheet(series, out or series.with_name(f"{series.resolve().name}.png"))
    typer.echo(f"{picture}")


@app.command()
def dataset(
    scenes: Annotated[list[str], typer.Argument(help="Named scenes or TOML files.", metavar="SCENE...")],
    out: Annotated[Path, typer.Option(help="Folder of the training set: new, empty, or one to go on with.")],
    seeds: Annotated[int, typer.Option(help="Series of each scene, every one with a shape and noise of its own.")],
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Draw a setting anew for every series: key=low:high, key=low:high:log or key=a,b,c."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
    backend: BackendName = "auto",
    scale: Scale = 1.0,
    settings: Settings = None,
) -> None:
    """Render a training set: many seeds of many scenes, a folder each. A run that was stopped goes on where it was."""
    from semsim.dataset import plan, render_dataset
    from semsim.variation import variation

    checked = _backend(backend)
    samples = plan(
        [_asked(scene, settings, scale) for scene in scenes], seeds, [variation(text) for text in vary or ()]
    )
    with _progress("training set", len(samples)) as report:
        index = render_dataset(samples, out, workers, checked, report)
    typer.echo(f"{index}: {len(samples)} series")


@app.command("scene")
def print_scene(
    name: SceneName,
    settings: Settings = None,
    scale: Scale = 1.0,
) -> None:
    """Print a scene as a commented TOML to edit: `semsim scene pollen > mine.toml`."""
    from semsim.template import commented_toml

    typer.echo(commented_toml(_asked(name, settings, scale)), nl=False)


@app.command()
def scenes() -> None:
    """List the named scenes."""
    from semsim.scenes import NAMED, geometry

    width = max(map(len, NAMED))
    for name, known in NAMED.items():
        typer.echo(f"{name:{width}}  {known.about}")
        typer.echo(f"{'':{width}}  {geometry(known.microscope, known.schedule)}")


@app.command()
def specimens(
    name: Annotated[str | None, typer.Argument(help="Explain every option of this one, as TOML to edit.")] = None,
) -> None:
    """List the specimens that a scene file can name, with their options; or explain those of one."""
    from textwrap import fill

    from semsim.specimens import SPECIMENS, specimen_from
    from semsim.template import commented_table, inline, options, summary

    if name is not None:
        typer.echo(commented_table(type(specimen_from({"name": name})), "specimen"), nl=False)
        return
    for kind in SPECIMENS:
        typer.echo(f"{kind.name}: {summary(kind)}")
        listed = ", ".join(f"{key}={inline(value)}" for key, value in options(kind).items())
        typer.echo(fill(listed, 110, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False))
    typer.echo("Or instead of a name, file = a mesh (PLY, OBJ, STL, OFF, glTF) or a height map (.npz, .tif).")


@app.command()
def gallery(
    out: Annotated[Path, typer.Argument(help="Folder for gallery.md; the pictures go to img/gallery within it.")],
    width: Annotated[int, typer.Option(min=64, max=4096, help="Columns of a picture.")] = 480,
    scene: Annotated[list[str] | None, typer.Option(help="Only these scenes; else all. Repeatable.")] = None,
) -> None:
    """Render a small picture of every named scene, and a page that shows them."""
    from semsim.gallery import write_gallery

    with _progress("gallery", None) as report:
        page = write_gallery(out, scene, width, report)
    typer.echo(f"{page}")


def main() -> None:
    """Run the command; bad input is one sentence on stderr and exit status 2."""
    try:
        app()
    except InputError as error:
        print(f"semsim: {error}", file=sys.stderr)
        sys.exit(2)


def _backend(name: str) -> Backend:
    from semsim.surface import BACKENDS

    if name not in BACKENDS:
        raise InputError(f"--backend must be one of {', '.join(BACKENDS)}, not {name}")
    return name  # type: ignore[return-value]


def _asked(name: str, settings: list[str] | None, scale: float) -> Scene:
    """Load a scene and change what the options say."""
    from semsim.overrides import assignment, overridden, value_of
    from semsim.scene import scaled
    from semsim.scenes import load_scene

    scene = load_scene(name)
    if settings:
        said = dict(assignment(text) for text in settings)
        scene = overridden(scene, {key: value_of(text) for key, text in said.items()})
    return scene if scale == 1 else scaled(scene, scale)


def _size(microscope: Microscope) -> str:
    return f"{microscope.width_px} x {microscope.height_px} px of {microscope.pixel_size_um:.4g} um"


def _watched(scene: Scene, seed: int, backend: Backend) -> Capture:
    """Simulate behind a progress bar."""
    from semsim.capture import simulate

    with _progress(scene.name, None) as report:
        return simulate(scene, seed, progress=report, backend=backend)


@contextmanager
def _progress(what: str, total: int | None) -> Iterator[Report]:
    """Lend a progress bar with the time left (on stderr, so that stdout stays clean)."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda step, done, steps: bar.update(task, description=step, completed=done, total=steps)
