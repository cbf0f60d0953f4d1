"""A recording of one scene of a run: what each method made of it, where that is wrong, and how it was photographed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.layout import Box, Flat, Part, Space
from benchmarks.recording.rerun_file import RerunFile, rerun_file
from benchmarks.recording.scenery import (
    BLUE,
    REFERENCE_TIMELINE,
    at_repetition,
    at_tilt,
    curve_colour,
    log_beams,
    log_cameras,
    log_scale,
    log_truth,
    log_view,
    scale_view,
    true_poses,
    width_um,
)
from benchmarks.recording.surfaces import MOST_VERTICES, SURFACE_BYTES, Answered, answered, error_colours
from benchmarks.recording.words import results_table, run_text
from benchmarks.reporting.error_maps import ErrorMap, Record, scene_maps
from benchmarks.reporting.leaderboard import MARK
from benchmarks.reporting.report_figures import MISSING, UNJUDGED
from benchmarks.reporting.report_scenes import Truth, truth_of
from benchmarks.running.bench_ledger import Result
from benchmarks.running.case import Case
from benchmarks.running.manifest import MethodRecord, SceneRecord
from benchmarks.suite import BenchScene
from semrecon.data import Poses
from semrecon.output.glance import tilts_of
from semsim.truth import GroundTruth

MOST_BYTES = 24_000_000
"""That surfaces and clouds of a recording may take before they are compressed; each answer has an equal share."""
METRICS = {"median_um": "Median error (µm)", "completeness": "Completeness", "seconds": "Seconds"}
"""Series over the repetitions, and their titles."""
TILT_ERROR = "tilt_error_deg"
ABOUT, LOG = "about", "failures"


@dataclass(frozen=True)
class Shown:
    """A scene and all that is shown of it; `maps` are in the order of their medians, those without at the end."""

    record: Record
    scene: BenchScene
    about: SceneRecord
    maps: Mapping[str, ErrorMap]
    truths: Mapping[int, Truth]
    ground: GroundTruth
    full: bool

    @property
    def results(self) -> tuple[Result, ...]:
        """Of this scene, by repetition."""
        mine = [each for each in self.record.results if each.scene == self.scene.name]
        return tuple(sorted(mine, key=lambda each: each.repetition))

    @property
    def limit_um(self) -> float:
        """End of the colours."""
        return next(iter(self.maps.values())).limit_um

    @property
    def share_bytes(self) -> int:
        """That one answer may take."""
        if self.full:
            return 1 << 40
        answers = sum(not each.kind for each in self.results)
        return min(MOST_VERTICES * SURFACE_BYTES, MOST_BYTES // max(1, answers))

    def method(self, name: str) -> MethodRecord:
        """Find what tables say of a method."""
        return next(each for each in self.record.methods if each.name == name)

    def label(self, name: str) -> str:
        """Name a method for people; what is handed part of the truth is marked."""
        return f"{name} {MARK}" if self.method(name).given else name

    def titled(self, name: str) -> str:
        """Name a method with its median error."""
        return f"{self.label(name)} ({self.maps[name].median_um:.3g} µm)"

    def number(self, name: str) -> int:
        """Place of a method in the run, which gives its colour."""
        return [each.name for each in self.record.methods].index(name)


def record_scene(path: Path, record: Record, scene: BenchScene, *, full: bool = False) -> int:
    """Write the recording of a scene from answers on record; no method is called.

    Parameters
    ----------
    full
        Every height and point on record, whatever size that makes.

    Returns
    -------
    Size of the file in bytes.

    Raises
    ------
    InputError
        The truth as it is made today is not the one of the run.
    """
    shown = gathered(record, scene, full=full)
    with rerun_file(path, f"{scene.name}", layout(shown), REFERENCE_TIMELINE) as file:
        _log_scene(file, shown)
        thinned = [_log_method(file, shown, name) for name in shown.maps]
        file.at()
        table = results_table(shown.results, {name: shown.label(name) for name in shown.maps}, METRICS)
        file.text(ABOUT, run_text(shown.about, record.manifest, table, shown.limit_um, max(thinned, default=1)))
    return path.stat().st_size


def gathered(record: Record, scene: BenchScene, *, full: bool) -> Shown:
    """Make error maps and truths of a scene; raises as `record_scene`."""
    maps = scene_maps(record, scene)
    order = sorted(maps, key=lambda name: (not math.isfinite(maps[name].median_um), maps[name].median_um))
    about = next(each for each in record.manifest.scenes if each.name == scene.name)
    repetitions = sorted({each.repetition for each in record.results if each.scene == scene.name}) or [0]
    truths = {each: truth_of(scene, each) for each in repetitions}
    return Shown(record, scene, about, {name: maps[name] for name in order}, truths, scene.source.truth(), full)


def layout(shown: Shown) -> Part:
    """Surfaces on the left, one behind the other, the best on top; words, numbers and micrographs on the right."""
    plots = tuple(Flat("series", said, f"metrics/{metric}") for metric, said in METRICS.items())
    tilts = Flat("series", "Tilt error (deg) over tilt", f"metrics/{TILT_ERROR}")
    over = Box("down", plots, name="Numbers over repetition")
    words = Box("tabs", (Flat("text", "What this shows", ABOUT), Flat("log", "Failures", LOG), over, tilts))
    micrograph = Flat("picture", "Micrograph at this tilt, or of this repetition", "micrograph")
    left = Box("down", (_spaces(shown), scale_view()), (10, 1))
    return Box("across", (left, Box("down", (words, micrograph), (3, 2))), (3, 2))


def _spaces(shown: Shown) -> Part:
    """Tabs: a method each, all error maps behind the first of them, and the truth last."""
    truth = next(iter(shown.truths.values()))
    where = (width_um(truth.series), (0.0, 0.0, float(np.nanmedian(truth.z_um))))
    names = [name for name, each in shown.maps.items() if not each.failure]
    views = ("world/views/**", "world/view/**")
    spaces = [
        Space(shown.titled(name), (f"world/answers/{name}/**", f"world/found/{name}", "world/net", *views), *where)
        for name in names
    ]
    maps = tuple(Flat("picture", shown.titled(name), f"maps/{name}") for name in names)
    together = (Box("grid", maps, name="all error maps"),) if maps else ()
    return Box("tabs", (*spaces[:1], *together, *spaces[1:], Space("truth", ("world/truth", *views), *where)))


def _log_scene(file: RerunFile, shown: Shown) -> None:
    """Write what does not depend on a method."""
    first = next(iter(shown.truths.values()))
    log_truth(file, first, shown.ground, full=shown.full)
    log_cameras(file, first.series, shown.ground)
    log_scale(file, shown.limit_um)
    for view, tilt in enumerate(first.series.tilts_deg):
        file.at(at_tilt(tilt))
        log_view(file, first.series, view, shown.ground)
    for repetition, truth in shown.truths.items():
        file.at(at_repetition(repetition))
        log_view(file, truth.series, truth.series.reference, shown.ground)


def _log_method(file: RerunFile, shown: Shown, name: str) -> int:
    """Write answers, failures and numbers of a method; return how much its surfaces were thinned."""
    file.at()
    colour = curve_colour(shown.number(name))
    for metric in (*METRICS, TILT_ERROR):
        file.series(f"metrics/{metric}/{name}", name, colour)
    if not shown.maps[name].failure:
        file.picture(f"maps/{name}", map_picture(shown.maps[name]))
    mine = [each for each in shown.results if each.method == name]
    chosen = next((each for each in mine if not each.kind), mine[0] if mine else None)
    thinned = 1
    for each in mine:
        first = float(shown.truths[each.repetition].series.tilts_deg.min())
        file.at({**at_repetition(each.repetition), **(at_tilt(first) if each is chosen else {})})
        answer = _log_result(file, shown, each)
        if answer is not None:
            thinned = max(thinned, answer.thinned)
        if answer is not None and answer.poses is not None and each is chosen:
            _log_tilts(file, shown, each, answer.poses)
    return thinned


def _log_result(file: RerunFile, shown: Shown, result: Result) -> Answered | None:
    """Write one answer, or the sentence that stands for it."""
    name, method, truth = result.method, shown.method(result.method), shown.truths[result.repetition]
    for metric in METRICS:
        value = result.seconds if metric == "seconds" else result.metrics.get(metric, math.nan)
        file.number(f"metrics/{metric}/{name}", value)
    answer = None
    if not result.kind:
        blob = shown.record.ledger.answer(Case(shown.scene, method, result.repetition, result.key)).estimate
        answer = answered(blob, truth, shown.ground, method.gauge, shown.share_bytes)
    if answer is None:
        file.message(LOG, f"{name}, repetition {result.repetition + 1}: {result.failure or 'makes no surface'}")
        file.clear(f"world/answers/{name}")
        return None
    log_answer(file, name, answer, shown.limit_um, truth.series.optics.pixel_size_um)
    return answer


def log_answer(file: RerunFile, name: str, answer: Answered, limit_um: float, pixel_size_um: float) -> None:
    """Write surface and points of an answer, coloured by their errors."""
    if answer.surface is not None:
        found = answer.surface
        colours = error_colours(found.error_um, limit_um)
        file.surface(f"world/answers/{name}/surface", found.xyz_um, found.faces, colours)
    if answer.cloud is not None:
        colours = error_colours(answer.cloud.error_um, limit_um)
        file.points(f"world/answers/{name}/points", answer.cloud.xyz_um, colours, 1.5 * pixel_size_um)


def map_picture(found: ErrorMap) -> NDArray[np.uint8]:
    """Colour an error map; where errors are not judged it is dark."""
    colours = error_colours(found.error_um.astype(np.float64), found.limit_um)
    missing = ~np.isfinite(found.error_um) & found.judged
    colours[missing] = MISSING
    colours[~found.judged] = UNJUDGED
    return colours


def _log_tilts(file: RerunFile, shown: Shown, result: Result, found: Poses) -> None:
    """Write the beams as a method found them, and how far its tilts are off at each view, from the reference view."""
    series, name = shown.truths[result.repetition].series, result.method
    if len(found) != len(series) or not np.isfinite(found.rotations).all():
        return
    file.at()
    log_beams(file, f"world/found/{name}", found, width_um(series), BLUE)
    axis, reference = series.tilt_axis_deg, series.reference
    tilts, true = (tilts_of(each, axis) for each in (found, true_poses(shown.ground)))
    errors = [sign * (tilts - tilts[reference]) - (true - true[reference]) for sign in (1.0, -1.0)]
    mirrored = "mirror" in shown.method(name).gauge
    error = min(errors if mirrored else errors[:1], key=lambda each: float(np.abs(each).sum()))
    for tilt, value in zip(series.tilts_deg, error, strict=True):
        file.at(at_tilt(float(tilt)))
        file.number(f"metrics/{TILT_ERROR}/{name}", float(value))


def narrowed(record: Record, methods: Sequence[str]) -> Record:
    """Keep the results of some methods only, all if none is named."""
    if not methods:
        return record
    return replace(record, results=tuple(each for each in record.results if each.method in methods))
