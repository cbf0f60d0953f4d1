"""What this project commits to: kernels, methods and the seed's study in `accuracy.json`, speed in `time.json`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.gate.commitment import FOR_SPREAD, Commitment, Part, Say, Shift, bounds_of, means_of, shifts
from benchmarks.gate.kernels import KERNELS, SCENE
from benchmarks.gate.kernels import REPETITIONS as OF_KERNELS
from benchmarks.gate.methods import COLUMNS, REPETITIONS, checked, committed, method_call, small_scenes
from benchmarks.gate.pace import Paces, pace_of
from benchmarks.gate.study import REPETITIONS as OF_STUDY
from benchmarks.gate.study import study_figures, study_scenes
from benchmarks.suite import BenchScene
from semrecon.methods import METHODS

BASELINES = Path(__file__).resolve().parents[1] / "baselines"
ACCURACY, TIME = BASELINES / "accuracy.json", BASELINES / "time.json"
RENEW, RENEW_TIME = "python -m benchmarks baselines", "python -m benchmarks baselines --times"
PARTS = ("kernels", "methods", "study")

SLIDING = ("light_field",)
"""Methods that want a stage that slides instead of one that tilts."""
GUARDED: Mapping[str, tuple[Any, ...]] = {
    "pollen": tuple(method for method in METHODS if method.name not in SLIDING),
    "spheres": tuple(method for method in METHODS if method.name not in SLIDING),
    "translation": tuple(method for method in METHODS if method.name in SLIDING),
}
"""Methods by scene: a rough grain under small tilts, balls under larger ones, and a near view of what slides past."""
REFERENCE = {"dense_multiview": "loops", "shape_from_shading": "loops"}
"""What methods are timed beside, where it is not `arrays`."""


def accuracy(cache: Path, parts: Sequence[str], say: Say) -> Commitment:
    """Measure what this project commits to, of the parts that are named.

    Parameters
    ----------
    cache
        Folder for surfaces.
    """
    made: dict[str, Callable[[], Part]] = {
        "kernels": lambda: _kernels(say),
        "methods": lambda: committed(list(guarded(cache)), REPETITIONS, FOR_SPREAD * REPETITIONS, say),
        "study": lambda: _study(cache, say),
    }
    return {name: made[name]() for name in parts}


def moved(commitment: Commitment, cache: Path) -> list[Shift]:
    """Measure again what this project committed to and list what moved."""
    found = []
    if "kernels" in commitment:
        part = commitment["kernels"]
        now = means_of({kernel.name: kernel.figures(part.repetitions) for kernel in KERNELS})
        found += shifts(SCENE, now, part)
    if "methods" in commitment:
        found += checked(commitment["methods"], cache)
    if "study" in commitment:
        part = commitment["study"]
        for source in study_scenes(cache):
            found += shifts(source.name, means_of(study_figures(source, part.repetitions)), part)
    return found


def guarded(cache: Path) -> Iterator[tuple[BenchScene, tuple[Any, ...]]]:
    """Scenes and the methods that are guarded on each."""
    for scene in small_scenes(cache, list(GUARDED), COLUMNS):
        yield scene, GUARDED[scene.name]


def times(cache: Path, say: Say) -> Paces:
    """Measure the speed that is committed to: of every kernel, and of every method on the first scene that has it."""
    paces: Paces = {}
    for kernel in KERNELS:
        say(f"time of {kernel.name}")
        paces[kernel.name] = pace_of(kernel.trial(0).call, kernel.reference)
    for scene, methods in guarded(cache):
        for method in methods:
            if scene.name == timed_on(method.name):
                say(f"time of {method.name}")
                reference = REFERENCE.get(method.name, "arrays")
                paces[method.name] = pace_of(method_call(scene, method), reference)
    return paces


def timed_on(method: str) -> str:
    """Name the scene on which a method is timed."""
    return next(scene for scene, methods in GUARDED.items() if any(each.name == method for each in methods))


def _kernels(say: Say) -> Part:
    figures = {}
    for kernel in KERNELS:
        say(kernel.name)
        figures[kernel.name] = kernel.figures(FOR_SPREAD * OF_KERNELS)
    return Part(OF_KERNELS, 0, {SCENE: bounds_of(figures, OF_KERNELS)})


def _study(cache: Path, say: Say) -> Part:
    bounds = {}
    for source in study_scenes(cache):
        say(f"the seed's study of {source.name}")
        bounds[source.name] = bounds_of(study_figures(source, FOR_SPREAD * OF_STUDY), OF_STUDY)
    return Part(OF_STUDY, 0, bounds)
