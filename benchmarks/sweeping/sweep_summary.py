"""A sweep in numbers and words: means with bootstrap intervals, a CSV, and a page that says what is seen."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.sweeping.sweeps import Swept
from semrecon.data import Array

RESAMPLES = 2000
METRICS = ("median_um", "points_median_um", "rms_um", "completeness")
MEASURED = "median_um"


@dataclass(frozen=True)
class Curve:
    """A method's metric at each point: mean over the repetitions and a 95 % interval of it, (points,) each.

    Parameters
    ----------
    values
        (points, repetitions); NaN where the method failed.
    """

    method: str
    values: Array
    mean: Array
    low: Array
    high: Array

    @property
    def answered(self) -> int:
        """Number of cases with an answer."""
        return int(np.isfinite(self.values).sum())


def curves(swept: Swept, metric: str = MEASURED) -> tuple[Curve, ...]:
    """Make a curve a method; all are resampled alike, as the repetitions are paired."""
    return tuple(_curve(swept, method.name, metric) for method in swept.sweep.methods)


def interval(values: Array, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean of some repetitions by bootstrap; NaN for fewer than two that are finite."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return np.nan, np.nan
    drawn = np.random.default_rng(seed).integers(len(known), size=(RESAMPLES, len(known)))
    low, high = np.percentile(known[drawn].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def slope(x: Array, y: Array) -> float:
    """Exponent of the power law through positive numbers; NaN where there are fewer than two."""
    good = np.isfinite(x) & np.isfinite(y) & (x > 0) & (y > 0)
    if good.sum() < 2 or np.ptp(x[good]) == 0:
        return float("nan")
    return float(np.polyfit(np.log(x[good]), np.log(y[good]), 1)[0])


def write_sweep_csv(path: Path, swept: Swept) -> None:
    """Write a row for each point, method and repetition, with theory beside it."""
    names = [axis.name for axis in swept.sweep.axes]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            [*names, "method", "repetition", *METRICS, "seconds", "failure", "bound_um", "predicted_um",
             "systematic_rms_um"]
        )  # fmt: skip
        for point, theory, results in zip(swept.points, swept.theory, swept.results, strict=True):
            expected = [theory.bound_um, theory.predicted_um, theory.systematic_rms_um]
            for each in results:
                found = [each.metrics.get(metric, "") for metric in METRICS]
                writer.writerow(
                    [*point.values, each.method, each.repetition, *found, each.seconds, each.failure, *expected]
                )


def sweep_markdown(swept: Swept, figure: str) -> str:
    """Say how the sweep was made, show it, and say what is seen."""
    sweep = swept.sweep
    names = " and ".join(axis.name for axis in sweep.axes)
    shape = sweep.base.source.scene.microscope
    head = [
        f"# Sweep of {names} on {sweep.base.name}",
        "",
        f"{sweep.base.about} {shape.width_px} x {shape.height_px} px of {shape.pixel_size_um:.4g} um, tilts "
        f"{', '.join(f'{tilt:g}' for tilt in sweep.base.source.scene.schedule.tilts_deg)} degrees unless varied; "
        f"repetitions: {sweep.repetitions}, with the same noise for all methods and at all values. Median absolute "
        "depth error in um over the commonly visible pixels, after removal of what each method declares unobservable; "
        "in brackets the 95 % bootstrap interval of its mean over the repetitions (of few, it is too narrow). `bound` "
        "is the median error at the Cramer-Rao bound of a Gaussian window of "
        f"{sweep.theory.window_px:g} px; `predicted` is that of points matched to "
        f"{sweep.theory.matching_noise_px:g} px a view at nominal poses.",
        "",
        f"![The sweep]({figure})",
        "",
    ]
    return "\n".join([*head, *_table(swept), "", "## What is seen", "", *_seen(swept), ""])


def _curve(swept: Swept, method: str, metric: str) -> Curve:
    values = np.full((len(swept.points), swept.sweep.repetitions), np.nan)
    for row, results in zip(values, swept.results, strict=True):
        for each in results:
            if each.method == method:
                row[each.repetition] = each.metrics.get(metric, np.nan)
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=1)
    mean = np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)
    low, high = np.array([interval(row) for row in values]).T
    return Curve(method, values, mean, low, high)


def _table(swept: Swept) -> list[str]:
    found = curves(swept)
    head = [*(axis.label for axis in swept.sweep.axes), "bound", "predicted", *(curve.method for curve in found)]
    rows = [f"| {' | '.join(head)} |", "|" + "---:|" * len(head)]
    for i, (point, theory) in enumerate(zip(swept.points, swept.theory, strict=True)):
        cells = [*(f"{value:g}" for value in point.values), _said(theory.bound_um), _said(theory.predicted_um)]
        cells += [_with_interval(curve, i) for curve in found]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def _said(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"


def _with_interval(curve: Curve, i: int) -> str:
    if not np.isfinite(curve.low[i]):
        return _said(curve.mean[i])
    return f"{curve.mean[i]:.3g} [{curve.low[i]:.3g}, {curve.high[i]:.3g}]"


def _seen(swept: Swept) -> list[str]:
    bound = np.array([theory.bound_um for theory in swept.theory])
    expected = np.array([theory.predicted_um for theory in swept.theory])
    found = curves(swept)
    lines = []
    if len(swept.sweep.axes) == 1:
        x = np.array([point.values[0] for point in swept.points])
        lines += _trend("The bound", x, bound, swept) + _trend("The predicted response", x, expected, swept)
        for curve in found:
            lines += _trend(f"`{curve.method}`", x, curve.mean, swept)
    for curve in found:
        lines += _against_theory(curve, bound, expected) + _failures(curve, swept)
    lines += [_compared(found[0], other) for other in found[1:]]
    return [f"- {line}" for line in lines] or ["- Nothing: no method answered."]


def _trend(who: str, x: Array, y: Array, swept: Swept) -> list[str]:
    known = np.flatnonzero(np.isfinite(y))
    if len(known) < 2:
        return []
    first, last = known[0], known[-1]
    text = f"{who} goes from {y[first]:.3g} um at {x[first]:g} to {y[last]:.3g} um at {x[last]:g}"
    if swept.sweep.axes[0].logarithmic:
        return [f"{text}, a power of {slope(x, y):+.2f}."]
    best = known[np.argmin(y[known])]
    return [f"{text}; it is least, {y[best]:.3g} um, at {x[best]:g}."]


def _against_theory(curve: Curve, bound: Array, expected: Array) -> list[str]:
    parts = []
    for name, theory in (("the bound", bound), ("the prediction", expected)):
        ratio = curve.mean / theory
        ratio = ratio[np.isfinite(ratio)]
        if ratio.size:
            parts.append(f"{ratio.min():.2g} to {ratio.max():.2g} times {name}")
    return [f"`{curve.method}` stays at {' and '.join(parts)}."] if parts else []


def _failures(curve: Curve, swept: Swept) -> list[str]:
    lost = curve.values.size - curve.answered
    said = {each.failure for results in swept.results for each in results if each.method == curve.method}
    reasons = "; ".join(sorted(filter(None, said)))
    return [f"`{curve.method}` has no answer in {lost} of {curve.values.size} cases: {reasons}."] if lost else []


def _compared(one: Curve, other: Curve) -> str:
    """Say where the paired difference of two methods is not 0, by the interval of its mean."""
    better, worse = 0, 0
    for difference in one.values - other.values:
        low, high = interval(difference)
        better, worse = better + (high < 0), worse + (low > 0)
    points = len(one.values)
    return (
        f"By paired differences `{one.method}` has the smaller error than `{other.method}` at {better} of {points} "
        f"points, the larger at {worse}; elsewhere the 95 % interval holds 0."
    )


def summary_rows(swept: Swept) -> tuple[Sequence[str], list[list[Any]]]:
    """Head and rows of the table for a terminal."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in _table(swept)]
    return rows[0], [list(row) for row in rows[2:]]
