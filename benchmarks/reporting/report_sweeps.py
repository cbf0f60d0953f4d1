"""Sections of the report on sweeps: error against what was varied, with the bound and the predicted response."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reporting.report_figures import BOUND, Figure, curve_with_band, numbers, share_axis, theory_curve
from benchmarks.sweeping.sweep_axes import AXES, Axis
from benchmarks.sweeping.sweep_summary import interval
from semrecon.data import Array
from semrecon.errors import InputError

TABLE, PAGE = "sweep.csv", "sweep.md"
ERROR = {"title": {"text": "median absolute depth error (µm)"}, "exponentformat": "none"}


@dataclass(frozen=True)
class SweepRows:
    """A sweep as its CSV has it: names of what was varied, and a mapping a row."""

    axes: tuple[str, ...]
    rows: tuple[dict[str, str], ...]

    @property
    def methods(self) -> list[str]:
        """Methods in the order in which they come."""
        return list(dict.fromkeys(row["method"] for row in self.rows))

    def values(self, axis: str) -> list[float]:
        """Values on an axis, rising."""
        return sorted({float(row[axis]) for row in self.rows})


@dataclass(frozen=True)
class SweepSection:
    """A sweep: title, plots with their captions, and a sentence for each failure."""

    title: str
    figures: tuple[tuple[str, Figure], ...]
    failures: tuple[str, ...]


def sweep_section(folder: Path) -> SweepSection:
    """Make the section of a sweep from its folder; raises `InputError` where that holds none."""
    found = read_rows(folder / TABLE)
    figures = _curves(found) if len(found.axes) == 1 else _maps(found)
    return SweepSection(_title(folder, found), tuple(figures), tuple(_failures(found)))


def read_rows(path: Path) -> SweepRows:
    """Read the table of a sweep; the columns before `method` are what was varied."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows, names = tuple(reader), list(reader.fieldnames or ())
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"--sweep {path.parent} is no folder of a sweep: {path.name} cannot be read there") from error
    axes = tuple(names[: names.index("method")]) if "method" in names else ()
    if not 1 <= len(axes) <= 2 or "median_um" not in names or not rows:
        raise InputError(f"{path} is no table of a sweep: it has no column method after one or two that were varied")
    return SweepRows(axes, rows)


def _title(folder: Path, found: SweepRows) -> str:
    page = folder / PAGE
    first = page.read_text(encoding="utf-8").partition("\n")[0] if page.is_file() else ""
    return first.removeprefix("#").strip() or f"Sweep of {' and '.join(found.axes)}"


def _curves(found: SweepRows) -> list[tuple[str, Figure]]:
    (name,) = found.axes
    axis = _axis(name)
    x = np.array(found.values(name))
    logarithmic = axis is not None and axis.logarithmic and bool(np.all(x > 0))
    across = {"title": {"text": axis.label if axis else name}, "type": "log" if logarithmic else "linear"}
    across["exponentformat"] = "none"
    error = _means(found, x, "median_um")
    error += [
        theory_curve(said, dash, x, _theory(found, x, column))
        for said, dash, column in ((BOUND, "dash", "bound_um"), ("predicted", "dot", "predicted_um"))
    ]
    caption = "Mean over the repetitions; bars are 95 % bootstrap intervals of it. Grey: what theory expects."
    answer = [(caption, {"data": error, "layout": {"xaxis": across, "yaxis": {**ERROR, "type": "log"}}})]
    complete = _means(found, x, "completeness")
    shares: Figure = {"data": complete, "layout": {"xaxis": across, "yaxis": share_axis("completeness")}}
    return [*answer, ("Share of the commonly visible surface that has a height.", shares)]


def _means(found: SweepRows, x: Array, metric: str) -> list[dict[str, Any]]:
    answer = []
    for number, method in enumerate(found.methods):
        values = [_known(found, {found.axes[0]: each, "method": method}, metric) for each in x]
        mean = np.array([np.mean(each) if each.size else np.nan for each in values])
        low, high = np.array([interval(each) for each in values]).T
        answer += curve_with_band(method, number, x, mean, low, high)
    return answer


def _theory(found: SweepRows, x: Array, column: str) -> Array:
    values = [_known(found, {found.axes[0]: each}, column) for each in x]
    return np.array([each[0] if each.size else np.nan for each in values])


def _maps(found: SweepRows) -> list[tuple[str, Figure]]:
    """Draw the bound and each method over both axes, all in the same colours."""
    down, across = found.axes
    y, x = (found.values(name) for name in found.axes)
    places = [[{down: b, across: a} for a in x] for b in y]
    every = {BOUND: _grid(found, places, {}, "bound_um")}
    every |= {method: _grid(found, places, {"method": method}, "median_um") for method in found.methods}
    known = np.concatenate([grid[np.isfinite(grid)] for grid in every.values()])
    ends = {"zmin": float(known.min()), "zmax": float(known.max())} if known.size else {}
    labels = [axis.label if axis else name for axis, name in ((_axis(name), name) for name in found.axes)]
    layout = {"yaxis": _categories(labels[0]), "xaxis": _categories(labels[1])}
    answer = []
    for name, grid in every.items():
        if np.isfinite(grid).any():
            figure: Figure = {"data": [{**_heatmap(x, y, grid), **ends}], "layout": layout}
            answer.append((f"{name}: median absolute depth error, µm.", figure))
    return answer


def _grid(found: SweepRows, places: list[list[dict[str, float]]], also: dict[str, str], column: str) -> Array:
    cells = [[_known(found, {**place, **also}, column) for place in row] for row in places]
    return np.array([[np.mean(each) if each.size else np.nan for each in row] for row in cells])


def _heatmap(x: Sequence[float], y: Sequence[float], grid: Array) -> dict[str, Any]:
    return {
        "type": "heatmap",
        "x": [f"{value:g}" for value in x],
        "y": [f"{value:g}" for value in y],
        "z": [numbers(row) for row in grid],
        "text": [["" if np.isnan(value) else f"{value:.3g}" for value in row] for row in grid],
        "texttemplate": "%{text}",
        "colorscale": "Viridis",
        "reversescale": True,
        "colorbar": {"title": {"text": "µm"}, "thickness": 12},
    }


def _categories(label: str) -> dict[str, Any]:
    return {"title": {"text": label}, "type": "category"}


def _axis(name: str) -> Axis | None:
    return next((axis for axis in AXES if axis.name == name), None)


def _known(found: SweepRows, wanted: dict[str, Any], column: str) -> Array:
    """Finite numbers of a column in the rows that match."""
    texts = [row.get(column, "") for row in found.rows if all(_same(row[key], value) for key, value in wanted.items())]
    values = np.array([float(text) for text in texts if text], dtype=np.float64)
    return values[np.isfinite(values)]


def _same(text: str, value: Any) -> bool:
    return text == value if isinstance(value, str) else float(text) == value


def _failures(found: SweepRows) -> list[str]:
    counts: dict[tuple[str, str], int] = {}
    for row in found.rows:
        if row.get("failure"):
            counts[row["method"], row["failure"]] = counts.get((row["method"], row["failure"]), 0) + 1
    cases = _cases_by_method(found.rows)
    return [f"{method}, {count} of {cases[method]} cases: {said}" for (method, said), count in counts.items()]


def _cases_by_method(rows: Sequence[dict[str, str]]) -> dict[str, int]:
    return {method: sum(row["method"] == method for row in rows) for method in {row["method"] for row in rows}}
