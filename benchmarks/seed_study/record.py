"""Rerun recordings of a study: views of the ledger, never the record. The only file here that imports rerun."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.running.ledger import Row
from benchmarks.seed_study.figures import COLOURS, contenders_of
from semrecon.data import Array, SurfaceMesh, TiltSeries

if TYPE_CHECKING:
    import rerun as rr

METRICS = {"rmse_um": "RMSE after ICP, um", "rre_deg": "RRE, degrees", "depth_median_um": "median depth error, um"}
"""Metrics drawn as series over the runs, and their titles."""


def record_study(path: Path, name: str, series: TiltSeries, rows: Sequence[Row], truth: SurfaceMesh | None) -> None:
    """Write one recording: images, true mesh, clouds and registrations over the runs, metrics as series.

    Parameters
    ----------
    truth
        The photographed mesh in the world frame; None on real micrographs, where clouds are coloured by height.
    """
    import rerun as rr

    path.parent.mkdir(parents=True, exist_ok=True)
    with rr.RecordingStream("sem-bench", recording_id=f"paper-{name}") as stream:
        stream.save(path, default_blueprint=_blueprint(contenders_of(rows, "rmse_um"), rows, series))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if truth is not None:
            _log_truth(stream, truth)
        _log_images(stream, series)
        _log_styles(stream, contenders_of(rows))
        for row in rows:
            stream.set_time("run", sequence=row.repetition + 1)
            _log_row(stream, row)


def error_colours(errors_um: Array) -> NDArray[np.uint8]:
    """Blue (too low), white (right), red (too high), full at the 90th percentile of |error|: (points, 3) uint8."""
    limit = max(float(np.nanpercentile(np.abs(errors_um), 90)), 1e-12)
    share = np.clip(np.nan_to_num(errors_um / limit), -1, 1)[:, None]
    white, red, blue = np.array([245, 245, 245]), np.array([200, 30, 40]), np.array([40, 70, 200])
    mixed = white + np.abs(share) * (np.where(share > 0, red, blue) - white)
    return np.asarray(mixed.astype(np.uint8))


def _log_truth(stream: rr.RecordingStream, truth: SurfaceMesh) -> None:
    import rerun as rr

    mesh = rr.Mesh3D(
        vertex_positions=truth.vertices_um.astype(np.float32),
        triangle_indices=truth.faces,
        vertex_normals=_vertex_normals(truth).astype(np.float32),
        albedo_factor=[170, 170, 170, 255],
    )
    stream.log("world/truth", mesh, static=True)


def _log_images(stream: rr.RecordingStream, series: TiltSeries) -> None:
    import rerun as rr

    for number, view in enumerate(series.views):
        stream.log(f"images/{number:02d}", rr.Image(_grey8(view.image)).compress(jpeg_quality=90), static=True)


def _log_styles(stream: rr.RecordingStream, contenders: Sequence[str]) -> None:
    import rerun as rr

    for metric in METRICS:
        for name in contenders:
            stream.log(f"metrics/{metric}/{name}", rr.SeriesLines(colors=_rgb(name), names=name, widths=2), static=True)


def _log_row(stream: rr.RecordingStream, row: Row) -> None:
    import rerun as rr

    for metric in METRICS:
        value = row.metrics.get(metric, float("nan"))
        if np.isfinite(value):
            stream.log(f"metrics/{metric}/{row.contender}", rr.Scalars(value))
    for number in range(int(row.metrics.get("clouds", 0))):
        cloud, frame = row.arrays[f"cloud_{number}"], row.arrays[f"frame_{number}"]
        colours = error_colours(row.arrays.get(f"error_{number}", cloud[:, 2] - np.median(cloud[:, 2])))
        aligned = (cloud - [0, 0, row.arrays.get(f"offset_{number}", 0.0)]) @ frame
        stream.log(f"world/{row.contender}/cloud_{number}", rr.Points3D(aligned, colors=colours, radii=0.4))
    if "merged" in row.arrays:
        merged = (row.arrays["merged"] - [0, 0, row.arrays.get("offset_0", 0.0)]) @ row.arrays.get("frame_0", np.eye(3))
        stream.log(f"world/{row.contender}/registered", rr.Points3D(merged, colors=_rgb(row.contender), radii=0.3))


def _blueprint(contenders: Sequence[str], rows: Sequence[Row], series: TiltSeries) -> Any:
    import rerun.blueprint as rrb

    eye = _eye(series)
    clouds = [
        rrb.Spatial3DView(
            origin="world", contents=["world/truth", f"world/{name}/cloud_0"], name=f"{name}: error", eye_controls=eye
        )
        for name in contenders
    ]
    together = [f"world/{name}/registered" for name in contenders]
    registered = rrb.Spatial3DView(origin="world", contents=together, name="registered clouds", eye_controls=eye)
    images = [
        rrb.Spatial2DView(origin=f"images/{number:02d}", name=f"{view.tilt_deg:g}°")
        for number, view in enumerate(series.views)
    ]
    plotted = [metric for metric in METRICS if any(np.isfinite(row.metrics.get(metric, np.nan)) for row in rows)]
    plots = [rrb.TimeSeriesView(origin=f"metrics/{metric}", name=METRICS[metric]) for metric in plotted]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*clouds, registered),
            rrb.Vertical(rrb.Tabs(*images, name="micrographs"), *plots),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="run", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _eye(series: TiltSeries) -> Any:
    """Look down at the field of view from the front, from as far away as it is wide."""
    import rerun.blueprint as rrb

    width_um = series.optics.width_px * series.optics.pixel_size_um
    return rrb.EyeControls3D(position=(0.0, -0.7 * width_um, 0.9 * width_um), look_target=(0.0, 0.0, 0.0))


def _vertex_normals(mesh: SurfaceMesh) -> Array:
    corners = mesh.vertices_um[mesh.faces]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices_um)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], weighted)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def _grey8(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return np.asarray(image)
    low, high = np.percentile(image, [0.1, 99.9])
    return np.asarray(np.clip((image - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8))


def _rgb(contender: str) -> list[int]:
    colour = COLOURS.get(contender, "#808080").lstrip("#")
    return [int(colour[i : i + 2], 16) for i in (0, 2, 4)]
