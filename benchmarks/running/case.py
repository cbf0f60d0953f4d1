"""One case: a method on one repetition of a scene, timed in a process of its own, then judged."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.judging.judge import Metrics, judge
from benchmarks.running.cell import Cell, Ended, Limits, forget_peak, resident_bytes
from benchmarks.running.runner import code_version, digest
from benchmarks.running.stored import packed, unpacked
from benchmarks.suite import BenchScene
from semrecon.data import Estimate, TiltSeries
from semrecon.errors import InputError, MethodError

MIB = float(1 << 20)
WARM_PX = 96
"""Side of the pictures on which a method is called before it is timed."""
ORACLE = "oracle_"
"""How the names of those begin that are handed part of the truth."""
JUDGES = (
    "benchmarks/judging/judge.py",
    "benchmarks/judging/evaluate.py",
    "benchmarks/judging/surface_score.py",
    "semrecon/judging",
    "semrecon/geometry.py",
    "semrecon/surface/meshing.py",
)
"""What decides a score, given an estimate."""


@dataclass(frozen=True)
class Case:
    """A method on one repetition of a scene; `key` says all that determines the answer."""

    scene: BenchScene
    method: Any
    repetition: int
    key: str

    @property
    def options(self) -> str:
        """Options of the method, for people."""
        return repr(self.method)


@dataclass(frozen=True)
class Answer:
    """What came of a case: an estimate, or a failure with its kind and a sentence.

    Parameters
    ----------
    kind
        "" for an estimate; else needs, refused, timeout, memory, crash or bug.
    seconds, peak_mib
        Of the call alone; memory is what it needed beside what its process held before.
    detail
        Traceback of a bug.
    """

    key: str
    kind: str = ""
    failure: str = ""
    seconds: float = float("nan")
    peak_mib: float = float("nan")
    estimate: bytes = b""
    detail: str = ""


@dataclass(frozen=True)
class Outcome:
    """An answer and its score, ready for the ledger."""

    case: Case
    answer: Answer
    judge: str
    metrics: Metrics = field(default_factory=dict)


def cases(scenes: Sequence[BenchScene], methods: Sequence[Any], repetitions: int) -> list[Case]:
    """List all cases, scene by scene, so that whoever runs them loads a scene once."""
    answer = []
    for scene in scenes:
        identity = scene.identity
        for repetition in range(repetitions):
            for method in methods:
                code = code_version(
                    "semrecon", "benchmarks/running/case.py", *(("benchmarks/oracles.py",) if is_oracle(method) else ())
                )
                key = digest("case", identity, method.name, repr(method), repetition, scene.seed(repetition), code)
                answer.append(Case(scene, method, repetition, key))
    return answer


def is_oracle(method: Any) -> bool:
    """Whether this is handed part of the truth: such are marked wherever they are shown."""
    return str(method.name).startswith(ORACLE)


def contender_of(method: Any) -> Any:
    """Return what declares needs, views and gauge: the method, or the one that an oracle is built round."""
    return method.method if is_oracle(method) and not hasattr(method, "needs") else method


def needs_of(method: Any) -> tuple[str, ...]:
    """List what a method must be told."""
    return tuple(contender_of(method).needs)


def judge_version() -> str:
    """Digest of all that decides a score, given an estimate and the truth."""
    return code_version(*JUDGES)


def run_case(case: Case, limits: Limits) -> Outcome:
    """Ask the method, in this thread's cell, and judge what it answers."""
    answer = unfit(case) or _called(case, limits)
    return Outcome(case, answer, judge_version(), score(case, answer))


def score(case: Case, answer: Answer) -> Metrics:
    """Judge an answer on record or fresh from its method: from the stored form, so that both give the same."""
    if answer.kind:
        return {}
    truth = case.scene.source.truth()
    series = case.scene.series(case.repetition)
    return judge(unpacked(answer.estimate), truth, series, contender_of(case.method).gauge, case.scene.source)


