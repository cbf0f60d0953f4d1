"""What is compared: two methods of a run, or two runs, before and after a change; and what must be said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.judging.paired import Line, lines
from benchmarks.reporting.error_maps import Record, read_run
from benchmarks.running.bench import LEDGER
from benchmarks.running.bench_ledger import Result
from benchmarks.running.case import is_oracle
from benchmarks.running.manifest import MethodRecord
from semrecon.errors import InputError

METRICS = (
    "median_um",
    "common_median_um",
    "penalised_median_um",
    "rms_um",
    "completeness",
    "fscore_1px",
    "normal_deg",
    "seconds",
    "peak_mib",
)
"""Compared unless others are asked for; the first one is shown scene by scene."""
OF_CASE = ("seconds", "peak_mib")


@dataclass(frozen=True)
class Asked:
    """What the user wants of a comparison; empty is all, or the usual."""

    scenes: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()


@dataclass(frozen=True)
class Paired:
    """A comparison, ready to be shown.

    Parameters
    ----------
    first, second
        What the sides are called.
    about
        A sentence on where they come from.
    metrics
        In the order in which they were asked for.
    notes
        Sentences that a reader needs so as not to be misled, failures among them.
    """

    first: str
    second: str
    about: str
    metrics: tuple[str, ...]
    lines: tuple[Line, ...]
    notes: tuple[str, ...]


def is_run(name: str) -> bool:
    """Whether this is a folder with the ledger of a run."""
    return (Path(name) / LEDGER).is_file()


def compare_methods(first: str, second: str, run: Path, asked: Asked) -> Paired:
    """Compare two methods of one run, pair by pair.

    Raises
    ------
    InputError
        The run lacks a method, a scene or a score that was asked for, or both are the same.
    """
    record = read_run(run)
    if asked.methods:
        raise InputError("--method is for two runs; name the two methods alone")
    one, other = (_method(record, name) for name in (first, second))
    if one.name == other.name:
        raise InputError(f"both sides are {one.name}; name two methods, or two folders of runs")
    scenes = _scenes([record], asked)
    left, right = (_of(record, name, scenes) for name in (one.name, other.name))
    metrics = _metrics([*left, *right], asked)
    notes = [*_given([one, other]), *_gauges(one, other, metrics), *_failures(left, right, (one.name, other.name), "")]
    code = f", code {record.manifest.code}" if record.manifest.code else ""
    about = f"Both answered the same pictures of the run in {run}, begun {record.manifest.started[:10]}{code}."
    return Paired(one.name, other.name, about, metrics, tuple(lines(left, right, metrics)), tuple(notes))


def compare_runs(first: Path, second: Path, asked: Asked) -> Paired:
    """Compare two runs, method by method, pair by pair; the first is called before, the second after.

    Raises
    ------
    InputError
        They are one folder, of different suites, or have no case in common.
    """
    if first.resolve() == second.resolve():
        raise InputError(f"both sides are {first}; name the folders of two runs")
    records = [read_run(first), read_run(second)]
    before, after = (each.manifest for each in records)
    if (before.quick, before.purpose) != (after.quick, after.purpose):
        raise InputError(
            f"{first} and {second} are not of the same pictures (one with --quick or --development, one without); "
            "run both alike"
        )
    scenes = _scenes(records, asked)
    wanted = [_method(records[0], name).name for name in asked.methods] or [each.name for each in records[0].methods]
    there = {each.name for each in records[1].methods}
    methods = [name for name in wanted if name in there]
    pairs = {name: (_of(records[0], name, scenes), _of(records[1], name, scenes)) for name in methods}
    metrics = _metrics([each for sides in pairs.values() for side in sides for each in side], asked)
    found = [line for name, sides in pairs.items() for line in lines(*sides, metrics, name)]
    if not found:
        raise InputError(f"{first} and {second} have no case in common; run the same methods and scenes in both")
    notes = [*_changes(records, methods, scenes), *_alone(records)]
    notes += [each for name, sides in pairs.items() for each in _failures(*sides, ("before", "after"), name)]
    about = f"Before is the run in {first} ({_origin(records[0])}), after the one in {second} ({_origin(records[1])})."
    return Paired("before", "after", about, metrics, tuple(found), tuple(notes))


def _origin(record: Record) -> str:
    code = f"code {record.manifest.code}, " if record.manifest.code else ""
    return f"{code}begun {record.manifest.started[:16].replace('T', ' ')}"


def _method(record: Record, name: str) -> MethodRecord:
    known = {each.name: each for each in record.methods}
    plain = name.replace("-", "_")
    if plain not in known:
        raise InputError(
            f"{name!r} is neither a method of the run in {record.run}, which has {', '.join(known)}, nor the folder of "
            "a run"
        )
    return known[plain]


def _scenes(records: Sequence[Record], asked: Asked) -> tuple[str, ...]:
    """Scenes that all runs have, of those asked for."""
    common = [
        each.name
        for each in records[0].manifest.scenes
        if all(each.name in {scene.name for scene in record.manifest.scenes} for record in records)
    ]
    for name in asked.scenes:
        if name not in common:
            raise InputError(
                f"--scenes names {name!r}, which is not on record; there are {', '.join(common) or 'none'}"
            )
    return asked.scenes or tuple(common)


def _of(record: Record, method: str, scenes: Sequence[str]) -> tuple[Result, ...]:
    return tuple(each for scene in scenes for each in record.results if each.method == method and each.scene == scene)


def _metrics(results: Sequence[Result], asked: Asked) -> tuple[str, ...]:
    known = dict.fromkeys([*OF_CASE, *(name for each in results for name in each.metrics)])
    for name in asked.metrics:
        if name not in known:
            raise InputError(f"--metric names no score {name!r}; on record are {', '.join(sorted(known))}")
    return asked.metrics or tuple(name for name in METRICS if name in known)


def _given(methods: Sequence[MethodRecord]) -> list[str]:
    return [
        f"{each.name} is handed part of the truth ({each.given or 'see the oracles'}): it is no method."
        for each in methods
        if is_oracle(each)
    ]


def _gauges(one: MethodRecord, other: MethodRecord, metrics: Sequence[str]) -> list[str]:
    """Say so where more is taken from one than from the other before its heights are judged."""
    if set(one.gauge) == set(other.gauge) or not any(_after_gauge(name) for name in metrics):
        return []
    said = " and ".join(f"{each.name} its {', '.join(each.gauge) or 'nothing'}" for each in (one, other))
    return [
        f"They do not declare the same as unobservable, and are judged accordingly: before heights are judged, {said} "
        "is taken away. common_median_um takes the same from both."
    ]


def _after_gauge(metric: str) -> bool:
    return not metric.startswith(("common_", "split_")) and metric not in (*OF_CASE, "completeness", "rre_deg")


def _failures(one: Sequence[Result], other: Sequence[Result], names: tuple[str, str], method: str) -> list[str]:
    """Say where one side has no answer and the other one has, and why: such a case is in no number."""
    answered = [{(each.scene, each.repetition) for each in side if not each.kind} for side in (one, other)]
    said = []
    for side, name, others in ((one, names[0], answered[1]), (other, names[1], answered[0])):
        lost = [each for each in side if each.kind and (each.scene, each.repetition) in others]
        for sentence in dict.fromkeys(each.failure for each in lost):
            where = ", ".join(dict.fromkeys(each.scene for each in lost if each.failure == sentence))
            count = sum(each.failure == sentence for each in lost)
            who = f"{method}, {name}," if method else name
            said.append(
                f"{who} has no answer in {count} case{'s' * (count != 1)} that the other side answered ({where}): "
                f"{sentence}. No number here holds that against it."
            )
    return said


def _alone(records: Sequence[Record]) -> list[str]:
    """Say which methods and scenes only one of two runs has."""
    said = []
    before, after = records
    for name, mine, its in (("before", before, after), ("after", after, before)):
        methods = sorted({each.name for each in mine.methods} - {each.name for each in its.methods})
        scenes = sorted({each.name for each in mine.manifest.scenes} - {each.name for each in its.manifest.scenes})
        only = "; ".join(
            f"{what} {', '.join(which)}" for what, which in (("methods", methods), ("scenes", scenes)) if which
        )
        if only:
            said.append(f"Only {name} has: {only}.")
    return said


def _changes(records: Sequence[Record], methods: Sequence[str], scenes: Sequence[str]) -> list[str]:
    """Say what else than the methods' code differs between two runs."""
    before, after = (each.manifest for each in records)
    said = []
    identities = [{each.name: each.identity for each in manifest.scenes} for manifest in (before, after)]
    if any(identities[0][name] != identities[1][name] for name in scenes):
        said.append(
            "The simulator, or a scene, changed between the runs: the pictures may differ, and then so may every score."
        )
    if before.judge != after.judge:
        said.append(
            "The judge changed between the runs: scores may differ for that alone. The command that made the older "
            "run, given again with the code of today, judges its answers anew where no method has changed."
        )
    options = [{each.name: each.options for each in manifest.methods} for manifest in (before, after)]
    if changed := [name for name in methods if options[0][name] != options[1][name]]:
        said.append(f"Other options, or other defaults, than before: {', '.join(changed)}.")
    if before.machine != after.machine or before.versions != after.versions:
        said.append("The runs were made on different machines, or with other libraries: seconds do not compare.")
    return said
