"""The `semsim` command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semsim.errors import InputError

if TYPE_CHECKING:
    from semsim.capture import Capture
    from semsim.microscope import Microscope
    from semsim.scene import Scene
    from semsim.surface import Backend

app = typer.Typer(
    help="Photograph a known mesh the way a scanning electron microscope would, and keep the exact truth.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.command()
def render(
    scene: Annotated[str, typer.Argument(help="A named scene (see `semsim scenes`) or a TOML file.")],
    out: Annotated[Path, typer.Option(help="Folder for the tilt series: new, empty, or an earlier series.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    backend: Annotated[str, typer.Option(help="raycast (exact) or pyrender (OpenGL).")] = "raycast",
    scale: Annotated[float, typer.Option(help="The same field with this many times the columns and rows.")] = 1.0,
) -> None:
    """Render a scene into a tilt-series folder with its truth."""
    from semsim.io import require_free, write_series
    from semsim.scene import load_scene, scaled
    from semsim.surface import BACKENDS

    if backend not in BACKENDS:
        raise InputError(f"--backend must be one of {', '.join(BACKENDS)}, not {backend}")
    require_free(out)
    asked = load_scene(scene)
    capture = _watched(asked if scale == 1 else scaled(asked, scale), seed, backend)  # type: ignore[arg-type]
    write_series(capture, out, seed)
    typer.echo(f"{out}: {len(capture.images)} views, {_size(capture.scene.microscope)}")


@app.command()
def scenes() -> None:
    """List the named scenes."""
    from semsim.scene import NAMED

    for name, (microscope, schedule) in NAMED.items():
        tilts = ", ".join(f"{tilt:g}" for tilt in schedule.tilts_deg)
        typer.echo(f"{name:8} {_size(microscope)}, tilts {tilts} degrees")


@app.command()
def specimens() -> None:
    """List the specimens that a scene file can name."""
    from semsim.specimens import SPECIMENS

    for kind in SPECIMENS:
        typer.echo(f"{kind.name:8} {(kind.__doc__ or '').splitlines()[0]}")


def main() -> None:
    """Run the command; bad input is one sentence on stderr and exit status 2."""
    try:
        app()
    except InputError as error:
        print(f"semsim: {error}", file=sys.stderr)
        sys.exit(2)


def _size(microscope: Microscope) -> str:
    return f"{microscope.width_px} x {microscope.height_px} px of {microscope.pixel_size_um:.4g} um"


def _watched(scene: Scene, seed: int, backend: Backend) -> Capture:
    """Simulate behind a progress bar (on stderr, so that stdout stays clean)."""
    from rich.console import Console
    from rich.progress import Progress

    from semsim.capture import simulate

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(scene.name, total=None)
        return simulate(
            scene,
            seed,
            progress=lambda step, done, total: bar.update(task, description=step, completed=done, total=total),
            backend=backend,
        )
