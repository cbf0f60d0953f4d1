"""A sweep: one scene with one or two settings varied, all methods on each variant, beside what theory expects.

Cases go the way of `run`: the same ledger, limits, processes and judge. The noise of a repetition is the same for all
methods and at all values, so that curves differ by what was varied and not by luck.
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.judging.limits import LimitOptions, bound_summary
from benchmarks.judging.sensitivity import predicted
from benchmarks.running.bench import Plan, Report, measure
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.cell import Limits
from benchmarks.running.runner import code_version, completed, digest
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import ALWAYS, SPECIMEN_SEEDS, BenchScene, Purpose, suite
from benchmarks.sweeping.sweep_axes import Axis, axis_named
from semrecon.errors import InputError
from semsim.overrides import BACK_TO_DEFAULT, overridden
from semsim.scene import Scene, scaled
from semsim.scenes import load_scene

THEORY = "theory.json"
NAN = float("nan")


@dataclass(frozen=True)
class TheoryOptions:
    """What theory is told.

    Parameters
    ----------
    matching_noise_px
        Standard deviation of a matched position in one view, for the predicted response; SIFT has 0.4 to 0.6.
    window_px
        Standard deviation of the window of the Cramer-Rao bound.
    """

    matching_noise_px: float = 0.4
    window_px: float = 3.0


@dataclass(frozen=True)
class Theory:
    """What is to be expected of a variant, median absolute depth errors in um.

    Parameters
    ----------
    bound_um
        Cramer-Rao bound with the window.
    predicted_um
        Response to matching noise and to the errors of stage, column and scan, at nominal poses.
    systematic_rms_um
        RMS of the part of it that is no noise.
    """

    bound_um: float = NAN
    predicted_um: float = NAN
    systematic_rms_um: float = NAN


@dataclass(frozen=True)
class Sweep:
    """What is varied, and who is tried.

    Parameters
    ----------
    base
        The scene before anything is varied.
    axes
        One or two.
    """

    base: BenchScene
    axes: tuple[Axis, ...]
    methods: tuple[Any, ...]
    repetitions: int = 3
    theory: TheoryOptions = TheoryOptions()
    limits: Limits = field(default_factory=Limits)

    @property
    def points(self) -> list[Point]:
        """Every combination of values, the last axis fastest."""
        return [self._point(values) for values in product(*(axis.values for axis in self.axes))]

    @property
    def plan(self) -> Plan:
        """All methods on all points."""
        return Plan(tuple(point.scene for point in self.points), self.methods, self.repetitions, self.limits)

    def _point(self, values: tuple[float, ...]) -> Point:
        scene = self.base.source.scene
        for axis, value in zip(self.axes, values, strict=True):
            scene = axis.at(scene, value)
        said = ", ".join(f"{axis.name} {value:g}" for axis, value in zip(self.axes, values, strict=True))
        source = SimulatedSource(scene, self.base.source.cache)
        return Point(values, replace(self.base, name=f"{self.base.name}, {said}", source=source, offers=offered(scene)))


@dataclass(frozen=True)
class Point:
    """A variant: the values on the axes and the scene they make."""

    values: tuple[float, ...]
    scene: BenchScene


@dataclass(frozen=True)
class Swept:
    """What a sweep found: for each point theory and the results of all methods and repetitions."""

    sweep: Sweep
    points: tuple[Point, ...]
    theory: tuple[Theory, ...]
    results: tuple[tuple[Result, ...], ...]


def base_scene(name_or_path: str, cache: Path, *, columns: int, purpose: Purpose, channels: bool) -> BenchScene:
    """Find a scene of the suite, else any named scene or TOML file, and make it so many columns wide.

    Parameters
    ----------
    purpose
        "development" has another specimen of the same kind, and other noise.
    channels
        Whether a method wants backscatter images; they cost time.
    """
    found = {each.name: each for each in suite(cache, purpose=purpose)}.get(name_or_path)
    if found is None:
        plain = load_scene(name_or_path)
        seed = plain.specimen_seed if purpose == "reporting" else SPECIMEN_SEEDS[purpose]
        scene = replace(plain, name=f"{plain.name}-{purpose}", specimen_seed=seed)
        found = BenchScene(plain.name, "", SimulatedSource(scene, cache), ())
    scene = found.source.scene
    if not channels:
        scene = overridden(scene, {"signal.backscatter": BACK_TO_DEFAULT})
    scene = scaled(scene, columns / scene.microscope.width_px)
    return replace(found, source=replace(found.source, scene=scene), offers=offered(scene))


def sweep_settings(sweep: Sweep, name_or_path: str, *, columns: int, channels: bool) -> dict[str, Any]:
    """List what `points_of` makes the same variants from again, as JSON can hold it."""
    axes = [{"name": axis.name, "values": list(axis.values)} for axis in sweep.axes]
    return {"scene": name_or_path, "columns": columns, "channels": channels, "axes": axes, **asdict(sweep.theory)}


def points_of(settings: Mapping[str, Any], cache: Path, purpose: Purpose) -> list[Point]:
    """Make the variants of a sweep from its settings on record.

    Raises
    ------
    InputError
        The settings are damaged, or the file of the scene is not at hand.
    """
    try:
        axes = tuple(axis_named(each["name"], [float(value) for value in each["values"]]) for each in settings["axes"])
        name, columns, channels = str(settings["scene"]), int(settings["columns"]), bool(settings["channels"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the settings of the sweep are damaged ({error}); repeat the sweep") from error
    return Sweep(base_scene(name, cache, columns=columns, purpose=purpose, channels=channels), axes, ()).points


def offered(scene: Scene) -> tuple[str, ...]:
    """List what a scene has of what methods may need."""
    has = {
        "channels": scene.signal.backscatter is not None,
        "rotations": len(set(scene.schedule.tilts_deg)) > 1,
        "perspective": scene.microscope.working_distance_um is not None,
        "stage_path": bool(scene.schedule.shifts_um),
    }
    return tuple(need for need in dict.fromkeys((*ALWAYS, *has)) if has.get(need, True))


def run_sweep(sweep: Sweep, ledger: BenchLedger, executor: Executor, report: Report) -> Swept:
    """Measure all points, then work out theory; what is on record is taken from there."""
    points = sweep.points
    found = measure(sweep.plan, ledger, executor, report)
    theory = _theories(points, sweep.theory, ledger.path.parent / THEORY, executor, report)
    by_scene = {point.scene.name: [each for each in found if each.scene == point.scene.name] for point in points}
    return Swept(sweep, tuple(points), tuple(theory), tuple(tuple(by_scene[point.scene.name]) for point in points))


def theory_of(source: SimulatedSource, options: TheoryOptions) -> Theory:
    """Work out bound and predicted response of a variant; the response is NaN where no tilt makes parallax."""
    surfaces = source.surfaces()
    bound = bound_summary(surfaces, LimitOptions(options.window_px))
    if len(set(source.scene.schedule.tilts_deg)) < 2:
        return Theory(bound.median_abs_um)
    response = predicted(surfaces, options.matching_noise_px)
    return Theory(bound.median_abs_um, response.median_abs_um, response.systematic_rms_um)


def read_sweep(path: Path) -> dict[str, Any]:
    """Read a sweep of one's own from TOML: scene, methods, repetitions, columns, and one or two [[axis]].

    An axis has a name (one of the known, or any numeric setting of a scene) and values.

    Raises
    ------
    InputError
        The file is no TOML, or a key is unknown or of the wrong kind.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as a TOML file of a sweep: {error}") from error
    kinds: dict[str, type] = {"scene": str, "methods": list, "repetitions": int, "columns": int, "axis": list}
    for key, value in table.items():
        if not isinstance(value, kinds.get(key, ())):
            wanted = f"a {kinds[key].__name__}" if key in kinds else f"one of {', '.join(kinds)}"
            raise InputError(f"{path}: {key} must be {wanted}")
    axes = table.pop("axis", [])
    if not 1 <= len(axes) <= 2:
        raise InputError(f"{path} must have one or two [[axis]] tables, not {len(axes)}")
    return {**table, "axes": tuple(_axis_from(each, path) for each in axes)}


