"""A paired comparison as rows, as sentences, as Markdown and as CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from benchmarks.judging.paired import LEAST, Interval, Line, has_side
from benchmarks.reporting.paired_sides import OF_CASE, Paired

FILES = ("compare.csv", "compare.md")
TITLES = {
    "median_um": "median absolute depth error",
    "common_median_um": "median absolute depth error after a gauge common to all",
    "penalised_median_um": "median depth error, what is missing counted as infinitely wrong",
    "rms_um": "rms depth error",
    "p95_um": "95 % quantile of the depth error",
    "completeness": "completeness",
    "fscore_1px": "F-score at one pixel",
    "normal_deg": "error of the normals",
    "seconds": "time",
    "peak_mib": "memory",
}


def title(metric: str) -> str:
    """Words for a score; its name where there are none."""
    return TITLES.get(metric, metric)


def overall(paired: Paired) -> list[Line]:
    """Lines over all scenes; of the only scene where there is one."""
    several = [line for line in paired.lines if not line.scene]
    return several or list(paired.lines)


def by_scene(paired: Paired) -> list[Line]:
    """Lines of the first score, scene by scene; empty where there is but one scene."""
    if not any(not line.scene for line in paired.lines):
        return []
    return [line for line in paired.lines if line.scene and line.metric == paired.metrics[0]]


def rows(paired: Paired, lines: Sequence[Line]) -> list[list[str]]:
    """Cells of a table, headings first; columns that say nothing new are left out."""
    methods, scenes = (any(getattr(line, name) for line in lines) for name in ("method", "scene"))
    head = ["method"] * methods + ["scene"] * scenes
    scores = len({line.metric for line in lines}) > 1
    head += ["score"] * scores + [
        "pairs",
        paired.first,
        paired.second,
        "ratio",
        "difference",
        "better : worse",
        "verdict",
    ]
    answer = [head]
    for line in lines:
        fixed = [line.method] * methods + [line.scene] * scenes
        answer.append(
            [
                *fixed,
                *([line.metric] * scores),
                str(line.pairs),
                number(line.first),
                number(line.second),
                _said(line.ratio),
                _said(line.difference),
                f"{line.better} : {line.worse}",
                verdict(line, paired),
            ]
        )
    return answer


def verdict(line: Line, paired: Paired) -> str:
    """Say in a few words who is better, or why that cannot be said."""
    if not line.pairs:
        return "no pair"
    if line.same:
        return "the same in every pair"
    units = "pairs" if line.scene else "scenes"
    if line.units < LEAST:
        return f"no claim: {line.units} {units if line.units != 1 else units[:-1]}, {LEAST} needed"
    if not line.claim:
        return "cannot be told apart"
    return f"{paired.first if line.claim > 0 else paired.second} {_word(line.metric)}"


def sentences(paired: Paired) -> list[str]:
    """Say the outcome: of the first score with its numbers, of the others by name, method by method."""
    groups: dict[tuple[str, str], list[Line]] = {}
    for line in overall(paired):
        groups.setdefault((line.method, line.scene), []).append(line)
    unchanged = [key for key, lines in groups.items() if key[0] and _unchanged(lines)]
    said = [
        each
        for key, lines in groups.items()
        if key not in unchanged
        for each in (sentence(lines[0], paired), *_others(lines[1:], paired))
    ]
    if unchanged:
        names = ", ".join(dict.fromkeys(method for method, _ in unchanged))
        said.append(f"Every score but time and memory is the same, to the last digit, in every pair of: {names}.")
    return said


def changed(lines: Sequence[Line]) -> list[Line]:
    """Leave out what a change of the code did not touch; two methods of one run are shown in full."""
    return [line for line in lines if not (line.method and line.same)]


def _unchanged(lines: Sequence[Line]) -> bool:
    scores = [line for line in lines if line.metric not in OF_CASE]
    return bool(scores) and all(line.same for line in scores)


def sentence(line: Line, paired: Paired) -> str:
    """Say the outcome of one score in one sentence that claims no more than the interval bears."""
    one, other = paired.first, paired.second
    on = f"the {title(line.metric)}{_where(line)}"
    if not line.pairs:
        return f"{one} and {other} have no pair in {on}."
    if line.same:
        return f"{one} and {other} have the same number, to the last digit, in {on}, in {_count(line)}."
    if line.units < LEAST or not line.claim:
        return f"{one} and {other} cannot be told apart on {on}: {_why_not(line)}; {one} has the {_tally(line, 1)}."
    winner, loser = (one, other) if line.claim > 0 else (other, one)
    return (
        f"{winner} is {_word(line.metric)} than {loser} on {on}: {_amount(line, paired)}; it has the "
        f"{_tally(line, line.claim)}."
    )


def _others(lines: Sequence[Line], paired: Paired) -> list[str]:
    """Gather the scores that have one and the same outcome."""
    found: dict[str, list[str]] = {}
    for line in lines:
        found.setdefault(_outcome(line, paired), []).append(title(line.metric))
    where = _where(lines[0]).strip() if lines else ""
    return [f"{where[:1].upper()}{where[1:]}, {outcome}: {'; '.join(titles)}." for outcome, titles in found.items()]


def _outcome(line: Line, paired: Paired) -> str:
    one, other = paired.first, paired.second
    if not line.pairs:
        return "no pair for"
    if line.same:
        return "the same in every pair"
    if line.units < LEAST:
        return "no claim either, for the same reason, on"
    if not line.claim:
        return "both cannot be told apart on"
    winner, loser = (one, other) if line.claim > 0 else (other, one)
    return f"{winner} is {_word(line.metric)} than {loser} on"


def _where(line: Line) -> str:
    of = f" of {line.method}" if line.method else ""
    return of + (f" on {line.scene}" if line.scene else " over all scenes")


def _why_not(line: Line) -> str:
    if line.units >= LEAST:
        return f"the interval {_said(line.ratio if line.by_ratio else line.difference)} allows for both"
    units = "pair" if line.scene else "scene"
    return f"{line.units} {units}{'s carry' if line.units != 1 else ' carries'} no interval, {LEAST} are needed"


def _word(metric: str) -> str:
    return "better" if has_side(metric) else "larger"


def _tally(line: Line, side: int) -> str:
    won = line.better if side > 0 else line.worse
    return f"{_word(line.metric)} number in {won} of {_count(line)}"


def _count(line: Line) -> str:
    pairs = f"{line.pairs} pair{'s' * (line.pairs != 1)}"
    return pairs if line.scene else f"{pairs} on {line.scenes} scene{'s' * (line.scenes != 1)}"


def _amount(line: Line, paired: Paired) -> str:
    """How the first stands to the second."""
    if line.by_ratio:
        return f"{paired.first} has {_said(line.ratio)} times the number of {paired.second}"
    return f"{paired.first} minus {paired.second} is {_said(line.difference)}"


def notes(paired: Paired) -> list[str]:
    """Say how to read the numbers, and what must be known of the two sides."""
    lost = sum(line.only_first + line.only_second + line.neither for line in overall(paired)[:1])
    how = (
        f"Ratio is {paired.first} over {paired.second} (geometric mean), difference {paired.first} minus "
        f"{paired.second}; in brackets the interval of 95 % by the bootstrap, of pairs on one scene and of scenes "
        f"over all of them, from {LEAST} on. The ratio decides, for shares the difference."
    )
    many = sum(line.units >= LEAST and not line.same for line in paired.lines)
    answer = [paired.about, how]
    if many >= 10:
        answer.append(
            f"Each of the {many} intervals stands for itself: where nothing differs, one in 20 still leaves out the "
            "truth by chance."
        )
    if lost and not any("no answer" in note for note in paired.notes):
        answer.append(
            f"{lost} case{'s are' if lost != 1 else ' is'} in no pair: one side or both have no number for it."
        )
    return [*answer, *paired.notes]


def markdown(paired: Paired) -> str:
    """Write the comparison as Markdown: sentences, then tables, then what a reader must know."""
    parts = [f"# {paired.first} against {paired.second}", "\n".join(f"- {each}" for each in sentences(paired))]
    parts += ["## All scores", _table(rows(paired, changed(overall(paired))))]
    if each := changed(by_scene(paired)):
        parts += [f"## Scene by scene: {title(paired.metrics[0])}", _table(rows(paired, each))]
    return "\n\n".join([*parts, "## Notes", "\n".join(f"- {each}" for each in notes(paired))]) + "\n"


def write_csv(path: Path, paired: Paired) -> None:
    """Write every line, every score of every scene too; intervals as three columns each."""
    plain = [each.name for each in fields(Line) if each.name not in ("difference", "ratio")]
    spread = [f"{name}{end}" for name in ("difference", "ratio") for end in ("", "_low", "_high")]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*plain, *spread, "verdict"])
        for line in paired.lines:
            ends = [getattr(each, end) for each in (line.difference, line.ratio) for end in ("value", "low", "high")]
            writer.writerow([*(getattr(line, name) for name in plain), *ends, verdict(line, paired)])


def _table(cells: Sequence[Sequence[str]]) -> str:
    head, *rest = [[cell.replace("|", "\\|") for cell in row] for row in cells]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rest])


def _said(interval: Interval) -> str:
    if np.isnan(interval.value):
        return "-"
    ends = f" [{number(interval.low)}, {number(interval.high)}]" if interval.known else ""
    return number(interval.value) + ends


def number(value: float) -> str:
    """Say a number in three digits; a dash is none."""
    return "-" if np.isnan(value) else f"{value:.3g}"
