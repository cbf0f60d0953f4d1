"""Accuracy that must not get worse: committed means with tolerances from the spread between repetitions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.running.ledger import Row
from benchmarks.scenes import SimulatedSource, Source, paper_scenes
from benchmarks.seed_study.figures import contenders_of, series_of
from benchmarks.seed_study.study import NAMES, measure

BASELINES = Path(__file__).resolve().parent / "baselines" / "accuracy.json"
REPETITIONS = 3
METRICS = ("rmse_um", "rre_deg", "depth_median_um", "depth_p95_um", "map_median_um", "completeness", "points")
SPREADS = 4.0
"""A mean may move by so many standard errors, or by `LEAST` of itself, before it counts as moved."""
LEAST = 0.02

Baselines = dict[str, dict[str, dict[str, dict[str, float]]]]
"""Scene, contender, metric: `mean` and `tolerance`."""


@dataclass(frozen=True)
class Shift:
    """A mean that left its tolerance."""

    scene: str
    contender: str
    metric: str
    before: float
    after: float
    tolerance: float

    def __str__(self) -> str:
        """Say what moved, from where to where, and what was allowed."""
        return (
            f"{self.scene}, {self.contender}: {self.metric} was {self.before:.5g} and is {self.after:.5g}, "
            f"which is more than {self.tolerance:.2g} away; if that is meant, run `python -m benchmarks baselines` and "
            "give the change a line under Results in the changelog"
        )


def guarded_scenes(cache: Path) -> tuple[SimulatedSource, ...]:
    """Make the scenes that are guarded: the quick ones of the seed's study."""
    return paper_scenes(cache, quick=True)


def measured(source: Source) -> dict[str, dict[str, dict[str, float]]]:
    """Measure a scene: by contender and metric the mean over the repetitions and its tolerance."""
    rows = [row for number in range(REPETITIONS) for row in measure(source, number, NAMES)]
    return {name: _of_contender(rows, name) for name in contenders_of(rows)}


def shifts(scene: str, now: Mapping[str, Mapping[str, Mapping[str, float]]], before: Baselines) -> list[Shift]:
    """List every mean that left its tolerance; one that is gone or not a number has left it."""
    found = []
    for contender, metrics in before[scene].items():
        for metric, known in metrics.items():
            value = now.get(contender, {}).get(metric, {}).get("mean", float("nan"))
            if not abs(value - known["mean"]) <= known["tolerance"]:
                found.append(Shift(scene, contender, metric, known["mean"], value, known["tolerance"]))
    return found


def read_baselines() -> Baselines:
    """Read the committed baselines."""
    known: Baselines = json.loads(BASELINES.read_text(encoding="utf-8"))
    return known


def write_baselines(baselines: Baselines) -> None:
    """Replace the committed baselines."""
    BASELINES.parent.mkdir(exist_ok=True)
    BASELINES.write_text(json.dumps(baselines, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _of_contender(rows: list[Row], contender: str) -> dict[str, dict[str, float]]:
    values = {metric: series_of(rows, contender, metric)[1] for metric in METRICS}
    return {
        metric: {
            "mean": float(f"{each.mean():.6g}"),
            "tolerance": float(f"{max(SPREADS * each.std(ddof=1) / np.sqrt(len(each)), LEAST * abs(each.mean())):.3g}"),
        }
        for metric, each in values.items()
        if len(each) == REPETITIONS
    }
