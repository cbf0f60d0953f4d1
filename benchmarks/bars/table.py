"""Bars as tables: Markdown to read, CSV for other programs."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.bars.bar import Bar
from benchmarks.bars.line import Line
from benchmarks.judging.paired import Interval

HEAD = ("bar", "of", "asked", "measured", "holds?")
LEGEND = (
    "In brackets is the 95 % interval of a mean over specimens (Student's t; scenes are as asked for, specimens drawn "
    "by chance). A line holds if its number meets what is asked; it is settled if all of the interval says the "
    "same. One specimen carries no interval. Ratios are geometric means, and a specimen on which the dense method "
    "fails counts as infinitely wrong."
)


def row_of(line: Line) -> tuple[str, str, str, str, str]:
    """Return the cells of a line, as in `HEAD`."""
    return line.bar, line.what, str(line.asked), said(line.measured), line.verdict


def said(measured: Interval) -> str:
    """Write a number with its interval, three digits each."""
    if np.isnan(measured.value):
        return "-"
    ends = f" [{measured.low:.3g}, {measured.high:.3g}]" if measured.known else ""
    return f"{measured.value:.3g}{ends}"


def markdown(bars: Sequence[Bar], lines: Sequence[Line], about: Sequence[str]) -> str:
    """Write the page: what it is of, the table at a glance, then every bar with its details and notes."""
    page = ["# Bars", "", *about, "", LEGEND, "", *_table([row_of(line) for line in lines if not line.detail], HEAD)]
    for bar in bars:
        own = [line for line in lines if line.bar == bar.name]
        rows = [(*row_of(line)[1:], line.note) for line in own]
        page += ["", f"## {bar.name}", "", bar.about, "", *_table(rows, (*HEAD[1:], "note"))]
    return "\n".join([*page, ""])


def write_csv(path: Path, lines: Sequence[Line]) -> None:
    """Write one row a line; numbers in full."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("bar", "of", "asked", "value", "low", "high", "verdict", "detail", "note"))
        for line in lines:
            found = line.measured
            numbers = (found.value, found.low, found.high)
            writer.writerow((line.bar, line.what, line.asked, *numbers, line.verdict, int(line.detail), line.note))


def _table(rows: Sequence[Sequence[str]], head: Sequence[str]) -> list[str]:
    every = [head, ["---"] * len(head), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return ["| " + " | ".join(row) + " |" for row in every]
