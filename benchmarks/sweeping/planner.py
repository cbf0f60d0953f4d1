"""Which tilts, how many views and what dose reach a wanted depth error: by a model, then by simulation.

The model is ``error^2 = (efficiency * bound)^2 + (matching * response)^2 + floor^2``. Bound and response to matching
noise are computed for every candidate; the three factors are those of the method, fitted to a few simulations of a
development specimen: how far from the light's limit it stays, what it adds to the place of a match that more electrons
do not cure and a wider tilt does, and what neither cures (shading that travels with the tilt, surface between points).
What the model chooses is then photographed, reconstructed and judged on the reporting specimen. Where that misses the
target, what was measured corrects the model and dearer candidates are tried, the best of all at last: a specimen
that is harder than the one of the model must not end in a "no" that was never measured.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from benchmarks.judging.limits import LimitOptions, parallaxes, summary_of
from benchmarks.judging.sensitivity import noise_gain
from benchmarks.running.bench import Plan, Report, measure
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import contender_of
from benchmarks.running.cell import Limits
from benchmarks.running.manifest import Manifest, manifest_of
from benchmarks.running.runner import completed
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from benchmarks.sweeping.sweep_summary import MEASURED, interval
from benchmarks.sweeping.sweeps import offered
from semrecon.errors import InputError, MethodError
from semsim.capture import prepare
from semsim.scene import Scene

MEDIAN_OF_NORMAL = 0.6745
"""Median absolute value of a normal number of standard deviation 1."""
ROUNDS = 3
"""Times that candidates are chosen and simulated before the answer is no."""
MOST_RANGE_DEG, MOST_DOSE_E = 140.0, 1e9


@dataclass(frozen=True)
class Choices:
    """What may be chosen: ranges of tilt, about zero, in degrees; numbers of views; electrons a pixel and view."""

    ranges_deg: tuple[float, ...] = (4.0, 8.0, 16.0, 30.0)
    views: tuple[int, ...] = (2, 3, 5)
    doses_e: tuple[float, ...] = (25.0, 100.0, 400.0, 1600.0)

    def __post_init__(self) -> None:
        if not (self.ranges_deg and self.views and self.doses_e):
            raise InputError("a plan needs at least one range of tilts, one number of views and one dose")
        ranges = all(0 < each <= MOST_RANGE_DEG for each in self.ranges_deg)  # a NaN is neither
        doses = all(0 < each < MOST_DOSE_E for each in self.doses_e)
        if not (ranges and doses and min(self.views) >= 2):
            raise InputError(
                f"a plan needs ranges of tilt above 0 and up to {MOST_RANGE_DEG:g} degrees, doses above 0 and below "
                f"{MOST_DOSE_E:g} electrons and 2 views or more"
            )

    def for_method(self, method: Any) -> Choices:
        """Leave out numbers of views that a method does not take; raises `InputError` where none is left."""
        least, most = contender_of(method).views
        kept = tuple(each for each in self.views if least <= each and (most is None or each <= most))
        if not kept:
            span = f"{least} views or more" if most is None else f"{least} to {most} views"
            raise InputError(f"{method.name} takes {span}, and --views names {', '.join(map(str, self.views))}")
        return replace(self, views=kept)


@dataclass(frozen=True)
class Candidate:
    """A way to take the pictures, and what is to be expected of it.

    Parameters
    ----------
    bound_um
        Median absolute depth error at the Cramer-Rao bound.
    response_um
        Median absolute depth error for 1 px of matching noise in every view.
    share
        Part of the picture that all views see.
    expected_um
        Median absolute depth error by the model; NaN before it is fitted.
    """

    views: int
    range_deg: float
    dose_e: float
    bound_um: float
    response_um: float
    share: float
    expected_um: float = np.nan

    @property
    def tilts_deg(self) -> tuple[float, ...]:
        """Tilts of the views, evenly about zero."""
        return spread_tilts(self.views, self.range_deg)

    @property
    def total_e(self) -> float:
        """Electrons a pixel in all views: what the specimen has to bear, and the time."""
        return self.views * self.dose_e


@dataclass(frozen=True)
class Model:
    """What a method makes of the light: so many times the bound, matching noise in px, a floor in um, in squares."""

    efficiency: float
    matching_px: float
    floor_um: float

    def expected_um(self, candidate: Candidate) -> float:
        """Median absolute depth error of a candidate."""
        parts = (self.efficiency * candidate.bound_um, self.matching_px * candidate.response_um, self.floor_um)
        return float(np.sqrt(np.sum(np.square(parts))))


@dataclass(frozen=True)
class Checked:
    """A candidate after simulation: mean of the median absolute depth error, and its 95 % interval, um."""

    candidate: Candidate
    simulated_um: float
    low_um: float
    high_um: float
    completeness: float
    failure: str = ""


@dataclass(frozen=True)
class Planned:
    """The answer: model, all candidates with their expectation, those that were simulated, cheapest first."""

    target_um: float
    method: str
    model: Model
    fitted: tuple[Checked, ...]
    candidates: tuple[Candidate, ...]
    checked: tuple[Checked, ...]

    @property
    def reached(self) -> tuple[Checked, ...]:
        """What met the target in simulation."""
        return tuple(each for each in self.checked if each.simulated_um <= self.target_um)


@dataclass(frozen=True)
class Task:
    """What a plan is made for.

    Parameters
    ----------
    scene, development
        Photographed for the check, and to fit the model: specimens of one kind, apart from each other.
    checks
        Most candidates to be simulated at once; where none reaches the target, as many again are, `ROUNDS` in all.
    """

    scene: BenchScene
    development: BenchScene
    method: Any
    target_um: float
    choices: Choices = Choices()
    repetitions: int = 2
    checks: int = 3
    window_px: float = 3.0
    limits: Limits = field(default_factory=Limits)


def spread_tilts(views: int, range_deg: float) -> tuple[float, ...]:
    """Tilts spread evenly over a range about zero, degrees."""
    return tuple(float(tilt) for tilt in np.linspace(-range_deg / 2, range_deg / 2, views))


def make_plan(task: Task, ledger: BenchLedger, executor: Executor, report: Report) -> Planned:
    """Bound all candidates, fit the model, choose, and check the choice by simulation.

    Raises
    ------
    MethodError
        The method answers at none of the calibration points.
    """
    fit_at = calibration_points(task.choices)
    of_development = _bounded(task.development, fit_at, task, executor, report, "model: bounds")
    fitted = simulated(task.development, of_development, task, ledger, executor, _stage(report, "model"))
    model = fit_model(fitted)
    places = list(product(task.choices.views, task.choices.ranges_deg, task.choices.doses_e))
    bounded = _bounded(task.scene, places, task, executor, report, "bounds")
    candidates = tuple(replace(each, expected_um=model.expected_um(each)) for each in bounded)
    checked = _tried(candidates, task, ledger, executor, report)
    return Planned(task.target_um, task.method.name, model, tuple(fitted), candidates, tuple(checked))


def _tried(
    candidates: Sequence[Candidate], task: Task, ledger: BenchLedger, executor: Executor, report: Report
) -> list[Checked]:
    """Simulate what should do, correct the expectation by what comes out, and go on until something does.

    The best are tried once nothing is expected to do, and in the last round; after them there is nothing to hope for.
    """
    checked: list[Checked] = []
    for turn in range(1, ROUNDS + 1):
        left = untried(candidates, checked)
        wanted_um = 0.0 if turn == ROUNDS else task.target_um / shortfall(checked)  # nothing reaches 0: the best are
        chosen = choose(left, wanted_um, task.checks)
        name = "check" if turn == 1 else f"check, round {turn}"
        checked += simulated(task.scene, chosen, task, ledger, executor, _stage(report, name)) if chosen else []
        hopeful = any(each.expected_um <= wanted_um for each in left)
        if not hopeful or any(each.simulated_um <= task.target_um for each in checked):
            break
    return sorted(checked, key=lambda each: (each.candidate.total_e, each.candidate.expected_um))


def untried(candidates: Sequence[Candidate], checked: Sequence[Checked]) -> list[Candidate]:
    """Leave out what was simulated, and what is harder in each respect than one at which the method failed."""
    done = {each.candidate for each in checked}
    failed = [each.candidate for each in checked if not np.isfinite(each.simulated_um)]

    def hopeless(each: Candidate) -> bool:
        return any(
            each.views == one.views and each.dose_e <= one.dose_e and each.range_deg >= one.range_deg for one in failed
        )

    return [each for each in candidates if each not in done and not hopeless(each)]


def shortfall(checked: Sequence[Checked]) -> float:
    """How many times the expectation the measured errors are, in the middle; 1 where they are better or unknown."""
    ratios = [each.simulated_um / each.candidate.expected_um for each in checked if np.isfinite(each.simulated_um)]
    return max(1.0, float(np.median(ratios))) if ratios else 1.0


def task_manifest(task: Task, command: str) -> Manifest:
    """Say what a plan is made for and of, for the record; its cases are chosen as it goes."""
    chosen = {name: list(values) for name, values in asdict(task.choices).items()}
    settings = {"target_um": task.target_um, "checks": task.checks, "window_px": task.window_px, **chosen}
    scenes = (task.scene, replace(task.development, name=f"{task.development.name} (development)"))
    plan = Plan(scenes, (task.method,), task.repetitions, task.limits)
    return replace(manifest_of(plan, quick=False, purpose="reporting", command=command, settings=settings), cases=())


def calibration_points(choices: Choices) -> list[tuple[int, float, float]]:
    """Corners of the choices: the extremes of range and dose, at the middle number of views."""
    views = sorted(choices.views)[len(choices.views) // 2]
    ranges = sorted({min(choices.ranges_deg), max(choices.ranges_deg)})
    doses = sorted({min(choices.doses_e), max(choices.doses_e)})
    return [(views, spread, dose) for spread, dose in product(ranges, doses)]


def fit_model(fitted: Sequence[Checked]) -> Model:
    """Fit the squares of the model's factors, none of them negative, with relative errors counting alike.

    Raises
    ------
    MethodError
        The method answered at none of the points.
    """
    known = [each for each in fitted if np.isfinite(each.simulated_um) and np.isfinite(each.candidate.bound_um)]
    if not known:
        reasons = "; ".join(sorted({each.failure for each in fitted if each.failure}))
        raise MethodError(
            f"the method answered at none of the calibration points: {reasons or 'nothing was judgeable'}"
        )
    squares = np.array([each.simulated_um**2 for each in known])
    parts = np.array([[each.candidate.bound_um**2, each.candidate.response_um**2, 1.0] for each in known])
    design = (parts / squares[:, None])[:, : len(known)]  # fewer points tell fewer factors
    size = np.abs(design).max(axis=0)
    found = np.sqrt(nnls(design / size, np.ones(len(known)))[0] / size)
    return Model(*(float(each) for each in np.pad(found, (0, 3 - len(found)))))


def choose(candidates: Sequence[Candidate], target_um: float, most: int) -> list[Candidate]:
    """Pick the cheapest candidate of each number of views that the model says will do; the best ones if none will.

    Cost is the total of electrons; of equal costs the smaller expected error goes first.
    """
    usable = [each for each in candidates if np.isfinite(each.expected_um) and each.share > 0]
    enough = [each for each in usable if each.expected_um <= target_um]
    ranked = sorted(enough, key=lambda each: (each.total_e, each.expected_um))
    if not enough:
        ranked = sorted(usable, key=lambda each: each.expected_um)
    answer: list[Candidate] = []
    for each in ranked:
        if each.views not in {other.views for other in answer}:
            answer.append(each)
    return answer[:most]


def simulated(
    scene: BenchScene,
    candidates: Sequence[Candidate],
    task: Task,
    ledger: BenchLedger,
    executor: Executor,
    report: Report,
) -> list[Checked]:
    """Photograph, reconstruct and judge candidates; the ledger keeps what was measured."""
    variants = [_variant(scene, each.views, each.range_deg, each.dose_e) for each in candidates]
    plan = Plan(tuple(variants), (task.method,), task.repetitions, task.limits)
    found = measure(plan, ledger, executor, report)
    return [
        _checked(candidate, [each for each in found if each.scene == variant.name])
        for candidate, variant in zip(candidates, variants, strict=True)
    ]


def write_plan_csv(path: Path, planned: Planned) -> None:
    """Write a row for each candidate; simulated figures where there are any."""
    by_candidate = {each.candidate: each for each in planned.checked}
    head = ("views", "range_deg", "dose_e", "total_e", "seen_by_all", "bound_um", "response_um", "expected_um",
            "simulated_um")  # fmt: skip
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        for each in planned.candidates:
            check = by_candidate.get(each)
            row = [each.views, each.range_deg, each.dose_e, each.total_e, each.share, each.bound_um, each.response_um,
                   each.expected_um]  # fmt: skip
            writer.writerow([*row, check.simulated_um if check else ""])


def _stage(report: Report, name: str) -> Report:
    """Report under a name of its own what is done more than once."""
    return lambda stage, steps, total: report(f"{name}: {stage}", steps, total)


def _checked(candidate: Candidate, results: Sequence[Result]) -> Checked:
    errors = np.array([each.metrics.get(MEASURED, np.nan) for each in results])
    complete = [each.metrics["completeness"] for each in results if "completeness" in each.metrics]
    failures = "; ".join(sorted({each.failure for each in results if each.failure}))
    known = errors[np.isfinite(errors)]
    mean = float(known.mean()) if known.size else np.nan
    return Checked(candidate, mean, *interval(errors), float(np.mean(complete)) if complete else 0.0, failures)


def _variant(scene: BenchScene, views: int, range_deg: float, dose_e: float) -> BenchScene:
    name = f"{scene.source.name}, {views} views over {range_deg:g} deg, {dose_e:g} e"
    taken = _taken(scene.source.scene, views, range_deg, dose_e)
    return replace(scene, name=name, source=SimulatedSource(taken, scene.source.cache), offers=offered(taken))


def _taken(scene: Scene, views: int, range_deg: float, dose_e: float) -> Scene:
    detector = replace(scene.detector, dose_e=dose_e, beam_current_pa=None, dwell_us=None)
    schedule = replace(scene.schedule, tilts_deg=spread_tilts(views, range_deg), shifts_um=())
    return replace(scene, schedule=schedule, detector=detector)


def _bounded(
    scene: BenchScene,
    places: Sequence[tuple[int, float, float]],
    task: Task,
    executor: Executor,
    report: Report,
    stage: str,
) -> list[Candidate]:
    """Work out the bound at each (views, range, dose); a geometry is rendered once for all its doses."""
    doses: dict[tuple[int, float], list[float]] = {}
    for views, spread, dose in places:
        doses.setdefault((views, spread), []).append(dose)
    calls = [(_bounds, (scene.source.scene, *place, tuple(each), task.window_px)) for place, each in doses.items()]
    report(stage, 0, len(calls))
    answer = []
    for found in completed(calls, executor):
        answer += found
        report(stage, 1, len(calls))
    return sorted(answer, key=lambda each: (each.views, each.range_deg, each.dose_e))


def _bounds(
    scene: Scene, views: int, range_deg: float, doses_e: tuple[float, ...], window_px: float
) -> list[Candidate]:
    surfaces = prepare(_taken(scene, views, range_deg, doses_e[0]))
    gain = noise_gain(surfaces.scene.schedule.tilts_deg)
    response_um = MEDIAN_OF_NORMAL * gain * surfaces.scene.microscope.pixel_size_um
    answer = []
    for dose in doses_e:
        seen = parallaxes(surfaces, None, replace(surfaces.scene.detector, dose_e=dose))
        summary = summary_of(seen, LimitOptions(window_px))
        answer.append(Candidate(views, range_deg, dose, summary.median_abs_um, response_um, summary.share))
    return answer
