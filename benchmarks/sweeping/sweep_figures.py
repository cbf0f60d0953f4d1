"""Figures of sweeps and plans: error against what was varied, with the predicted response and the bound drawn in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.sweeping.sweep_summary import MEASURED, Curve, curves
from benchmarks.sweeping.sweeps import Swept
from semrecon.data import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from benchmarks.sweeping.planner import Candidate, Checked, Planned

COLOURS = ("#1f6fb4", "#d1495b", "#3c8d5a", "#edae49", "#6a4c93", "#00798c", "#a0522d", "#7f7f7f")
MARKERS = "osD^vPX*"
REACHED, MISSED = "\u2605", "\u2715"
"""Marks of what was simulated in the map of a plan."""


def draw_sweep(path: Path, swept: Swept) -> None:
    """Draw curves for one axis, maps for two; the ending of `path` says the format."""
    figure = _curves_figure(swept) if len(swept.sweep.axes) == 1 else _maps_figure(swept)
    figure.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)


def draw_plan(path: Path, planned: Planned, title: str) -> None:
    """Draw the expected error over tilt range and dose, a panel a number of views, with what simulation says of it.

    Where the model expects the target to be met, a frame is drawn; a star is a candidate that met it in simulation, a
    cross one that did not.
    """
    from matplotlib.colors import LogNorm

    candidates = planned.candidates
    counts = sorted({each.views for each in candidates})
    figure = _figure(3.6 * len(counts) + 1.0, 3.8)
    errors = [each.expected_um for each in candidates if np.isfinite(each.expected_um)]
    norm = LogNorm(min(errors), max(*errors, 1.001 * min(errors)))
    panels: list[Axes] = []
    for number, count in enumerate(counts, start=1):
        axes = figure.add_subplot(1, len(counts), number)
        drawn = _plan_panel(axes, [each for each in candidates if each.views == count], planned, norm)
        axes.set_title(f"{count} views")
        panels.append(axes)
    bar = figure.colorbar(drawn, ax=panels, label="median depth error by the model (um)", format="{x:g}")
    bar.ax.yaxis.set_minor_formatter("{x:g}")
    said = (
        f"framed: the model expects {planned.target_um:g} um or less; simulated: {REACHED} reached it, {MISSED} did not"
    )
    figure.suptitle(f"{title}\n{said}", fontsize=10)
    figure.savefig(path, dpi=150)


def _plan_panel(axes: Axes, candidates: Sequence[Candidate], planned: Planned, norm: Any) -> Any:
    from matplotlib.patches import Rectangle

    ranges = sorted({each.range_deg for each in candidates})
    doses = sorted({each.dose_e for each in candidates})
    by_place = {(each.dose_e, each.range_deg): each.expected_um for each in candidates}
    grid = np.array([[by_place[dose, spread] for spread in ranges] for dose in doses])
    drawn = axes.imshow(grid, norm=norm, cmap="viridis_r", origin="lower", aspect="auto")
    _name_cells(axes, ranges, doses, grid)
    for row, column in np.argwhere(grid <= planned.target_um):
        frame = (column - 0.46, row - 0.46)
        axes.add_patch(Rectangle(frame, 0.92, 0.92, fill=False, edgecolor="#d1495b", linewidth=2))
    for each in (one for one in planned.checked if one.candidate in candidates):
        place = ranges.index(each.candidate.range_deg), doses.index(each.candidate.dose_e)
        style: dict[str, Any] = {"backgroundcolor": "#ffffffb0", "fontsize": 7, "ha": "center", "va": "center"}
        axes.annotate(_simulated(each, planned.target_um), place, (0, 15), textcoords="offset points", **style)
    axes.set(xlabel="range of tilts (deg)", ylabel="dose (electrons a pixel and view)")
    return drawn


def _simulated(each: Checked, target_um: float) -> str:
    number = f"{each.simulated_um:.2g}" if np.isfinite(each.simulated_um) else "failed"
    return f"{REACHED if each.simulated_um <= target_um else MISSED} {number}"


def _curves_figure(swept: Swept) -> Figure:
    axis = swept.sweep.axes[0]
    x = np.array([point.values[0] for point in swept.points])
    figure = _figure(11.0, 4.4)
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    _theory_lines(left, x, swept)
    for axes, metric in ((left, MEASURED), (right, "completeness")):
        for number, curve in enumerate(curves(swept, metric)):
            _draw_curve(axes, x, curve, number)
        axes.set_xlabel(axis.label)
        axes.set_xscale("log" if axis.logarithmic else "linear")
        axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    left.set(ylabel="median absolute depth error (um)", yscale="log")
    left.yaxis.set_major_formatter("{x:g}")
    right.set(ylabel="completeness", ylim=(0, 1.03))
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)), fontsize=8)
    figure.suptitle(f"{swept.sweep.base.name} (repetitions: {swept.sweep.repetitions}; bars are 95 % intervals)")
    return figure


def _theory_lines(axes: Axes, x: Array, swept: Swept) -> None:
    window, noise = swept.sweep.theory.window_px, swept.sweep.theory.matching_noise_px
    bound = [theory.bound_um for theory in swept.theory]
    expected = [theory.predicted_um for theory in swept.theory]
    axes.plot(x, bound, "k--", label=f"Cramer-Rao bound, window {window:g} px")
    axes.plot(x, expected, ":", color="0.35", label=f"predicted response, {noise:g} px matching noise")


def _draw_curve(axes: Axes, x: Array, curve: Curve, number: int) -> None:
    if not curve.answered:
        return
    spread = np.abs(np.nan_to_num(np.stack([curve.mean - curve.low, curve.high - curve.mean])))
    style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)], "markersize": 5}
    axes.errorbar(x, curve.mean, yerr=spread, capsize=3, label=curve.method, **style)  # type: ignore[arg-type]


def _maps_figure(swept: Swept) -> Figure:
    """One map for the bound, then one a method, all with the same colours."""
    from matplotlib.colors import LogNorm

    down, across = swept.sweep.axes
    shape = len(down.values), len(across.values)
    named = [("Cramer-Rao bound", np.array([theory.bound_um for theory in swept.theory]))]
    named += [(curve.method, curve.mean) for curve in curves(swept) if curve.answered]
    every = np.concatenate([values[np.isfinite(values)] for _, values in named])
    norm = LogNorm(every.min(), max(every.max(), 1.001 * every.min()))
    figure = _figure(3.4 * len(named) + 1.2, 3.8)
    panels: list[Axes] = []
    for number, (name, values) in enumerate(named, start=1):
        axes = figure.add_subplot(1, len(named), number)
        drawn = axes.imshow(values.reshape(shape), norm=norm, cmap="viridis_r", origin="lower", aspect="auto")
        _name_cells(axes, across.values, down.values, values.reshape(shape))
        axes.set(xlabel=across.label, ylabel=down.label)
        axes.set_title(name, fontsize=9)
        panels.append(axes)
    figure.colorbar(drawn, ax=panels, label="median absolute depth error (um)", format="{x:g}")
    figure.suptitle(swept.sweep.base.name)
    return figure


def _name_cells(axes: Axes, across: Sequence[float], down: Sequence[float], values: Array) -> None:
    axes.set_xticks(range(len(across)), [f"{value:g}" for value in across])
    axes.set_yticks(range(len(down)), [f"{value:g}" for value in down])
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            axes.text(column, row, f"{value:.2g}", ha="center", va="center", fontsize=7, backgroundcolor="#ffffffb0")


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
