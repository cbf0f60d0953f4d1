"""The report: one HTML page that needs nothing else, made from the ledger of a run and from tables of sweeps."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from benchmarks.reporting.leaderboard import HEADINGS, Entry, entries, limit_notes, notes
from benchmarks.reporting.report_figures import Figure, distance_plot, plotly_packed, said
from benchmarks.reporting.report_scenes import Section, name_of, section
from benchmarks.reporting.report_sweeps import SweepSection, sweep_section
from benchmarks.running.bench import LEDGER, Report
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.bounds import reasons
from benchmarks.running.manifest import Manifest, MethodRecord, commit, read_manifest
from benchmarks.running.read_only import check_target
from benchmarks.suite import BenchScene, suite
from semrecon.errors import InputError

TEMPLATES = Path(__file__).resolve().parent / "templates"
PAGE = "report.html"
OVERVIEW = {
    "median_um": "median error (µm), declared gauge removed",
    "efficiency": "efficiency: that error over the physical limit",
    "common_median_um": "median error (µm), common gauge removed",
    "rms_um": "rms error (µm), declared gauge removed",
    "completeness": "completeness",
    "fscore_1px": "F-score at 1 px",
    "seconds": "seconds",
}
"""What the table over all scenes can show."""
KINDS = {
    "needs": "does not apply",
    "refused": "refused",
    "timeout": "out of time",
    "memory": "out of memory",
    "crash": "crashed",
    "bug": "broke off",
}


@dataclass(frozen=True)
class Failure:
    """Why a method has no answer on a scene, and in how many repetitions."""

    scene: str
    method: str
    kind: str
    sentence: str
    count: int


@dataclass(frozen=True)
class Content:
    """All that the page shows."""

    manifest: Manifest
    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    limits: tuple[str, ...]
    sections: tuple[Section, ...]
    failures: tuple[Failure, ...]
    sweeps: tuple[SweepSection, ...]
    unanswered: int
    distances: Figure | None = None


def write_report(run: Path, out: Path, sweeps: Sequence[Path], report: Report) -> int:
    """Write the page and return its size in bytes; it is there as a whole or not at all.

    Raises
    ------
    InputError
        `run` holds no run, a folder of `sweeps` no sweep, or `out` is a folder.
    """
    if out.is_dir():
        raise InputError(f"--out {out} is a folder; name a file, such as {out / PAGE}")
    check_target("--out", out)
    page = rendered(content(run, sweeps, report)).encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f"{out.name}.{os.getpid()}.partial")
    partial.write_bytes(page)
    partial.replace(out)
    return len(page)


def content(run: Path, sweeps: Sequence[Path], report: Report) -> Content:
    """Gather what the page shows; no method is called. Parameters and errors are those of `write_report`."""
    if not (run / LEDGER).is_file():
        raise InputError(f"--run {run} holds no run; make one: python -m benchmarks run --out {run}")
    manifest, ledger = read_manifest(run), BenchLedger(run / LEDGER)
    swept = tuple(sweep_section(folder) for folder in sweeps)
    results = ledger.results([each.key for each in manifest.cases], manifest.judge)
    every = entries(results, manifest.methods)
    reading = notes(results, any(each.given for each in manifest.methods))
    sections = tuple(_sections(run, manifest, every, results, ledger, report))
    lacking = len(manifest.cases) - len(results)
    limits = tuple(limit_notes(reasons([(each.name, each.identity) for each in manifest.scenes], ledger)))
    failed, far = tuple(failures(results)), distances(every, manifest)
    return Content(manifest, tuple(every), tuple(reading), limits, sections, failed, swept, lacking, far)


def failures(results: Sequence[Result]) -> Iterator[Failure]:
    """Count failures that say the same, in the order in which they come."""
    counts: dict[tuple[str, str, str, str], int] = {}
    for each in results:
        if each.kind:
            what = (each.scene, each.method, KINDS.get(each.kind, each.kind), each.failure)
            counts[what] = counts.get(what, 0) + 1
    return (Failure(*what, count) for what, count in counts.items())


def distances(every: Sequence[Entry], manifest: Manifest) -> Figure | None:
    """Draw how far from the limit each method is on each scene; None where no limit is on record."""
    if not any(np.isfinite(each.values["efficiency"]) for each in every):
        return None
    scenes = [each.name for each in manifest.scenes]
    numbers = {each.name: number for number, each in enumerate(manifest.methods)}
    by_place = {(each.method, each.scene): each.values["efficiency"] for each in every}
    marked = sorted({each.method: numbers[name_of(each)] for each in every}.items(), key=lambda item: item[1])
    found = {name: [by_place.get((name, scene), np.nan) for scene in scenes] for name, _ in marked}
    return distance_plot(found, [words(scene) for scene in scenes], dict(marked))


def rendered(found: Content) -> str:
    """Write the page; all text is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "number": said,
        "exact": exact,
        "plain_name": name_of,
        "words": words,
        "breakable": breakable,
    }
    figures = [figure for each in found.sections for figure in (each.curves, each.convergence) if figure]
    figures += [found.distances] if found.distances else []
    figures += [figure for sweep in found.sweeps for _, figure in sweep.figures]
    return environment.get_template("report.html").render(
        found=found,
        headings=HEADINGS,
        overview=overview(found.entries),
        metrics=OVERVIEW,
        needs=sorted({need for each in found.manifest.methods for need in each.needs}),
        plotly=plotly_packed() if figures else "",
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        code=commit(),
        css=(TEMPLATES / "report.css").read_text(encoding="utf-8"),
        script=(TEMPLATES / "report.js").read_text(encoding="utf-8"),
    )


def overview(every: Sequence[Entry]) -> dict[str, list[Entry | None]]:
    """Arrange entries with a method a line and a scene a column."""
    scenes = list(dict.fromkeys(each.scene for each in every))
    by_place = {(each.method, each.scene): each for each in every}
    return {
        method: [by_place.get((method, scene)) for scene in scenes]
        for method in dict.fromkeys(each.method for each in every)
    }


def exact(value: float) -> str:
    """Say a number for sorting; "" for what is none, which sorts last."""
    return f"{value:.9g}" if np.isfinite(value) else ""


def breakable(name: str) -> str:
    """Let a browser break a long name behind its underscores; all else is escaped."""
    from markupsafe import Markup, escape

    return Markup("_<wbr>").join(escape(part) for part in name.split("_"))


def words(name: str) -> str:
    """Say an identifier for people."""
    return name.replace("_", " ")


def _sections(
    run: Path,
    manifest: Manifest,
    every: Sequence[Entry],
    results: Sequence[Result],
    ledger: BenchLedger,
    report: Report,
) -> Iterator[Section]:
    scenes = {each.name: each for each in suite(run / "cache", quick=manifest.quick, purpose=manifest.purpose)}
    methods: Mapping[str, MethodRecord] = {each.name: each for each in manifest.methods}
    for record in manifest.scenes:
        scene: BenchScene | None = scenes.get(record.name)
        of_scene = [each for each in every if each.scene == record.name]
        mine = [each for each in results if each.scene == record.name]
        yield section(record, scene, of_scene, mine, methods, ledger)
        report("drawing scenes", 1, len(manifest.scenes))
