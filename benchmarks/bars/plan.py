"""What is asked of whom: pairs of scene and method, measured like any run, each once however many bars want it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.running.bench import Plan
from benchmarks.running.bench_ledger import Result
from benchmarks.running.case import Case, cases
from benchmarks.running.cell import Limits
from benchmarks.running.ledger import Row
from benchmarks.suite import BenchScene
from semrecon.data import Array

Question = tuple[BenchScene, Any]
"""A scene, and who is asked."""


@dataclass(frozen=True)
class BarsPlan(Plan):
    """The cases of some questions; `scenes` and `methods` are those that occur in them."""

    questions: tuple[Question, ...] = ()

    @property
    def cases(self) -> list[Case]:
        """Every case once, scene by scene."""
        found: dict[str, Case] = {}
        for scene in self.scenes:
            asked = [method for at, method in self.questions if at == scene]
            found |= {case.key: case for case in cases((scene,), asked, self.repetitions)}
        return list(found.values())


def plan_of(questions: Sequence[Question], limits: Limits) -> BarsPlan:
    """Gather questions into one plan; each specimen has one repetition, for it is specimens that differ."""
    scenes = tuple(dict.fromkeys(scene for scene, _ in questions))
    methods = {method.name: method for _, method in questions}
    return BarsPlan(scenes, tuple(methods.values()), 1, limits, tuple(questions))


@dataclass(frozen=True)
class Found:
    """What was measured, by scene and method.

    Parameters
    ----------
    results
        By name of scene and of method.
    derived
        Numbers that need two answers, or more of one than its scores, by the same names (`benchmarks.bars.derived`).
    rows
        What was measured otherwise, by bar, scene and method.
    """

    results: Mapping[tuple[str, str], Result]
    derived: Mapping[tuple[str, str], Mapping[str, float]] = field(default_factory=dict)
    rows: Mapping[tuple[str, str, str], Row] = field(default_factory=dict)

    def number(self, scene: BenchScene, method: str, metric: str) -> float:
        """Return a score or a derived number; NaN where there is none, or the method failed."""
        result = self.results.get((scene.name, method))
        if result is None or result.kind:
            return float("nan")
        return float(self.derived.get((scene.name, method), {}).get(metric, result.metrics.get(metric, np.nan)))

    def numbers(self, scenes: Sequence[BenchScene], method: str, metric: str) -> Array:
        """Return a number of each of the scenes, (n,)."""
        return np.array([self.number(scene, method, metric) for scene in scenes])

    def failures(self, scenes: Sequence[BenchScene], method: str) -> list[str]:
        """Say where a method failed, and how."""
        answer = []
        for scene in scenes:
            result = self.results.get((scene.name, method))
            if result is not None and result.kind:
                answer.append(f"{method} on {scene.name}: {result.failure}")
        return answer
