"""The seed's study under guard: its quick scenes, a few repetitions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.gate.commitment import Figures
from benchmarks.running.ledger import Row
from benchmarks.scenes import SimulatedSource, paper_scenes
from benchmarks.seed_study.study import NAMES, measure

REPETITIONS = 3
METRICS = ("rmse_um", "rre_deg", "depth_median_um", "depth_p95_um", "map_median_um", "completeness", "points")


def study_scenes(cache: Path) -> tuple[SimulatedSource, ...]:
    """Make the scenes that are guarded: the quick ones of the study."""
    return paper_scenes(cache, quick=True)


def study_figures(source: SimulatedSource, repetitions: int) -> dict[str, list[Figures]]:
    """Run the study on a scene: by contender the figures of every repetition."""
    rows = [row for number in range(repetitions) for row in measure(source, number, NAMES)]
    names = dict.fromkeys(row.contender for row in rows)
    return {name: _figures([row for row in rows if row.contender == name]) for name in names}


def _figures(rows: Sequence[Row]) -> list[Figures]:
    """Pick the figures of every repetition; one without an answer has none."""
    return [{metric: float(row.metrics[metric]) for metric in METRICS if metric in row.metrics} for row in rows]
