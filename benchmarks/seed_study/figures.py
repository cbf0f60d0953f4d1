"""Figures drawn from ledger rows: counterparts of the seed's Figs. 7 to 12, and the depth errors beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.running.ledger import Row
from semrecon.data import Array, Image, SurfaceMesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {
    "proposed": "#1f6fb4",
    "disparity_printed": "#d1495b",
    "disparity_symmetric": "#edae49",
    "disparity_boyde": "#3c8d5a",
    "known_rotation_all_views": "#6a4c93",
}
"""One colour a contender, in every figure and recording."""
DASHES = {"disparity_symmetric": (0, (6, 4)), "disparity_boyde": (3, (2, 4))}
"""Curves that lie on each other all show through."""


def draw_reconstruction(path: Path, image: Image, points_um: Array, mesh: SurfaceMesh, title: str) -> None:
    """Draw image, point cloud and surface mesh side by side (Figs. 7 and 8)."""
    figure = _figure(15.0, 4.6)
    left = figure.add_subplot(1, 3, 1)
    middle: Any = figure.add_subplot(1, 3, 2, projection="3d")
    right: Any = figure.add_subplot(1, 3, 3, projection="3d")
    left.imshow(image, cmap="gray")
    left.set_axis_off()
    left.set_title("(A) SEM image, first view")
    limits = np.percentile(points_um[:, 2], [1, 99])
    cloud = middle.scatter(*points_um.T, c=points_um[:, 2], s=4, vmin=limits[0], vmax=limits[1], linewidths=0)
    figure.colorbar(cloud, ax=middle, shrink=0.6, pad=0.12, label="z (um)")
    middle.set_title(f"(B) point cloud, {len(points_um)} points")
    x, y, z = mesh.vertices_um.T
    right.plot_trisurf(x, y, z, triangles=mesh.faces, cmap="viridis", linewidth=0, vmin=limits[0], vmax=limits[1])
    right.set_title(f"(C) surface mesh, {len(mesh.faces)} triangles")
    for axes in (middle, right):
        _frame_3d(axes, points_um, limits)
    figure.suptitle(title, x=0.01, ha="left")
    _save(figure, path)


def draw_runs(path: Path, rows: Sequence[Row], title: str) -> None:
    """Draw RMSE and RRE of every run, a curve a contender (Figs. 9 and 10), with the true depth error where known."""
    from matplotlib.ticker import MaxNLocator

    panels = _panels(rows)
    figure = _figure(5.0 * len(panels), 4.2)
    for number, (metric, label) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, len(panels), number)
        for contender in contenders_of(rows, metric):
            runs, values = series_of(rows, contender, metric)
            style = DASHES.get(contender, "-")
            axes.plot(runs + 1, values, ".", linestyle=style, color=COLOURS.get(contender), label=contender)
        axes.set(xlabel="run", ylabel=label)
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    handles = {
        text: handle for axes in figure.axes for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), fontsize=8)
    figure.suptitle(title)
    _save(figure, path)


def draw_means(path: Path, rows_by_scene: Mapping[str, Sequence[Row]], metric: str, label: str) -> None:
    """Draw the mean of a metric over the runs and its standard deviation, by scene and contender (Figs. 11 and 12).

    Nothing is drawn where no contender has a value.
    """
    contenders = contenders_of([row for rows in rows_by_scene.values() for row in rows], metric)
    if not contenders:
        return
    figure = _figure(1.5 + 3.2 * len(rows_by_scene), 4.0)
    axes = figure.add_subplot()
    width = 0.8 / len(contenders)
    for number, contender in enumerate(contenders):
        values = [series_of(rows, contender, metric)[1] for rows in rows_by_scene.values()]
        means = [_mean(v) for v in values]
        spreads = [float(np.std(v, ddof=1)) if len(v) > 1 else 0.0 for v in values]
        places = np.arange(len(values)) + (number - (len(contenders) - 1) / 2) * width
        bars = axes.bar(places, means, width, yerr=spreads, capsize=3, color=COLOURS.get(contender), label=contender)
        axes.bar_label(bars, fmt="%.3g", fontsize=7, padding=2)
    axes.set_xticks(range(len(rows_by_scene)), list(rows_by_scene))
    axes.set_ylabel(label)
    axes.margins(y=0.15)
    axes.legend(fontsize=8)
    _save(figure, path)


def draw_depth_error(path: Path, image: Image, clouds: Mapping[str, tuple[Array, Array]], title: str) -> None:
    """Draw the depth error against truth at every point, one panel a contender, on the first view.

    Parameters
    ----------
    clouds
        By contender: pixel positions (points, 2) and signed depth errors in um (points,).
    """
    finite = np.abs(np.concatenate([errors[np.isfinite(errors)] for _, errors in clouds.values()]))
    limit = float(np.percentile(finite, 90)) if len(finite) else 1.0
    figure = _figure(4.2 * len(clouds), 3.4)
    for number, (contender, (xy_px, errors)) in enumerate(clouds.items(), start=1):
        axes = figure.add_subplot(1, len(clouds), number)
        axes.imshow(image, cmap="gray", alpha=0.5)
        dots = axes.scatter(
            xy_px[:, 0], xy_px[:, 1], c=errors, s=4, cmap="coolwarm", vmin=-limit, vmax=limit, linewidths=0
        )
        axes.set_title(f"{contender}\nmedian |error| {np.nanmedian(np.abs(errors)):.2f} um", fontsize=9)
        axes.set_axis_off()
        figure.colorbar(dots, ax=axes, shrink=0.7, label="depth error (um)")
    figure.suptitle(title)
    _save(figure, path)


def contenders_of(rows: Sequence[Row], metric: str | None = None) -> list[str]:
    """Names of the contenders that have a value of the metric (of any), in the order of their first row."""
    return list(dict.fromkeys(row.contender for row in rows if metric is None or metric in row.metrics))


def series_of(rows: Sequence[Row], contender: str, metric: str) -> tuple[NDArray[np.int64], Array]:
    """Repetitions and finite values of a metric of one contender; a failure has no value and is left out."""
    found = [
        (row.repetition, row.metrics[metric]) for row in rows if row.contender == contender and metric in row.metrics
    ]
    finite = [(repetition, value) for repetition, value in found if np.isfinite(value)]
    return np.array([r for r, _ in finite], dtype=np.int64), np.array([v for _, v in finite], dtype=np.float64)


def _panels(rows: Sequence[Row]) -> dict[str, str]:
    panels = {"rmse_um": "RMSE after ICP (um)", "rre_deg": "RRE (degrees)"}
    if any(np.isfinite(row.metrics.get("depth_median_um", np.nan)) for row in rows):
        panels["depth_median_um"] = "median depth error against truth (um)"
    return panels


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _frame_3d(axes: Any, points_um: Array, z_limits: Array) -> None:
    from matplotlib.ticker import MaxNLocator

    low, high = np.percentile(points_um, 0.5, axis=0), np.percentile(points_um, 99.5, axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=tuple(z_limits))
    axes.set_box_aspect(np.maximum(high - low, 1e-6))
    axes.set(xlabel="x (um)", ylabel="y (um)", zlabel="z (um)")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5 if axis is not axes.zaxis else 3))
    axes.view_init(elev=50, azim=-75)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
