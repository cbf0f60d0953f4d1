"""Bar on time and memory: series of the sizes that people have, in a process of their own with all cores.

Seconds and GiB are those of the machine that measured them, with nothing else at work on it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.adapt import series_from_capture
from benchmarks.bars.entrants import dense
from benchmarks.bars.line import TOLD, Asked, Line, mean_over_specimens
from benchmarks.bars.plan import Found
from benchmarks.bars.specimens import FIRST_SEED, Specimens
from benchmarks.running.cell import GIB, Cell, Ended, Limits, forget_peak, resident_bytes
from benchmarks.running.ledger import Row
from benchmarks.running.manifest import machine
from benchmarks.running.runner import Job, code_version, digest
from semrecon.data import TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.numerics.threads import threads
from semsim.capture import simulate
from semsim.scene import Scene, scaled, tables
from semsim.scenes import scene

BAR = "size"
WARM_PX = 96
"""Side of the pictures on which the method is called before it is timed."""
PATIENCE = Limits(3600.0, 64.0)
"""Far beyond what is asked, so that what misses a bar is still a number."""
QUICK = 0.25


@dataclass(frozen=True)
class Size:
    """A series to be timed: a named scene as it stands, how many specimens of it at most, and what is asked."""

    scene: str
    specimens: int
    seconds: Asked
    memory_gib: Asked


SIZES = (
    Size("pollen", 3, Asked(most=30.0, text="under 30 s"), TOLD),
    Size("diatom", 1, Asked(most=360.0, text="under 6 min"), Asked(most=8.0, text="at most 8 GiB")),
)


def size_jobs(specimens: Specimens, *, quick: bool) -> list[Job]:
    """One job a series; `quick` takes a quarter of the columns and rows."""
    version = code_version("semsim", "semrecon", "benchmarks/bars/size.py", "benchmarks/running/cell.py")
    answer = []
    for size in SIZES:
        for which in range(min(size.specimens, specimens.meshes)):
            each = series_scene(size, which, specimens, quick)
            key = digest(BAR, tables(each), repr(dense()), version, machine(), threads())
            answer.append(Job((key,), measured, (each, which, key)))
    return answer


def series_scene(size: Size, which: int, specimens: Specimens, quick: bool) -> Scene:
    """Make the scene of a size with one of its specimens."""
    whole = scene(size.scene)
    seed = FIRST_SEED[specimens.purpose] + which
    named = replace(whole, name=f"{size.scene}, specimen {seed}", specimen_seed=seed)
    return scaled(named, QUICK) if quick else named


def measured(each: Scene, which: int, key: str) -> list[Row]:
    """Photograph a scene, then let a process of its own reconstruct it, timed."""
    series = series_from_capture(simulate(each, which))
    cell = Cell()
    found = cell.call("benchmarks.bars.size:called", (dense(), series), PATIENCE)
    cell.close()
    if isinstance(found, Ended | str):
        return [Row(key, BAR, each.name, dense().name, which, {}, found if isinstance(found, str) else found.sentence)]
    return [Row(key, BAR, each.name, dense().name, which, found)]


def called(given: tuple[Any, TiltSeries], ready: Callable[[], None]) -> dict[str, float] | str:
    """Call the method once on a corner, then on the whole, timed; the sentence of a refusal instead of numbers.

    Memory is the most that the process held while the method ran, libraries and pictures included.
    """
    method, series = given
    _timed(method, corner(series))
    ready()
    load = os.getloadavg()[0]
    forget_peak()
    answer = _timed(method, series)
    if isinstance(answer, str):
        return answer
    peak_gib = resident_bytes(field="VmHWM") / GIB
    return {"seconds": answer, "peak_gib": peak_gib, "threads": float(threads()), "load": load}


def corner(series: TiltSeries) -> TiltSeries:
    """Cut out a corner of every view."""
    views = tuple(replace(view, image=view.image[:WARM_PX, :WARM_PX]) for view in series.views)
    height, width = views[0].image.shape
    return replace(series, views=views, optics=replace(series.optics, width_px=width, height_px=height))


def size_lines(specimens: Specimens, found: Found, *, quick: bool) -> list[Line]:
    """Hold seconds and memory against what is asked; of small pictures nothing is."""
    lines = []
    for size in SIZES:
        scenes = [series_scene(size, which, specimens, quick) for which in range(min(size.specimens, specimens.meshes))]
        rows = [found.rows[BAR, each.name, dense().name] for each in scenes]
        for asked, metric, unit in ((size.seconds, "seconds", "s"), (size.memory_gib, "peak_gib", "GiB")):
            lines.append(_line(TOLD if quick else asked, scenes[0], rows, metric, unit))
    return lines


def _line(asked: Asked, each: Scene, rows: list[Row], metric: str, unit: str) -> Line:
    microscope, views = each.microscope, len(each.schedule.tilts_deg)
    what = f"{microscope.width_px} x {microscope.height_px} px, {views} views: {unit}"
    found = [row.metrics for row in rows if not row.failure]
    values = [each[metric] for each in found]
    note = [f"{int(each['threads'])} threads, {each['load']:.1f} at work when it began" for each in found]
    note = [f"on {machine()['processor']}", *dict.fromkeys(note), *(row.failure for row in rows if row.failure)]
    return Line(
        BAR, what, asked, mean_over_specimens([np.array(values)]), "; ".join(note), asked.anything and unit != "s"
    )


def _timed(method: Any, series: TiltSeries) -> float | str:
    started = time.perf_counter()
    try:
        method(series, rng=np.random.default_rng(0))
    except (InputError, MethodError) as error:
        return " ".join(str(error).split())
    return time.perf_counter() - started
