"""`semrecon predict`: which method best predicts a view that it was not given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from semrecon import DEFAULT_METHOD
from semrecon.commands.reconstruct import (
    Crop,
    FlipTilt,
    Inputs,
    PixelSize,
    Seed,
    TiltAxis,
    Tilts,
    WorkingDistance,
    angles_in,
    positive_um,
)
from semrecon.console import one_sentence, progress, warn
from semrecon.errors import InputError, MethodError

if TYPE_CHECKING:
    from semrecon.data import TiltSeries
    from semrecon.methods.base import Method

FREE = ("shift", "similarity")
Methods = Annotated[str, typer.Option(help="Names of methods with commas between; `semrecon methods` lists them.")]
LeaveOut = Annotated[
    str, typer.Option(help="Views to leave out, one at a time: names or numbers from 0 with commas between, or all.")
]
Fit = Annotated[
    str,
    typer.Option(
        help="What is fitted to the view left out in its plane: shift, or similarity (magnification and rotation too)."
    ),
]
Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for all numbers as prediction.json.")]


def predict(
    inputs: Inputs,
    methods: Methods = f"{DEFAULT_METHOD},known_rotation",
    leave_out: LeaveOut = "all",
    fit: Fit = "shift",
    out: Out = None,
    tilts: Tilts = None,
    tilt_axis_deg: TiltAxis = None,
    pixel_size_um: PixelSize = None,
    flip_tilt: FlipTilt = False,
    crop_bottom: Crop = None,
    working_distance_mm: WorkingDistance = None,
    seed: Seed = 0,
) -> None:
    """Judge methods without truth: each predicts the picture of a view left out, from a surface made of the others.

    NCC is the correlation with the true picture, local the median of it within small windows; rms and median are the
    residual in grey levels after slow gain and offset, noise what noise explains of it, rms beyond the rest: over the
    pixels that all methods predict. Columns with "all" are over all that a method predicts.
    """
    with one_sentence():
        from semrecon.agreement.left_out import leave_out as leave
        from semrecon.agreement.left_out import without
        from semrecon.agreement.left_out_camera import Free
        from semrecon.agreement.left_out_report import Row, check_prediction_out, rows_of, table, write_prediction
        from semrecon.input.intake import Stated, take_in

        if fit not in FREE:
            raise InputError(f"--fit knows {' and '.join(FREE)}, not {fit!r}")
        free = cast(Free, fit)
        chosen = _methods(methods)
        if out is not None:
            check_prediction_out(out)
        with progress() as tell:
            tell("reading images")
            distance_um = None if working_distance_mm is None else positive_um(working_distance_mm)
            stated = Stated(angles_in(tilts), pixel_size_um, tilt_axis_deg, flip_tilt, crop_bottom, distance_um)
            intake = take_in(inputs, stated)
            series, rows = intake.series, list[Row]()
            views = _views(leave_out, series)
            without(series, views[0])
            for view in views:
                found = leave(series, view, chosen, free=free, seed=seed, axis_stated=intake.axis_stated, progress=tell)
                rows += rows_of(series.views[view].name, series.views[view].tilt_deg, [m.name for m in chosen], found)
        if all(row.failure for row in rows):
            raise MethodError(f"no method predicts anything; {rows[0].method}: {rows[0].failure}")
        for sentence in intake.warnings:
            warn(sentence)
        typer.echo(table(rows))
        if out is not None:
            typer.echo(f"{write_prediction(rows, free, out)}")


def _methods(names: str) -> list[Method]:
    """Methods by name, each once."""
    from semrecon.methods import method_named

    chosen = [method_named(name.strip()) for name in names.split(",") if name.strip()]
    if not chosen:
        raise InputError("--methods names no method; `semrecon methods` lists them")
    return list({method.name: method for method in chosen}.values())


def _views(text: str, series: TiltSeries) -> Sequence[int]:
    """Find views to leave out by name or number."""
    if text.strip() == "all":
        return range(len(series))
    names = [view.name for view in series.views]
    found = []
    for part in (one.strip() for one in text.split(",")):
        if part not in names and not (part.isdecimal() and int(part) < len(series)):
            raise InputError(
                f"--leave-out knows all, numbers from 0 to {len(series) - 1} and {', '.join(names)}, not {part!r}"
            )
        found.append(names.index(part) if part in names else int(part))
    return list(dict.fromkeys(found))
