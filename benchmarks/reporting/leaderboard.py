"""Tables of who did how well where: for each scene, and over all of them; no blended rank."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.judging.limits import LimitOptions
from benchmarks.running.bench_ledger import Result
from benchmarks.running.case import contender_of, is_oracle, needs_of

HEADINGS = {
    "median_um": "median (um)",
    "efficiency": "efficiency",
    "rms_um": "rms (um)",
    "common_median_um": "median, common gauge (um)",
    "completeness": "completeness",
    "fscore_1px": "F-score, 1 px",
    "normal_deg": "normals (deg)",
    "seconds": "seconds",
    "peak_mib": "memory (MiB)",
}
"""Numbers of the table of a scene; each is the mean over the repetitions that were answered."""
LEGEND = (
    "Efficiency is the median error over the least one that the light allows (Cramér-Rao bound) at the pixels which "
    "the method answered: 1 is the limit, 10 is ten times as bad. The bound is from dose, spot and texture through the "
    f"geometry, for unbiased heights, each one number in a Gaussian window of {LimitOptions().window_px:g} px "
    "(standard deviation), with known poses and nothing known of the texture. So below 1 is no mistake where a method "
    "smooths over more than that window, or draws on shading or on further detectors, of which the bound knows "
    "nothing; nor where an oracle is handed what the light does not tell."
)
"""What an efficiency is, and what it is not."""
MARK = "†"
"""Behind the name of an oracle, which is handed part of the truth."""


@dataclass(frozen=True)
class Entry:
    """What one method did on one scene: means by metric, how many repetitions it answered, and why not the others."""

    scene: str
    method: str
    needs: str
    gauge: str
    answered: int
    asked: int
    values: Mapping[str, float]
    failures: tuple[str, ...]

    @property
    def outcome(self) -> str:
        """Say in a word or a sentence how it went."""
        return "; ".join(self.failures)


def entries(results: Sequence[Result], methods: Sequence[Any]) -> list[Entry]:
    """Gather results by scene and method, in the order in which they come; best median first within a scene."""
    known = {method.name: method for method in methods}
    found: dict[tuple[str, str], list[Result]] = {}
    for each in results:
        found.setdefault((each.scene, each.method), []).append(each)
    answer = [_entry(scene, known[name], group) for (scene, name), group in found.items()]
    order = list(dict.fromkeys(each.scene for each in answer))
    return sorted(answer, key=lambda each: (order.index(each.scene), _last(each.values["median_um"])))


def _entry(scene: str, method: Any, results: Sequence[Result]) -> Entry:
    right = [each for each in results if not each.kind]
    values = {name: _mean([_value(each, name) for each in right]) for name in HEADINGS}
    failures = tuple(dict.fromkeys(each.failure for each in results if each.kind))
    name = f"{method.name} {MARK}" if is_oracle(method) else str(method.name)
    needs, gauge = (", ".join(each) or "-" for each in (needs_of(method), contender_of(method).gauge))
    return Entry(scene, name, needs, gauge, len(right), len(results), values, failures)


def _value(result: Result, name: str) -> float:
    return float(getattr(result, name) if name in ("seconds", "peak_mib") else result.metrics.get(name, np.nan))


def _mean(values: Sequence[float]) -> float:
    """Mean of all; a repetition without a number makes it NaN, as leaving it out could only flatter."""
    return float(np.mean(values)) if values else float("nan")


def _last(value: float) -> float:
    return value if np.isfinite(value) else np.inf


def rows_of_scene(of_scene: Sequence[Entry]) -> list[list[str]]:
    """Cells of the table of a scene, headings first."""
    answer = [["method", "needs", "cannot observe", "answered", *HEADINGS.values(), "failure"]]
    for each in of_scene:
        numbers = [_said(each.values[name]) for name in HEADINGS]
        answer.append([each.method, each.needs, each.gauge, f"{each.answered}/{each.asked}", *numbers, each.outcome])
    return answer


def rows_over_scenes(every: Sequence[Entry], metric: str = "median_um") -> list[list[str]]:
    """Cells of a table with a method a line and a scene a column, headings first."""
    scenes = list(dict.fromkeys(each.scene for each in every))
    methods = {each.method: each.needs for each in every}
    value = {(each.method, each.scene): each for each in every}
    answer = [["method", "needs", *scenes]]
    for method, needs in methods.items():
        of_method = [value.get((method, scene)) for scene in scenes]
        answer.append([method, needs, *("" if one is None else _said(one.values[metric]) for one in of_method)])
    return answer


def side_by_side(rows: Sequence[Sequence[str]], width: int) -> list[list[list[str]]]:
    """Cut a table of `rows_over_scenes` into ones that are at most so many letters wide, each with the methods.

    The column of needs goes to the end. A column that is too wide even alone gets a table of its own.
    """
    columns = list(zip(*rows, strict=True))
    names, needs, *scenes = columns
    answer: list[list[Sequence[str]]] = []
    for column in (*scenes, needs):
        if not answer or _letters([*answer[-1], column]) > width:
            answer.append([names])
        answer[-1].append(column)
    return [[list(row) for row in zip(*each, strict=True)] for each in answer]


def _letters(columns: Sequence[Sequence[str]]) -> int:
    """Width of a table with rules between its columns."""
    return 1 + sum(3 + max(map(len, column)) for column in columns)


def markdown(every: Sequence[Entry], about: Mapping[str, str], notes: Sequence[str]) -> str:
    """Write the leaderboard as Markdown."""
    parts = ["# Leaderboard", *notes]
    for metric, title in (
        ("median_um", "Median absolute depth error, um, after each method's declared gauge"),
        ("efficiency", "Efficiency: that error over the physical limit"),
        ("common_median_um", "The same after a gauge common to all: offset, plane, scale and sign of the heights"),
        ("completeness", "Completeness over what all views see"),
        ("fscore_1px", "F-score at a tolerance of 1 pixel"),
    ):
        parts += [f"## {title}", _table(rows_over_scenes(every, metric))]
    for scene in dict.fromkeys(each.scene for each in every):
        table = _table(rows_of_scene([each for each in every if each.scene == scene]))
        parts += [f"## {scene}", about.get(scene, ""), table]
    return "\n\n".join(part for part in parts if part) + "\n"


def notes(results: Sequence[Result], marked: bool) -> list[str]:
    """Say how to read the tables."""
    failed = sum(bool(each.kind) for each in results)
    said = [
        f"{len(results)} cases, of which {failed} have no answer; every one of those says why.",
        "Errors are judged on the reference view wherever all views see the surface. A dash is no number. "
        "Lines are sorted by the median within a scene; there is no rank over scenes: methods need different things.",
    ]
    return (
        [*said, f"{MARK} is handed part of the truth: it is no method, but shows what a stage costs."]
        if marked
        else said
    )


def limit_notes(unlimited: Mapping[str, str]) -> list[str]:
    """Say what an efficiency is, and of each scene without a physical limit, by its name, why it has none."""
    return [LEGEND, *(f"There is no efficiency on {scene}: {reason}." for scene, reason in unlimited.items())]


def write_table_csv(path: Path, every: Sequence[Entry]) -> None:
    """Write one line a scene and method."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["scene", "method", "needs", "gauge", "answered", "asked", *HEADINGS, "failure"])
        for each in every:
            fixed = [each.scene, each.method, each.needs, each.gauge, each.answered, each.asked]
            writer.writerow([*fixed, *each.values.values(), each.outcome])


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *rest = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rest])


def _said(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"
