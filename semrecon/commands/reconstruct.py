"""`semrecon reconstruct`: images in, a surface out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semrecon import DEFAULT_METHOD
from semrecon.console import one_sentence, progress, warn
from semrecon.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from semrecon.input.intake import Intake
    from semrecon.methods.base import Method
    from semrecon.reconstruction import Reconstruction

LATER_STREAM = 2
"""Sets the random choices of later views apart from those of the method."""

Inputs = Annotated[list[Path], typer.Argument(help="One series folder, or image files.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write; new, empty, or a former reconstruction.")]
MethodName = Annotated[str, typer.Option("--method", "-m", help="Name of a method; `semrecon methods` lists them.")]
Tilts = Annotated[
    str | None, typer.Option(help="Stage tilt of every image in degrees, as -9,-6,-3; wins over the files.")
]
TiltAxis = Annotated[
    float | None,
    typer.Option(help="Tilt axis in the image: 0 is up, 90 is right; wins over the files. Unset, the images tell."),
]
PixelSize = Annotated[float | None, typer.Option(help="Edge of a pixel in micrometres; wins over the files.")]
FlipTilt = Annotated[bool, typer.Option("--flip-tilt", help="Count tilts the other way: turns the relief inside out.")]
Crop = Annotated[
    int | None,
    typer.Option(help="Rows to cut off at the bottom of every image; unset, a data bar that is certain; 0 is none."),
]
WorkingDistance = Annotated[
    float | None,
    typer.Option(help="Take perspective into account, for a working distance of so many millimetres; unset, parallel."),
]
Refine = Annotated[
    bool | None,
    typer.Option(help="Adjust tilts, axis, magnification and rotation to the images; unset, as the method has it."),
]
TiltSigma = Annotated[
    float | None, typer.Option(help="How well the stage knows each tilt, degrees (1 sigma), where they are refined.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Option of the method, as refinement.axis_sigma_deg=5. Repeatable.", metavar="NAME=VALUE"
    ),
]
Later = Annotated[
    list[Path] | None,
    typer.Option(help="A further image of unknown orientation, found from the points. Repeatable."),
]
Seed = Annotated[int, typer.Option(help="Seed of the random choices; the same seed gives the same surface.", min=0)]
Rerun = Annotated[bool, typer.Option("--rerun", help="Also write reconstruction.rrd for the rerun viewer.")]
Also = Annotated[str | None, typer.Option(help="Further formats to write, with commas between: stl, xyz, sdf, x3p.")]
Mesh = Annotated[str, typer.Option(help="How to make the mesh: triangles of the reference view, or poisson (smooth).")]


def reconstruct(
    inputs: Inputs,
    out: Out,
    method: MethodName = DEFAULT_METHOD,
    tilts: Tilts = None,
    tilt_axis_deg: TiltAxis = None,
    pixel_size_um: PixelSize = None,
    flip_tilt: FlipTilt = False,
    crop_bottom: Crop = None,
    working_distance_mm: WorkingDistance = None,
    refine: Refine = None,
    tilt_sigma_deg: TiltSigma = None,
    settings: Settings = None,
    later: Later = None,
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
        from semrecon.input.intake import Stated, take_in
        from semrecon.output.export import check_formats, check_out, write_reconstruction
        from semrecon.pipeline import reconstruct as run
        from semrecon.surface.poisson import check_meshing, with_mesh

        check_out(out)
        formats = tuple(part.strip().lower() for part in also.split(",")) if also else ()
        check_formats(formats)
        check_meshing(mesh)
        chosen = _method(method, refine, tilt_sigma_deg, settings or [])
        with progress() as tell:
            tell("reading images")
            distance_um = None if working_distance_mm is None else positive_um(working_distance_mm)
            angles = angles_in(tilts)
            needed = "rotations" in chosen.needs
            stated = Stated(angles, pixel_size_um, tilt_axis_deg, flip_tilt, crop_bottom, distance_um, needed)
            intake = take_in(inputs, stated)
            result = run(
                intake.series,
                chosen,
                seed=seed,
                working_distance_um=intake.working_distance_um,
                axis_stated=intake.axis_stated,
                progress=tell,
            )
            result = _with_later_views(result, later or [], seed, tell)
            tell("mesh")
            result = with_mesh(result, mesh)
            tell("writing")
            result = _with_intake(result, intake)
            files = write_reconstruction(result, out, rerun=rerun, also=formats)
        _say_done(result, out, files)


def _method(name: str, refine: bool | None, tilt_sigma_deg: float | None, settings: list[str]) -> Method:
    """Pick a method and set its options; the two flags stand for options that not every method has."""
    from semrecon.method_options import has_option, parsed_settings, with_settings
    from semrecon.methods import method_named

    method = method_named(name)
    meant: dict[str, str] = {}
    if refine is not None:
        _require(has_option(method, "refinement"), method, "--refine" if refine else "--no-refine")
        meant = _refining(has_option(method, "refine"), refine)
    if tilt_sigma_deg is not None:
        _require(has_option(method, "refinement"), method, "--tilt-sigma-deg")
        if not (math.isfinite(tilt_sigma_deg) and tilt_sigma_deg > 0):
            raise InputError(f"--tilt-sigma-deg must be a positive number of degrees, not {tilt_sigma_deg:g}")
        meant["refinement.tilt_sigma_deg"] = repr(tilt_sigma_deg)
    return with_settings(method, meant | parsed_settings(settings))


def _require(there: bool, method: Method, flag: str) -> None:
    if not there:
        raise InputError(f"method {method.name} refines nothing, so {flag} does not go with it")


def _refining(switch: bool, refine: bool) -> dict[str, str]:
    """Spell out --refine for a method that has a switch for it, or that always refines what is not held."""
    if switch:
        return {"refine": str(refine).lower()}
    return (
        {} if refine else {f"refinement.{part}": "false" for part in ("tilts", "axis", "magnifications", "rotations")}
    )


def _with_later_views(
    result: Reconstruction, paths: list[Path], seed: int, tell: Callable[[str], None]
) -> Reconstruction:
    """Pose further images by the points found, and add the points that they bring."""
    if not paths:
        return result
    import numpy as np

    from semrecon.input.images import read_image
    from semrecon.pose.later_views import pose_later_views, with_later_views

    tell("later views")
    images = [(path.name, read_image(path)) for path in paths]
    return with_later_views(result, pose_later_views(result, images, np.random.default_rng([seed, LATER_STREAM])))


def angles_in(text: str | None) -> tuple[float, ...] | None:
    """Read angles with commas between, deg."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--tilts must be angles in degrees with commas between, as -9,-6,-3, not {text!r}") from None


def positive_um(working_distance_mm: float) -> float:
    """Turn the working distance from mm into um; raises `InputError` unless it is positive."""
    if not (math.isfinite(working_distance_mm) and working_distance_mm > 0):
        raise InputError(f"--working-distance-mm must be a positive number, not {working_distance_mm:g}")
    return 1000 * working_distance_mm


def _with_intake(result: Reconstruction, intake: Intake) -> Reconstruction:
    """Keep in the report who stated the geometry, and what was contradicted."""
    from dataclasses import replace

    return replace(result, sources=intake.sources, warnings=(*intake.warnings, *result.warnings))


def _say_done(result: Reconstruction, out: Path, files: tuple[Path, ...]) -> None:
    for sentence in result.warnings:
        warn(sentence)
    sigma = result.median_sigma_um
    typer.echo(f"{out}: {', '.join(path.name for path in files)}")
    typer.echo(
        f"{len(result.points)} points, heights on {result.completeness:.1%} of the image, "
        f"median sigma {'not stated' if math.isnan(sigma) else f'{sigma:.3g} um'}; open summary.png first"
    )