def _axis_from(table: Mapping[str, Any], path: Path) -> Axis:
    values = table.get("values", [])
    numbers = isinstance(values, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if set(table) - {"name", "values"} or not isinstance(table.get("name"), str) or not numbers:
        raise InputError(f"{path}: an [[axis]] has a name and a list of numbers called values, not {dict(table)}")
    return axis_named(table["name"], [float(value) for value in values])


def _theories(
    points: Sequence[Point], options: TheoryOptions, record: Path, executor: Executor, report: Report
) -> list[Theory]:
    """Work out what is not on record yet; the record is replaced as a whole, so that a kill leaves an old one."""
    version = code_version("semsim", "benchmarks/judging/limits.py", "benchmarks/judging/sensitivity.py")
    keys = [digest(point.scene.identity, asdict(options), version) for point in points]
    known: dict[str, Any] = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else {}
    missing = [(key, point.scene.source) for key, point in zip(keys, points, strict=True) if key not in known]
    report("theory", len(points) - len(missing), len(points))
    for key, theory in completed(((_keyed, (key, source, options)) for key, source in missing), executor):
        known[key] = asdict(theory)
        partial = record.with_suffix(f".{os.getpid()}.partial")
        partial.write_text(json.dumps(known), encoding="utf-8")
        partial.replace(record)
        report("theory", 1, len(points))
    return [Theory(**known[key]) for key in keys]


def _keyed(key: str, source: SimulatedSource, options: TheoryOptions) -> tuple[str, Theory]:
    return key, theory_of(source, options)
