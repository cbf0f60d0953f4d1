"""Rerun recordings of the seed's study: views of the ledger, never the record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.layout import Box, Flat, Part, Space
from benchmarks.recording.rerun_file import Colour, RerunFile, rerun_file
from benchmarks.recording.surfaces import error_colours
from benchmarks.running.ledger import Row
from benchmarks.seed_study.figures import COLOURS, contenders_of
from semrecon.data import Array, SurfaceMesh, TiltSeries
from semrecon.output.glance import block_means, grey_range

METRICS = {"rmse_um": "RMSE after ICP, um", "rre_deg": "RRE, degrees", "depth_median_um": "median depth error, um"}
"""Metrics drawn as series over the runs, and their titles."""
RUN = "run"
HELD_PERCENT = 90
IMAGE_PX = 1280
GREY = (170, 170, 170)


def record_study(path: Path, name: str, series: TiltSeries, rows: Sequence[Row], truth: SurfaceMesh | None) -> None:
    """Write one recording: images, true mesh, clouds and registrations over the runs, metrics as series.

    Parameters
    ----------
    truth
        The photographed mesh in the world frame; None on real micrographs, where clouds are coloured by height.
    """
    with rerun_file(path, f"paper-{name}", _layout(rows, series), RUN) as file:
        if truth is not None:
            file.surface("world/truth", truth.vertices_um, truth.faces, GREY)
        for number, view in enumerate(series.views):
            file.picture(f"images/{number:02d}", _grey8(view.image))
        for metric in METRICS:
            for contender in contenders_of(rows):
                file.series(f"metrics/{metric}/{contender}", contender, _rgb(contender))
        file.text("about", _about(name, rows, truth is not None))
        for row in rows:
            file.at({RUN: row.repetition + 1})
            _log_row(file, row)


def colours_of_errors(errors_um: Array) -> NDArray[np.uint8]:
    """Blue (too low), white (right), red (too high), full at the 90th percentile of |error|: (points, 3) uint8."""
    limit = float(np.nanpercentile(np.abs(errors_um), HELD_PERCENT)) if np.isfinite(errors_um).any() else 0.0
    return error_colours(errors_um, max(limit, 1e-12))


def _log_row(file: RerunFile, row: Row) -> None:
    for metric in METRICS:
        file.number(f"metrics/{metric}/{row.contender}", row.metrics.get(metric, float("nan")))
    for number in range(int(row.metrics.get("clouds", 0))):
        cloud, frame = row.arrays[f"cloud_{number}"], row.arrays[f"frame_{number}"]
        colours = colours_of_errors(row.arrays.get(f"error_{number}", cloud[:, 2] - np.median(cloud[:, 2])))
        aligned = (cloud - [0, 0, row.arrays.get(f"offset_{number}", 0.0)]) @ frame
        file.points(f"world/{row.contender}/cloud_{number}", aligned, colours, 0.4)
    if "merged" in row.arrays:
        merged = (row.arrays["merged"] - [0, 0, row.arrays.get("offset_0", 0.0)]) @ row.arrays.get("frame_0", np.eye(3))
        file.points(f"world/{row.contender}/registered", merged, _rgb(row.contender), 0.3)


def _layout(rows: Sequence[Row], series: TiltSeries) -> Part:
    width_um = series.optics.width_px * series.optics.pixel_size_um
    clouds = [
        Space(f"{name}: error", ("world/truth", f"world/{name}/cloud_0"), width_um)
        for name in contenders_of(rows, "rmse_um")
    ]
    together = tuple(f"world/{name}/registered" for name in contenders_of(rows, "rmse_um"))
    images = [Flat("picture", f"{view.tilt_deg:g}°", f"images/{i:02d}") for i, view in enumerate(series.views)]
    plotted = [metric for metric in METRICS if any(np.isfinite(row.metrics.get(metric, np.nan)) for row in rows)]
    plots = [Flat("series", METRICS[metric], f"metrics/{metric}") for metric in plotted]
    words = Flat("text", "What this shows", "about")
    left = Box("tabs", (*clouds, Space("registered clouds", together, width_um)))
    return Box("across", (left, Box("down", (Box("tabs", (words, *images)), *plots))), (3, 2))


def _about(name: str, rows: Sequence[Row], judged: bool) -> str:
    coloured = (
        "Clouds of the first pair over the grey true mesh, coloured by depth error after one offset is removed: blue "
        "is too low, white is right, red is too high, full at the 90th percentile of each cloud."
        if judged
        else "Clouds of the first pair, coloured by height about the median: the truth is not known."
    )
    runs = len({row.repetition for row in rows})
    return (
        f"## {name}: the seed's study\n\n{coloured} Lengths are µm, angles degrees; the world is the specimen at zero "
        f"tilt, z up toward the gun.\n\nThe timeline `{RUN}` goes through {runs} runs, with new noise in each where "
        "images are simulated.\n"
    )


def _grey8(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    if image.dtype == np.uint8 and image.shape[1] <= IMAGE_PX:
        return np.asarray(image, dtype=np.uint8)
    low, high = grey_range(image)
    grey = block_means(image.astype(np.float64), -(-image.shape[1] // IMAGE_PX))
    return np.asarray(np.clip((grey - low) / (high - low), 0, 1) * 255).round().astype(np.uint8)


def _rgb(contender: str) -> Colour:
    code = COLOURS.get(contender, "#808080").lstrip("#")
    red, green, blue = (int(code[i : i + 2], 16) for i in (0, 2, 4))
    return red, green, blue