def unfit(case: Case) -> Answer | None:
    """Answer for a method that needs what the scene does not offer; None where it may try."""
    lacking = [need for need in needs_of(case.method) if need not in case.scene.offers]
    if lacking:
        return Answer(case.key, "needs", f"needs {', '.join(lacking)}, which this scene does not offer")
    least, most = contender_of(case.method).views
    views = len(case.scene.source.scene.schedule.tilts_deg)
    if views < least or (most is not None and views > most):
        wanted = f"{least} or more" if most is None else f"{least} to {most}"
        return Answer(case.key, "needs", f"takes {wanted} views; this scene has {views}")
    return None


_cells = threading.local()


def _called(case: Case, limits: Limits) -> Answer:
    if not hasattr(_cells, "own"):
        _cells.own = Cell()
    series = handed(case.scene.series(case.repetition), case.method)  # kept here for the judge, so not made twice
    value = _cells.own.call("benchmarks.running.case:call", (case, series), limits)
    return Answer(case.key, value.kind, value.sentence) if isinstance(value, Ended) else value


def call(given: tuple[Case, TiltSeries], ready: Callable[[], None]) -> Answer:
    """Call the method on the series and measure: what runs in the cell."""
    import cv2

    cv2.setNumThreads(1)  # cases run side by side already
    case, series = given
    extra = (case.scene.source.truth(),) if is_oracle(case.method) else ()
    if not extra:
        ready()
        _warm(case.method, series)
    ready()
    forget_peak()
    before, started = resident_bytes(), time.perf_counter()
    found = _answered(case, series, extra)
    seconds = time.perf_counter() - started
    peak = (resident_bytes(field="VmHWM") - before) / MIB
    if isinstance(found, Estimate):
        return Answer(case.key, "", "", seconds, peak, packed(found))
    return replace(found, seconds=seconds, peak_mib=peak)


_warmed: set[str] = set()


def _warm(method: Any, series: TiltSeries) -> None:
    """Call a method once on a corner of the pictures: libraries load and kernels compile before the clock starts."""
    if method.name in _warmed:
        return
    _warmed.add(method.name)
    height, width = (min(size, WARM_PX) for size in series.optics.shape)
    views = tuple(
        replace(
            view,
            image=view.image[:height, :width],
            mask=None if view.mask is None else view.mask[:height, :width],
            channels={name: image[:height, :width] for name, image in view.channels.items()},
        )
        for view in series.views
    )
    small = replace(series, views=views, optics=replace(series.optics, width_px=width, height_px=height))
    with suppress(Exception):  # whatever it is, it comes again in the call that counts
        method(small, rng=np.random.default_rng(0))


def _answered(case: Case, series: TiltSeries, extra: tuple[Any, ...]) -> Estimate | Answer:
    rng = np.random.default_rng(case.scene.seed(case.repetition))
    try:
        estimate = case.method(series, *extra, rng=rng)
    except (InputError, MethodError) as error:
        return Answer(case.key, "refused", " ".join(str(error).split()))
    except MemoryError:
        return Answer(case.key, "memory", "asked for more memory than there is")
    except Exception as error:  # a bug of the method is a row as well
        said = " ".join(str(error).split())[:200]
        return Answer(case.key, "bug", f"broke off: {type(error).__name__}: {said}", detail=traceback.format_exc())
    if estimate.heights is None and (estimate.points is None or not len(estimate.points)):
        return Answer(case.key, "refused", "answered without a point or a height")
    return estimate  # type: ignore[no-any-return]


def handed(series: TiltSeries, method: Any) -> TiltSeries:
    """Keep from a method the further channels and the stage positions that it did not declare."""
    views = series.views
    geometry = series.channel_geometry
    if "channels" not in needs_of(method):
        views, geometry = tuple(replace(view, channels={}) for view in views), {}
    if "stage_path" not in needs_of(method):
        views = tuple(replace(view, stage_um=None) for view in views)
    return replace(series, views=views, channel_geometry=geometry)
