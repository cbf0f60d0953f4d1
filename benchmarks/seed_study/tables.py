"""The counterpart of the seed's Table 2 and what its numbers say of the seed's claims, from ledger rows."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.running.ledger import Row
from benchmarks.seed_study.figures import contenders_of, series_of
from semrecon.data import Array

COLUMNS = {
    "rmse_um": "RMSE (um)",
    "rre_deg": "RRE (degrees)",
    "depth_median_um": "median depth error (um)",
    "depth_rms_um": "RMS depth error (um)",
    "depth_p95_um": "95 % depth error (um)",
    "map_median_um": "median error of the filled map (um)",
    "completeness": "completeness of the map",
}
"""Metrics of the table and their headings; a metric that no row has is left out."""
PUBLISHED = {("pollen", "rmse_um"): 44, ("pollen", "rre_deg"): 88, ("diatom", "rmse_um"): 20, ("diatom", "rre_deg"): 96}
"""Reductions in percent that the seed reports for its method against its control (section 5.2)."""


@dataclass(frozen=True)
class Reduction:
    """How much lower the mean of a metric is for one contender than for another, in percent of the latter.

    `low` and `high` bound the 95 % interval of a bootstrap over the repetitions, both contenders resampled alike; NaN
    where there are fewer than two repetitions.
    """

    percent: float
    low: float
    high: float

    def __str__(self) -> str:
        """Say it with its interval, a minus sign meaning higher."""
        if np.isnan(self.percent):
            return "-"
        interval = "" if np.isnan(self.low) else f" ({_tenths(self.low)} to {_tenths(self.high)})"
        return f"{_tenths(self.percent)} %{interval}"


def reduction(rows: Sequence[Row], ours: str, control: str, metric: str, resamples: int = 4000) -> Reduction:
    """Compare two contenders on the repetitions that both finished."""
    a, b = _paired(rows, ours, control, metric)
    if not len(a):
        return Reduction(float("nan"), float("nan"), float("nan"))
    percent = float(100 * (1 - a.mean() / b.mean()))
    if len(a) < 2:
        return Reduction(percent, float("nan"), float("nan"))
    seed = int.from_bytes(hashlib.sha256(f"{ours}/{control}/{metric}".encode()).digest()[:4], "big")
    chosen = np.random.default_rng(seed).integers(0, len(a), (resamples, len(a)))
    low, high = np.percentile(100 * (1 - a[chosen].mean(axis=1) / b[chosen].mean(axis=1)), [2.5, 97.5])
    return Reduction(percent, float(low), float(high))


def write_csv(path: Path, rows_by_scene: Mapping[str, Sequence[Row]]) -> None:
    """Write every row with every metric, for programs."""
    rows = [row for rows in rows_by_scene.values() for row in rows]
    metrics = sorted({name for row in rows for name in row.metrics})
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["scene", "contender", "repetition", "failure", *metrics])
        for row in rows:
            values = [row.metrics.get(name, float("nan")) for name in metrics]
            writer.writerow([row.scene, row.contender, row.repetition, row.failure, *values])


def table2(rows: Sequence[Row]) -> str:
    """Means and standard deviations over the repetitions, a line a contender (Table 2), as Markdown."""
    columns = [name for name in COLUMNS if any(name in row.metrics for row in rows)]
    head = ["contender", "runs", "points a pair", *(COLUMNS[name] for name in columns)]
    lines = [_line(head), _line(["---"] * len(head))]
    for contender in contenders_of(rows):
        points = series_of(rows, contender, "points")[1]
        answered = f"{len(points)} of {sum(row.contender == contender for row in rows)}"
        values = [_mean_and_spread(series_of(rows, contender, name)[1]) for name in columns]
        lines.append(_line([contender, answered, f"{points.mean():.0f}" if len(points) else "-", *values]))
    return "\n".join(lines)


def reductions_table(rows: Sequence[Row], scene: str) -> str:
    """Reductions of the first contender's means against all others, in percent, beside the published, as Markdown."""
    ours, *controls = contenders_of(rows)
    columns = [name for name in COLUMNS if name != "completeness" and any(name in row.metrics for row in rows)]
    lines = [_line([f"{ours} lower by", *(COLUMNS[name] for name in columns)]), _line(["---"] * (len(columns) + 1))]
    for control in controls:
        lines.append(_line([f"than {control}", *(str(reduction(rows, ours, control, name)) for name in columns)]))
    if (scene, "rmse_um") in PUBLISHED:
        published = [f"{PUBLISHED[scene, name]} %" if (scene, name) in PUBLISHED else "-" for name in columns]
        lines.append(_line(["published, than its control", *published]))
    return "\n".join(lines)


def _paired(rows: Sequence[Row], ours: str, control: str, metric: str) -> tuple[Array, Array]:
    first, second = (
        dict(zip(*(values.tolist() for values in series_of(rows, name, metric)), strict=True))
        for name in (ours, control)
    )
    both = sorted(first.keys() & second.keys())
    return np.array([first[each] for each in both]), np.array([second[each] for each in both])


def _tenths(value: float) -> str:
    return f"{round(value, 1) + 0.0:.1f}"  # adding zero turns -0.0 into 0.0


def _mean_and_spread(values: Array) -> str:
    if not len(values):
        return "-"
    deviation = round(float(np.std(values, ddof=1)), 9) if len(values) > 1 else float("nan")
    spread = "" if np.isnan(deviation) else f" ± {deviation:.2g}"
    return f"{values.mean():.4g}{spread}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
