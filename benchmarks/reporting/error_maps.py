"""Error maps of a run on record: for each method and scene where its heights are wrong, or why it has none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.console import Report
from benchmarks.reporting.report_scenes import Truth, drawn_answer, error_limit, truth_of
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import Case
from benchmarks.running.manifest import Manifest, MethodRecord, read_manifest
from benchmarks.suite import BenchScene, suite
from semrecon.data import Array, Mask
from semrecon.errors import InputError

TILE_PX = 320
"""Most columns of a map: finer ones are thinned, not averaged, so that noise stays as large as it is."""
AGREE = 1e-6
"""Relative difference from the score on record beyond which the truth is not that of the run."""
ALONE = ("offset",)
"""The gauge of all that know their tilts: no method has an absolute height."""
NOT_RUN = "was not run on this scene"


@dataclass(frozen=True)
class ErrorMap:
    """What one method did on one scene.

    Parameters
    ----------
    error_um
        Estimated minus true height after the declared gauge is removed, thinned, (rows, columns); NaN where there is
        none. Empty if there is no answer.
    judged
        Where errors count: what all views see, of the same shape.
    pixel_size_um
        Of the thinned map.
    median_um, completeness
        Of the map before it was thinned.
    offset_only_um
        Median absolute error if an offset alone is removed, whatever else is declared: what a user would meet.
    failure
        Why there is no answer; "" if there is one.
    limit_um
        End of the colours, the same for all methods on the scene.
    """

    scene: str
    error_um: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0), dtype=np.float32))
    judged: Mask = field(default_factory=lambda: np.empty((0, 0), dtype=bool))
    pixel_size_um: float = float("nan")
    median_um: float = float("nan")
    completeness: float = 0.0
    offset_only_um: float = float("nan")
    failure: str = ""
    limit_um: float = float("nan")


@dataclass(frozen=True)
class Strip:
    """All scenes of one method."""

    method: MethodRecord
    maps: tuple[ErrorMap, ...]


@dataclass(frozen=True)
class Record:
    """A finished run: what it was of, and its results."""

    run: Path
    manifest: Manifest
    ledger: BenchLedger
    results: tuple[Result, ...]

    @property
    def methods(self) -> tuple[MethodRecord, ...]:
        """Methods that have at least one result."""
        seen = {each.method for each in self.results}
        return tuple(each for each in self.manifest.methods if each.name in seen)


def read_run(run: Path) -> Record:
    """Read the record of a run; raises `InputError` where there is none, or nothing in it yet."""
    if not (run / LEDGER).is_file():
        raise InputError(f"--run {run} holds no run; make one with: python -m benchmarks run --out {run}")
    manifest, ledger = read_manifest(run), BenchLedger(run / LEDGER)
    results = ledger.results([each.key for each in manifest.cases], manifest.judge)
    if not results:
        raise InputError(f"--run {run} has no results yet; go on with: python -m benchmarks run --out {run}")
    return Record(run, manifest, ledger, tuple(results))


def strips(record: Record, report: Report) -> list[Strip]:
    """Make the error maps of every method that was run, from answers on record: no method is called.

    Raises
    ------
    InputError
        A specimen is not at hand, or the truth as it is made now is not the one of the run.
    """
    manifest = record.manifest
    known = {each.name: each for each in suite(record.run / "cache", quick=manifest.quick, purpose=manifest.purpose)}
    maps: dict[str, list[ErrorMap]] = {each.name: [] for each in record.methods}
    for scene in manifest.scenes:
        if scene.name not in known:
            raise InputError(f"the specimen of {scene.name} is not at hand; set SEM_REAL_DATA as it was for the run")
        for name, found in scene_maps(record, known[scene.name]).items():
            maps[name].append(found)
        report("scenes", 1, len(manifest.scenes))
    return [Strip(each, tuple(maps[each.name])) for each in record.methods]


def scene_maps(record: Record, scene: BenchScene) -> dict[str, ErrorMap]:
    """Make the map of each method on a scene, of its first repetition with an answer; colours end alike in all."""
    of_scene = sorted((one for one in record.results if one.scene == scene.name), key=lambda one: one.repetition)
    chosen: dict[str, Result] = {}
    for one in of_scene:
        if one.method not in chosen or (chosen[one.method].kind and not one.kind):
            chosen[one.method] = one
    made = list(_maps(record, scene, chosen))
    found = {name: one for name, one, _ in made}
    limit = error_limit([errors_um for _, _, errors_um in made])
    return {
        each.name: replace(found.get(each.name, ErrorMap(scene.name, failure=NOT_RUN)), limit_um=limit)
        for each in record.methods
    }


def _maps(record: Record, scene: BenchScene, chosen: Mapping[str, Result]) -> Iterator[tuple[str, ErrorMap, Array]]:
    """Yield name, map and, for the colours, the errors before they were thinned."""
    truths: dict[int, Truth] = {}
    for method in record.methods:
        result = chosen.get(method.name)
        if result is None:
            continue
        if result.kind:
            yield method.name, ErrorMap(scene.name, failure=result.failure), np.empty((0, 0))
            continue
        if result.repetition not in truths:
            truths[result.repetition] = truth_of(scene, result.repetition)
        answer = record.ledger.answer(Case(scene, method, result.repetition, result.key))
        yield method.name, *_judged(record, method, result, answer.estimate, truths[result.repetition])


def _judged(
    record: Record, method: MethodRecord, result: Result, estimate: bytes, truth: Truth
) -> tuple[ErrorMap, Array]:
    """Hold an answer against the truth: its map, and the errors before it was thinned."""
    drawn = drawn_answer(estimate, truth, method.gauge)
    if drawn is None:
        return ErrorMap(result.scene, failure="its points make no surface"), np.empty((0, 0))
    found = error_map(result.scene, drawn.errors_um, truth.judged, truth.series.optics.pixel_size_um)
    _check(record, result, found)
    plain = drawn if method.gauge == ALONE else drawn_answer(estimate, truth, ALONE)
    alone_um = float("nan") if plain is None else _median(plain.errors_um, truth.judged)
    return replace(found, offset_only_um=alone_um), drawn.errors_um


def error_map(scene: str, errors_um: Array, judged: Mask, pixel_size_um: float) -> ErrorMap:
    """Thin a map for a picture; its numbers are those of all of it.

    Parameters
    ----------
    errors_um
        Errors on the grid of the reference view, um, (rows, columns); NaN where there is no height or none counts.
    judged
        Where errors count.
    """
    every = -(-errors_um.shape[1] // TILE_PX)
    counted = judged & np.isfinite(errors_um)
    return ErrorMap(
        scene,
        errors_um[::every, ::every].astype(np.float32),
        judged[::every, ::every],
        pixel_size_um * every,
        _median(errors_um, judged),
        int(counted.sum()) / max(1, int(judged.sum())),
    )


def _median(errors_um: Array, judged: Mask) -> float:
    known = np.abs(errors_um[judged & np.isfinite(errors_um)])
    return float(np.median(known)) if known.size else float("nan")


def _check(record: Record, result: Result, found: ErrorMap) -> None:
    """Refuse a picture whose numbers are not those of the tables."""
    pairs = ((found.median_um, "median_um"), (found.completeness, "completeness"))
    for number, name in pairs:
        scored = result.metrics.get(name, float("nan"))
        if np.isfinite(scored) and abs(number - scored) > AGREE * max(abs(scored), 1e-3):
            raise InputError(
                f"{name} of {result.method} on {result.scene} is {number:.6g} by the code of today and {scored:.6g} on "
                f"record: simulator or judge have changed; repeat the command that made {record.run}"
            )
