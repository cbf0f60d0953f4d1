"""Methods under guard: what each makes of small scenes of the suite, judged in seconds.

The judge of a run also works out F-scores and normals, which takes longer than the small scenes take the methods. Here
are the figures that a mistake moves first: depth errors after the declared gauge, the scale of the relief (the sign of
a tilt turns it round), completeness, the number of points and the angles between views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gate.commitment import Bound, Figures, Means, Part, Say, Shift, bounds_of, means_of, shifts
from benchmarks.judging.judge import filled, grid_um, pose_errors
from benchmarks.running.bench import contenders
from benchmarks.running.case import Case, call, contender_of, handed, unfit
from benchmarks.running.stored import unpacked
from benchmarks.suite import BenchScene, chosen, suite
from semrecon.data import Estimate
from semrecon.errors import InputError
from semrecon.judging.error_split import error_split
from semrecon.judging.metrics import depth_errors
from semsim.scene import Scene, scaled

COLUMNS = 213
"""Width of the pictures, px: a third of the suite's."""
REPETITIONS = 3

Pair = tuple[BenchScene, Sequence[Any]]
"""A scene and the methods that are asked on it."""


@dataclass(frozen=True)
class Measured:
    """Figures of every repetition by contender, and what was said instead of an answer."""

    figures: dict[str, list[Figures]]
    refusals: dict[str, str]

    @property
    def means(self) -> Means:
        """Means over the repetitions."""
        return means_of(self.figures)


def small_scenes(cache: Path, names: Sequence[str], columns: int = COLUMNS) -> tuple[BenchScene, ...]:
    """Scenes of the suite, so many columns wide; raises `InputError` for a name that is none."""
    picked = chosen(suite(cache), names)
    return tuple(replace(each, source=replace(each.source, scene=_narrowed(each, columns))) for each in picked)


def _narrowed(scene: BenchScene, columns: int) -> Scene:
    whole = scene.source.scene
    return scaled(whole, columns / whole.microscope.width_px)


def measured(scene: BenchScene, methods: Sequence[Any], repetitions: int) -> Measured:
    """Ask methods for every repetition of a scene, and judge; a refusal is a repetition without figures."""
    answer = Measured({}, {})
    for repetition in range(repetitions):
        for method in methods:
            case = Case(scene, method, repetition, "")
            series = handed(case.scene.series(case.repetition), case.method)
            found = unfit(case) or call((case, series), lambda: None)
            if found.kind:
                answer.refusals[method.name] = found.failure
            figures = {} if found.kind else judged(case, unpacked(found.estimate))
            answer.figures.setdefault(method.name, []).append(figures)
    return answer


def judged(case: Case, estimate: Estimate) -> Figures:
    """Judge heights, poses and the number of points."""
    source, gauge = case.scene.source, contender_of(case.method).gauge
    series, truth = case.scene.series(case.repetition), source.truth()
    view = series.reference
    visible = source.judgeable((view, *(each for each in range(len(series)) if each != view)), 1)
    heights, true = estimate.heights or filled(estimate, series), np.where(visible, truth.height_map(view), np.nan)
    figures = {} if estimate.points is None else {"points": float(len(estimate.points))}
    if heights is not None and heights.z_um.shape == true.shape:
        xy = grid_um(true.shape, series.optics.pixel_size_um)
        found = depth_errors(heights.z_um, true, gauge, xy)
        figures |= {"median_um": found.median_abs_um, "rms_um": found.rms_um, "p95_um": found.p95_um}
        figures |= {"completeness": found.completeness}
        if "scale" not in gauge:
            figures["scale"] = error_split(heights.z_um, true, xy).scale
    if estimate.poses is not None and len(estimate.poses) == len(series):
        figures |= pose_errors(estimate.poses, truth, "mirror" in gauge)
    return figures


def committed(pairs: Sequence[Pair], repetitions: int, spread: int, say: Say = lambda _: None) -> Part:
    """Commit to what methods make of scenes today, wherever they have an answer in every repetition.

    Parameters
    ----------
    pairs
        Scenes, all of one width, and the methods to ask on each.
    repetitions, spread
        Means are over so many; tolerances are from the spread over so many.

    Raises
    ------
    InputError
        A method has an answer on none of its scenes.
    """
    bounds: dict[str, dict[str, dict[str, Bound]]] = {}
    refusals: dict[str, dict[str, str]] = {}
    for scene, methods in pairs:
        say(scene.name)
        found = measured(scene, methods, spread)
        every = bounds_of(found.figures, repetitions)
        bounds[scene.name] = {name: metrics for name, metrics in every.items() if metrics}
        refusals[scene.name] = found.refusals
    for name in dict.fromkeys(method.name for _, methods in pairs for method in methods):
        if not any(name in each for each in bounds.values()):
            said = "; ".join(f"{scene}: {each[name]}" for scene, each in refusals.items() if name in each)
            raise InputError(f"there is nothing to commit to for {name}, which has no answer ({said})")
    width = pairs[0][0].source.scene.microscope.width_px
    return Part(repetitions, width, {scene: each for scene, each in bounds.items() if each})


def checked(part: Part, cache: Path) -> list[Shift]:
    """Measure again what was committed to and list what moved.

    Raises
    ------
    InputError
        A scene or a method is not there any more.
    """
    found = []
    for scene in small_scenes(cache, list(part.bounds), part.columns):
        now = measured(scene, contenders(list(part.bounds[scene.name])), part.repetitions)
        found += shifts(scene.name, now.means, part, now.refusals)
    return found


def method_call(scene: BenchScene, method: Any) -> Callable[[], Estimate]:
    """Make the call of a method on the first repetition of a scene, to be timed: the series is at hand."""
    import cv2

    cv2.setNumThreads(1)
    series, seed = handed(scene.series(0), method), scene.seed(0)
    return lambda: method(series, rng=np.random.default_rng(seed))
