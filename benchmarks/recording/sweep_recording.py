"""A recording of a sweep: how surfaces and errors change with what was varied, beside what theory expects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.console import Report
from benchmarks.recording.layout import Box, Flat, Part, Space
from benchmarks.recording.rerun_file import RerunFile, Times, rerun_file
from benchmarks.recording.run_recording import ABOUT, LOG, MOST_BYTES, log_answer, map_picture
from benchmarks.recording.scenery import (
    GREY,
    IMAGE_PX,
    PALE,
    at_repetition,
    curve_colour,
    eight_bits,
    log_cameras,
    log_scale,
    log_truth,
    log_view,
    scale_view,
    width_um,
)
from benchmarks.recording.surfaces import MOST_VERTICES, SURFACE_BYTES, answered
from benchmarks.recording.words import sweep_text
from benchmarks.reporting.error_maps import ErrorMap, Record, scene_maps
from benchmarks.reporting.report_scenes import truth_of
from benchmarks.reporting.report_sweeps import TABLE, read_rows
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import Case
from benchmarks.running.manifest import SWEEP_MANIFEST, MethodRecord, read_manifest
from benchmarks.sweeping.sweep_axes import Axis, axis_named
from benchmarks.sweeping.sweeps import Point, points_of
from semrecon.data import TiltSeries
from semrecon.errors import InputError

METRICS = {"median_um": "Median error (µm)", "completeness": "Completeness"}
THEORY = {"bound_um": ("Cramer-Rao bound", GREY), "predicted_um": ("predicted", PALE)}
"""Columns of the table of a sweep that stand beside the errors."""
IMAGES = ("least", "reference", "greatest")


@dataclass(frozen=True)
class SweptRecord:
    """A sweep on record: its results, axes and the variants, made again from the settings."""

    record: Record
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]

    @property
    def middle(self) -> tuple[float, ...]:
        """Values at which all axes stand but the one whose timeline is chosen."""
        return tuple(axis.values[len(axis.values) // 2] for axis in self.axes)

    @property
    def shown(self) -> tuple[Point, ...]:
        """Variants that stand on a timeline: at most one setting is off its middle."""
        return tuple(point for point in self.points if _off(point.values, self.middle) <= 1)

    def results(self, point: Point, method: str) -> list[Result]:
        """Results of a method at a point, by repetition."""
        mine = [each for each in self.record.results if (each.scene, each.method) == (point.scene.name, method)]
        return sorted(mine, key=lambda each: each.repetition)


def read_swept(folder: Path) -> SweptRecord:
    """Read the record of a sweep; raises `InputError` where there is none, or its scenes are not those of today."""
    if not (folder / LEDGER).is_file():
        raise InputError(f"--sweep {folder} holds no sweep; make one with: python -m benchmarks sweep --out {folder}")
    manifest, ledger = read_manifest(folder, SWEEP_MANIFEST), BenchLedger(folder / LEDGER)
    results = ledger.results([each.key for each in manifest.cases], manifest.judge)
    if not results:
        raise InputError(f"--sweep {folder} has no results yet; let the sweep go on")
    points = points_of(manifest.settings, folder / "cache", manifest.purpose)
    if [point.scene.identity for point in points] != [each.identity for each in manifest.scenes]:
        raise InputError(f"the simulator or a scene has changed since --sweep {folder} was made; repeat the sweep")
    axes = tuple(axis_named(each["name"], each["values"]) for each in manifest.settings["axes"])
    return SweptRecord(Record(folder, manifest, ledger, tuple(results)), axes, tuple(points))


def record_sweep(path: Path, swept: SweptRecord, report: Report, *, full: bool = False) -> int:
    """Write the recording of a sweep from answers on record; no method is called.

    Returns
    -------
    Size of the file in bytes.

    Raises
    ------
    InputError
        The truth as it is made today is not the one of the sweep.
    """
    maps = {}
    for point in swept.shown:
        maps[point.values] = scene_maps(swept.record, point.scene)
        report("error maps", 1, len(swept.shown))
    limit_um = float(np.median([each.limit_um for of_point in maps.values() for each in of_point.values()]))
    base = next(point for point in swept.points if point.values == swept.middle)
    series = truth_of(base.scene, 0).series
    with rerun_file(path, path.stem, layout(swept, series, maps), swept.axes[0].name) as file:
        _log_base(file, swept, base, limit_um, full=full)
        _log_numbers(file, swept)
        thinned = 1
        for point in swept.shown:
            thinned = max(thinned, _log_point(file, swept, point, maps[point.values], limit_um, full=full))
            report("drawing", 1, len(swept.shown))
        file.at()
        reasons = dict.fromkeys(f"- {each.method}: {each.failure}" for each in swept.record.results if each.kind)
        labels = {axis.name: axis.label for axis in swept.axes}
        middle = dict(zip(labels, swept.middle, strict=True))
        manifest = swept.record.manifest
        file.text(ABOUT, sweep_text(manifest, base.scene.about, labels, middle, list(reasons), limit_um, thinned))
    return path.stat().st_size


def layout(swept: SweptRecord, series: TiltSeries, maps: Mapping[tuple[float, ...], Mapping[str, ErrorMap]]) -> Part:
    """Surfaces on the left, one behind the other; words, curves and micrographs on the right."""
    names = [each.name for each in swept.record.methods if any(not of[each.name].failure for of in maps.values())]
    around = ("world/net", "world/views/**", "world/view/**")
    spaces = [Space(name, (f"world/answers/{name}/**", *around), width_um(series)) for name in names]
    truth = Space("truth", ("world/truth", *around[1:]), width_um(series))
    pictures = tuple(Flat("picture", name, f"maps/{name}") for name in names)
    together = (Box("grid", pictures, name="all error maps"),) if pictures else ()
    left = Box("down", (Box("tabs", (*spaces[:1], *together, *spaces[1:], truth)), scale_view()), (10, 1))
    words = Box("tabs", (Flat("text", "What this shows", ABOUT), Flat("log", "Failures", LOG)))
    plots = Box("tabs", tuple(Flat("series", said, f"metrics/{metric}") for metric, said in METRICS.items()))
    images = Box(
        "tabs", tuple(Flat("picture", f"{which} tilt", f"images/{which}") for which in ("reference", *IMAGES[::2]))
    )
    return Box("across", (left, Box("down", (words, plots, images))), (3, 2))


def place(axis: Axis, value: float) -> Times:
    """Place on the timeline of an axis: a count if all its values are whole, else a duration of so many seconds."""
    whole = all(float(each).is_integer() for each in axis.values)
    return {axis.name: int(value) if whole else float(value)}


def times_of(swept: SweptRecord, point: Point, repetition: int | None) -> Times:
    """Timelines on which a point stands: those of axes where all other settings are at their middle.

    Parameters
    ----------
    repetition
        Puts the middle point on the timeline of repetitions too; None leaves it out.
    """
    times: dict[str, float | int] = {}
    for axis, value, others in zip(swept.axes, point.values, _others(point.values), strict=True):
        if others == _others(swept.middle)[swept.axes.index(axis)]:
            times |= place(axis, value)
    return {**times, **at_repetition(repetition)} if repetition is not None and point.values == swept.middle else times


def _others(values: tuple[float, ...]) -> list[tuple[float, ...]]:
    return [values[:i] + values[i + 1 :] for i in range(len(values))]


def _off(values: tuple[float, ...], middle: tuple[float, ...]) -> int:
    return sum(one != other for one, other in zip(values, middle, strict=True))


def _log_base(file: RerunFile, swept: SweptRecord, base: Point, limit_um: float, *, full: bool) -> None:
    log_truth(file, truth_of(base.scene, 0), base.scene.source.truth(), full=full)
    log_scale(file, limit_um)
    for number, method in enumerate(swept.record.methods):
        for metric in METRICS:
            for path, name in _curves(swept, metric, method.name):
                file.series(path, name, curve_colour(number))
    for column, (name, colour) in THEORY.items():
        for path, said in _curves(swept, "median_um", column, name):
            file.series(path, said, colour)


def _curves(swept: SweptRecord, metric: str, name: str, said: str = "") -> list[tuple[str, str]]:
    """Paths and names of the curves of a method: one, or for two axes one for each value of the other."""
    if len(swept.axes) == 1:
        return [(f"metrics/{metric}/{name}", said or name)]
    return [
        (_curve_path(metric, name, axis, value), f"{said or name}, {axis.name} {value:g}")
        for axis in swept.axes
        for value in axis.values
    ]


def _curve_path(metric: str, name: str, axis: Axis, value: float) -> str:
    return f"metrics/{metric}/{name}/{axis.name}/{value:g}"


def _log_numbers(file: RerunFile, swept: SweptRecord) -> None:
    """Write means over the repetitions on the timelines of the axes, and each repetition at the middle point."""
    theory = dict(_theory(swept))
    for point in swept.points:
        for method in swept.record.methods:
            found = swept.results(point, method.name)
            for metric in METRICS:
                values = np.array([each.metrics.get(metric, math.nan) for each in found])
                known = values[np.isfinite(values)]
                _log_mean(file, swept, point, metric, method.name, float(known.mean()) if known.size else math.nan)
        for column in THEORY:
            expected = theory.get(point.values, {}).get(column, math.nan)
            _log_mean(file, swept, point, "median_um", column, expected)


def _log_mean(file: RerunFile, swept: SweptRecord, point: Point, metric: str, name: str, value: float) -> None:
    if len(swept.axes) == 1:
        file.at(place(swept.axes[0], point.values[0]))
        file.number(f"metrics/{metric}/{name}", value)
        return
    for one, other in ((0, 1), (1, 0)):
        file.at(place(swept.axes[one], point.values[one]))
        file.number(_curve_path(metric, name, swept.axes[other], point.values[other]), value)


def _theory(swept: SweptRecord) -> Iterator[tuple[tuple[float, ...], dict[str, float]]]:
    """Read what theory expects from the table of the sweep; nothing where the sweep was not finished."""
    if not (swept.record.run / TABLE).is_file():
        return
    for row in read_rows(swept.record.run / TABLE).rows:
        values = tuple(float(row[axis.name]) for axis in swept.axes)
        yield values, {column: float(row.get(column) or math.nan) for column in THEORY}


def _log_point(
    file: RerunFile, swept: SweptRecord, point: Point, maps: Mapping[str, ErrorMap], limit_um: float, *, full: bool
) -> int:
    """Write micrographs, maps and surfaces of a variant; return how much surfaces were thinned."""
    ground, series = point.scene.source.truth(), truth_of(point.scene, 0).series
    file.at(times_of(swept, point, 0))
    log_cameras(file, series, ground)
    log_view(file, series, series.reference, ground)
    views = (int(np.argmin(series.tilts_deg)), series.reference, int(np.argmax(series.tilts_deg)))
    for which, view in zip(IMAGES, views, strict=True):
        file.picture(f"images/{which}", eight_bits(series.views[view].image, IMAGE_PX))
    thinned = 1
    for method in swept.record.methods:
        found = swept.results(point, method.name)
        chosen = next((each for each in found if not each.kind), found[0] if found else None)
        for each in found:
            if each is not chosen and point.values != swept.middle:
                continue
            file.at(times_of(swept, point, each.repetition) if each is chosen else at_repetition(each.repetition))
            thinned = max(thinned, _log_result(file, swept, point, method, each, limit_um, full=full))
            if each is chosen:
                _log_map(file, method.name, maps[method.name], limit_um)
    return thinned


def _log_map(file: RerunFile, name: str, found: ErrorMap, limit_um: float) -> None:
    if found.failure:
        file.clear(f"maps/{name}")
    else:
        file.picture(f"maps/{name}", map_picture(replace(found, limit_um=limit_um)))


def _log_result(
    file: RerunFile,
    swept: SweptRecord,
    point: Point,
    method: MethodRecord,
    result: Result,
    limit_um: float,
    *,
    full: bool,
) -> int:
    truth, answer = truth_of(point.scene, result.repetition), None
    if not result.kind:
        blob = swept.record.ledger.answer(Case(point.scene, method, result.repetition, result.key)).estimate
        ground = point.scene.source.truth()
        answer = answered(blob, truth, ground, method.gauge, 1 << 40 if full else _share_bytes(swept))
    if answer is None:
        said = result.failure or "makes no surface"
        file.message(LOG, f"{method.name}, {point.scene.name}, repetition {result.repetition + 1}: {said}")
        file.clear(f"world/answers/{method.name}")
        return 1
    log_answer(file, method.name, answer, limit_um, truth.series.optics.pixel_size_um)
    return answer.thinned


def _share_bytes(swept: SweptRecord) -> int:
    """Share among all surfaces what the whole file may take."""
    surfaces = len(swept.record.methods) * (len(swept.shown) + swept.record.manifest.repetitions)
    return min(MOST_VERTICES * SURFACE_BYTES, MOST_BYTES // max(1, surfaces))


def narrowed_sweep(swept: SweptRecord, methods: Sequence[str]) -> SweptRecord:
    """Keep the results of some methods only, all if none is named."""
    kept = tuple(each for each in swept.record.results if not methods or each.method in methods)
    return replace(swept, record=replace(swept.record, results=kept))
