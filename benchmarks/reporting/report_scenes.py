"""Sections of the report on scenes: what was photographed, what each method made of it, and where it is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.judging.efficiency import SceneLimit
from benchmarks.judging.judge import filled, grid_um
from benchmarks.reporting.convergence_figure import History, convergence_plot
from benchmarks.reporting.leaderboard import MARK, Entry
from benchmarks.reporting.report_figures import (
    Figure,
    Panel,
    error_curves,
    error_panel,
    height_panel,
    limit_panel,
    micrograph,
)
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import Case
from benchmarks.running.manifest import MethodRecord, SceneRecord
from benchmarks.running.stored import unpacked
from benchmarks.suite import BenchScene
from semrecon.data import Array, Mask, TiltSeries
from semrecon.judging.gauge import gauge_fit, gauge_residual
from semrecon.numerics.history import histories

HELD_PERCENT = 90.0
"""The colours of errors end where so many percent of the errors of the middle method do."""
CHANGED = (
    "The simulator has changed since this run, so its pictures cannot be made again; the numbers are those on record. "
    "Repeat the run to have both."
)
ABSENT = "The specimen of this scene is not at hand, so there are no pictures; the numbers are those on record."


@dataclass(frozen=True)
class Card:
    """A method on a scene: its numbers, and its pictures where it answered."""

    entry: Entry
    heights: Panel | None = None
    errors: Panel | None = None

    @property
    def oracle(self) -> bool:
        """Whether it was handed part of the truth."""
        return self.entry.method.endswith(MARK)


@dataclass(frozen=True)
class Section:
    """A scene: pictures of what is true, and a card a method; `note` says why there are no pictures."""

    name: str
    about: str
    cards: tuple[Card, ...]
    note: str = ""
    image: Panel | None = None
    truth: Panel | None = None
    judged: float = float("nan")
    limit: SceneLimit | None = None
    limit_map: Panel | None = None
    curves: Figure | None = None
    convergence: Figure | None = None


@dataclass(frozen=True)
class Drawn:
    """What is drawn of an answer.

    Parameters
    ----------
    heights_um, errors_um
        On the grid of the reference view: heights without their gauge, and errors.
    histories
        How its iterations converged, where the method keeps that.
    """

    heights_um: Array
    errors_um: Array
    histories: tuple[History, ...] = ()


@dataclass(frozen=True)
class Truth:
    """What answers to one repetition of a scene are held against."""

    series: TiltSeries
    z_um: Array
    judged: Mask

    @property
    def wanted_um(self) -> Array:
        """True heights where they are judged, else NaN."""
        return np.where(self.judged, self.z_um, np.nan)


def section(
    record: SceneRecord,
    scene: BenchScene | None,
    entries: Sequence[Entry],
    results: Sequence[Result],
    methods: Mapping[str, MethodRecord],
    ledger: BenchLedger,
) -> Section:
    """Make the section of a scene from its answers on record; each method shows its first repetition with an answer.

    Parameters
    ----------
    scene
        The scene as it is today; None where its specimen is not at hand.
    entries, results
        Of this scene.
    """
    limit = ledger.limit(record.identity)
    if scene is None or scene.identity != record.identity:
        note = ABSENT if scene is None else CHANGED
        return Section(record.name, record.about, tuple(Card(each) for each in entries), note, limit=limit)
    truth = truth_of(scene, 0)
    drawn = dict(_drawn(scene, results, methods, ledger))
    levels = tuple(float(level) for level in np.nanpercentile(truth.z_um, [0.5, 99.5]))
    limit_um = error_limit([each.errors_um for each in drawn.values()])
    cards = tuple(_card(entry, drawn.get(name_of(entry)), truth, (levels[0], levels[1]), limit_um) for entry in entries)
    reference, size = truth.series.views[truth.series.reference], truth.series.optics.pixel_size_um
    answered = {entry.method: drawn[name_of(entry)] for entry in entries if name_of(entry) in drawn}
    curves = {name: each.errors_um for name, each in answered.items()}
    iterated = {name: each.histories for name, each in answered.items()}
    numbers = {name: number for number, name in enumerate(methods)}
    places = {entry.method: numbers[name_of(entry)] for entry in entries}
    return Section(
        record.name,
        record.about,
        cards,
        "",
        micrograph(reference.image, size, f"Micrograph of {record.name} at {reference.tilt_deg:g} degrees"),
        height_panel(truth.z_um, (levels[0], levels[1]), size, f"True heights of {record.name}"),
        float(truth.judged.mean()),
        limit,
        None if limit is None or limit.reason else limit_panel(limit.sigma_um, size, f"Limit of {record.name}"),
        error_curves(curves, int(truth.judged.sum()), places, limit) if curves else None,
        convergence_plot(iterated, places),
    )


def name_of(entry: Entry) -> str:
    """Name of the method without the mark of an oracle."""
    return entry.method.removesuffix(MARK).strip()


def truth_of(scene: BenchScene, repetition: int) -> Truth:
    """Photograph a repetition again, and say what is true and what all views see of it."""
    series = scene.series(repetition)
    view = series.reference
    others = (each for each in range(len(series)) if each != view)
    judged = scene.source.judgeable((view, *others), 1)
    return Truth(series, scene.source.truth().height_map(view), judged)


def drawn_answer(blob: bytes, truth: Truth, gauge: Sequence[str]) -> Drawn | None:
    """Take an answer from its stored form as the judge does: the median of |errors| is the number in the tables."""
    estimate = unpacked(blob)
    heights = estimate.heights or filled(estimate, truth.series)
    if heights is None or heights.z_um.shape != truth.judged.shape:
        return None
    xy = grid_um(truth.judged.shape, truth.series.optics.pixel_size_um)
    declared = tuple(gauge)
    fit = gauge_fit(heights.z_um, truth.wanted_um, declared, xy, "absolute", narrower=False)  # type: ignore[arg-type]
    errors = gauge_residual(heights.z_um, truth.wanted_um, declared, xy, "absolute")  # type: ignore[arg-type]
    aligned = heights.z_um if fit is None else fit.error(heights.z_um, np.zeros(truth.judged.shape), xy)
    return Drawn(aligned, errors, tuple(histories(estimate.diagnostics)))


def error_limit(errors_um: Sequence[Array]) -> float:
    """End of the colours of all error maps of a scene, um: two digits of a percentile of the method in the middle."""
    ends = [np.nanpercentile(np.abs(each), HELD_PERCENT) for each in errors_um if np.isfinite(each).any()]
    return max(float(f"{np.median(ends):.2g}"), 1e-6) if ends else 1.0


def _drawn(
    scene: BenchScene, results: Sequence[Result], methods: Mapping[str, MethodRecord], ledger: BenchLedger
) -> Iterator[tuple[str, Drawn]]:
    first: dict[str, Result] = {}
    for each in sorted(results, key=lambda each: each.repetition):
        if not each.kind:
            first.setdefault(each.method, each)
    truths = {repetition: truth_of(scene, repetition) for repetition in {each.repetition for each in first.values()}}
    for name, each in first.items():
        answer = ledger.answer(Case(scene, methods[name], each.repetition, each.key))
        found = drawn_answer(answer.estimate, truths[each.repetition], methods[name].gauge)
        if found is not None:
            yield name, found


def _card(entry: Entry, drawn: Drawn | None, truth: Truth, levels: tuple[float, float], limit_um: float) -> Card:
    if drawn is None:
        return Card(entry)
    size = truth.series.optics.pixel_size_um
    what = f"{name_of(entry)} on {entry.scene}"
    heights = height_panel(drawn.heights_um, levels, size, f"Heights by {what}")
    errors = error_panel(drawn.errors_um, truth.judged, limit_um, size, f"Depth errors of {what}")
    return Card(entry, heights, errors)
