"""Tables of the page on methods: text between two markers is made from the record of a run, the rest is by hand."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from benchmarks.reporting.error_maps import Record, Strip
from benchmarks.reporting.leaderboard import MARK, limit_notes
from benchmarks.running.bench_ledger import Result
from benchmarks.running.bounds import reasons
from benchmarks.running.case import is_oracle
from benchmarks.running.manifest import MethodRecord
from semrecon.errors import InputError

BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"
FRONT_BEGIN, FRONT_END = "<!-- medians:begin -->", "<!-- medians:end -->"
LEAST_SAID = 0.001
"""Smaller numbers are rounding of the computer."""
ALONE = "The same after an offset alone, whatever else is declared: what a user would meet (first repetition)"
TABLES = {
    "median_um": "Median absolute depth error, um, after the declared gauge is removed",
    "efficiency": "Efficiency: that error over the least that the light allows where the method answered",
    "common_median_um": "The same after one gauge for all: offset, plane, scale and sign of the heights",
    "split_scale": "Scale of the heights as answered: 1 is right, 0.5 is relief of half its height",
    "completeness": "Completeness: share of what all views see that has a height",
    "fscore_1px": "F-score at a tolerance of one pixel",
}


def filled_page(page: str, body: str, begin: str = BEGIN, end: str = END) -> str:
    """Put a text between the markers of a page; raises `InputError` unless there is one pair of them."""
    if page.count(begin) != 1 or page.count(end) != 1 or page.index(begin) > page.index(end):
        raise InputError(f"the page must have one line {begin} and, below it, one line {end}")
    head, _, rest = page.partition(begin)
    return f"{head}{begin}\n\n{body.strip()}\n\n{end}{rest.partition(end)[2]}"


def medians(record: Record) -> str:
    """Write the one table of a front page: median error of each method on each scene, and efficiency in brackets."""
    scenes = _scenes(record)
    rows = [["method", *scenes]]
    for method in record.methods:
        pairs = [
            [_mean(record.results, at, method.name, each) for each in ("median_um", "efficiency")] for at in scenes
        ]
        rows.append([_name(method), *(cell(*pair) for pair in pairs)])
    return f"{_origin(record)}\n\n{_table(rows)}"


def cell(median_um: float, efficiency: float) -> str:
    """Say a median and, in brackets, its efficiency where there is one: 0.72 (11)."""
    if not np.isfinite(efficiency):
        return _said(median_um)
    return f"{_said(median_um)} ({efficiency:.0f})" if efficiency >= 10 else f"{_said(median_um)} ({efficiency:.1f})"


def leaderboard(record: Record, drawn: Sequence[Strip]) -> str:
    """Write the tables of a run: one of needs and costs, one a metric, and why there are dashes.

    Parameters
    ----------
    drawn
        Error maps of the same run: what is left after an offset alone is not on record, and comes from them.
    """
    parts = [_origin(record), "### What each needs and costs", _needs(record)]
    for metric, title in TABLES.items():
        if metric == "efficiency" and not any("efficiency" in each.metrics for each in record.results):
            continue
        parts += [f"### {title}", _over_scenes(record, metric)]
        if metric == "efficiency":
            parts += [" ".join(limit_notes(reasons(_identities(record), record.ledger)))]
        if metric == "common_median_um":
            parts += [f"### {ALONE}", _offset_alone(drawn)]
    return "\n\n".join([*parts, "### Why there is no number", *_reasons(record)])


def _origin(record: Record) -> str:
    manifest = record.manifest
    of = f"{manifest.repetitions} repetition{'s' * (manifest.repetitions != 1)}"
    size = "427 columns (`--quick`)" if manifest.quick else "640 columns"
    oracles = f" {MARK} is handed part of the truth." if any(is_oracle(each) for each in record.methods) else ""
    code = f", code {manifest.code}" if manifest.code else ""
    return (
        f"Means over {of} with new noise, images of about {size}, begun {manifest.started[:10]}{code}. Lines stand in "
        f"the order of the sections; there is no rank.{oracles}"
    )


def _needs(record: Record) -> str:
    rows = [["method", "needs", "cannot observe", "answered", "seconds", "memory (MiB)"]]
    for method in record.methods:
        of_method = [each for each in record.results if each.method == method.name]
        answered = [each for each in of_method if not each.kind]
        seconds, peaks = [each.seconds for each in answered], [each.peak_mib for each in answered]
        costs = [_range(seconds), _range(peaks)]
        share = f"{len(answered)} of {len(of_method)}"
        rows.append([_name(method), ", ".join(method.needs) or "-", ", ".join(method.gauge) or "-", share, *costs])
    return _table(rows)


def _over_scenes(record: Record, metric: str) -> str:
    scenes = _scenes(record)
    rows = [["method", *scenes]]
    for method in record.methods:
        rows.append([_name(method), *(_said(_mean(record.results, scene, method.name, metric)) for scene in scenes)])
    return _table(rows)


def _mean(results: Sequence[Result], scene: str, method: str, metric: str) -> float:
    """Mean over the repetitions that were answered; one without the number makes it NaN."""
    found = [each for each in results if (each.scene, each.method) == (scene, method) and not each.kind]
    return float(np.mean([each.metrics.get(metric, np.nan) for each in found])) if found else float("nan")


def _identities(record: Record) -> list[tuple[str, str]]:
    return [(each.name, each.identity) for each in record.manifest.scenes]


def _offset_alone(drawn: Sequence[Strip]) -> str:
    rows = [["method", *(one.scene for one in drawn[0].maps)]]
    for strip in drawn:
        rows.append([_name(strip.method), *(_said(one.offset_only_um) for one in strip.maps)])
    return _table(rows)


def _reasons(record: Record) -> list[str]:
    """Sentences of the failures, each once a method, with its scenes."""
    found: dict[tuple[str, str], list[str]] = {}
    marked = {each.name: _name(each) for each in record.methods}
    for each in record.results:
        if each.kind:
            scenes = found.setdefault((marked[each.method], each.failure), [])
            scenes += [each.scene] if each.scene not in scenes else []
    order = list(marked.values())
    ordered = sorted(found.items(), key=lambda item: order.index(item[0][0]))
    return ["\n".join(f"- {method}, on {', '.join(at)}: {said}" for (method, said), at in ordered) or "All answered."]


def _scenes(record: Record) -> list[str]:
    return [each.name for each in record.manifest.scenes]


def _name(method: MethodRecord) -> str:
    return f"{method.name} {MARK}" if is_oracle(method) else method.name


def _range(values: Sequence[float]) -> str:
    known = [each for each in values if np.isfinite(each)]
    if not known:
        return "-"
    low, high = _said(min(known)), _said(max(known))
    return low if low == high else f"{low} to {high}"


def _said(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    if 0 < abs(value) < LEAST_SAID:
        return f"< {LEAST_SAID:g}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *rest = [[re.sub(r"\|", "\\|", cell) for cell in row] for row in rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rest])
