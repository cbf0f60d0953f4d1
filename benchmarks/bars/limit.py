"""Bar on the efficiency: the median error over the least that the electrons allow at the same pixels."""

from __future__ import annotations

import numpy as np

from benchmarks.bars.entrants import DENSE, dense
from benchmarks.bars.line import INF, Asked, Line, ratio_over_specimens, worst_of
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens

TEXTURED = ("pollen", "fracture_rough", "grains", "pyramid", "steps", "spheres")
DOSES_E: tuple[float | None, ...] = (50.0, None, 1000.0)
"""Electrons a pixel; None is the dose of the suite, 200."""
ASKED = Asked(most=1.5)


def efficiency_questions(specimens: Specimens) -> list[Question]:
    """Ask the dense method on textured scenes at three doses."""
    return [(scene, dense()) for dose in DOSES_E for name in TEXTURED for scene in specimens.of(name, dose_e=dose)]


def efficiency_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Take the worst scene at each dose, then all scenes one by one."""
    heads, details = [], []
    for dose in DOSES_E:
        said = f"{specimens.of(TEXTURED[0], dose_e=dose)[0].source.scene.detector.dose_e:g} e/px"
        lines = [_line(specimens, found, name, dose, said) for name in TEXTURED]
        heads.append(worst_of(lines, f"worst scene at {said}"))
        details += lines
    return heads + details


def _line(specimens: Specimens, found: Found, name: str, dose: float | None, said: str) -> Line:
    scenes = specimens.of(name, dose_e=dose)
    values = np.nan_to_num(found.numbers(scenes, DENSE, "efficiency"), nan=INF, posinf=INF)
    error, share = (found.numbers(scenes, DENSE, metric).mean() for metric in ("median_um", "completeness"))
    note = f"{error:.3g} um at {100 * share:.3g} % of the pixels"
    note = "; ".join([note, *found.failures(scenes, DENSE)])
    return Line("efficiency", f"{name} at {said}", ASKED, ratio_over_specimens([values]), note, detail=True)
