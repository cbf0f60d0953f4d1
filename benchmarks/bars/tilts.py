"""Bar on the refinement of tilts: what is left of a stage that states them wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.bars.entrants import DENSE, dense
from benchmarks.bars.line import INF, Asked, Line, mean_over_specimens
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens, tilts_apart
from benchmarks.suite import BenchScene
from semsim.scene import Scene

SCENES = ("pollen", "fracture_rough")
OFF_DEG = 0.25
ASKED = Asked(most=0.03, text="under 0.03 degrees")
MISSTATED = ("in proportion to the tilt", "with alternating signs")
"""Ways to be off by `OFF_DEG`: at the tilt farthest from the reference, less between (so does the sweep tilt-error); or
at every view but the reference."""


def tilt_questions(specimens: Specimens) -> list[Question]:
    """Ask the dense method where the stage states wrong tilts."""
    return [(scene, dense()) for way in MISSTATED for name in SCENES for scene in misstated(specimens, name, way)]


def tilt_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Take the median view and the worst, for each way to be off."""
    lines = []
    for way in MISSTATED:
        groups = [misstated(specimens, name, way) for name in SCENES]
        lines += [
            _line(found, groups, f"{which} view, off {way}", f"tilt_{which}_deg") for which in ("median", "worst")
        ]
    return lines


def misstated(specimens: Specimens, name: str, way: str) -> tuple[BenchScene, ...]:
    """Make a scene whose stage states tilts that are off."""
    errors = errors_deg(specimens.of(name)[0].source.scene, way)
    return specimens.of(name, tilt_errors_deg=errors, said=f"tilts off {way}")


def errors_deg(scene: Scene, way: str) -> tuple[float, ...]:
    """Stated minus true tilt of each view; the reference is right.

    Raises
    ------
    ValueError
        There is no such way to be off.
    """
    apart = tilts_apart(scene)
    if way == MISSTATED[0]:
        return tuple(float(each) for each in OFF_DEG * apart / np.abs(apart).max())
    if way != MISSTATED[1]:
        raise ValueError(f"tilts are off {' or '.join(MISSTATED)}, not {way!r}")
    signs = np.where(np.arange(len(apart)) % 2 == 0, 1.0, -1.0)
    return tuple(float(each) for each in np.where(apart == 0, 0.0, OFF_DEG * signs))


def _line(found: Found, groups: Sequence[Sequence[BenchScene]], what: str, metric: str) -> Line:
    """Mean over specimens; an answer without poses is infinitely wrong."""
    values = [np.nan_to_num(found.numbers(scenes, DENSE, metric), nan=INF, posinf=INF) for scenes in groups]
    every = [scene for scenes in groups for scene in scenes]
    stated = found.numbers(every, DENSE, "tilt_stated_worst_deg")
    note = f"largest {np.concatenate(values).max():.3g} degrees; stated {np.max(stated):.3g} off"
    note = "; ".join([note, *found.failures(every, DENSE)])
    return Line("tilt_error", what, ASKED, mean_over_specimens(values), note)
