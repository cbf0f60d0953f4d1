"""Bars on the depth error: against the seed's method on two views, and against all other contenders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.bars.entrants import DENSE, SEED, dense, seed_of_pair
from benchmarks.bars.line import INF, TOLD, Asked, Line, mean_over_specimens, ratio_over_specimens
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens
from benchmarks.suite import BenchScene
from semrecon.data import Array
from semrecon.methods import all_methods, method_named

TWO_VIEW_SCENES = ("pollen", "fracture_rough")
SMOOTH, DIATOM = "fracture_smooth", "diatom"
ADJACENT = Asked(most=1 / 7, text="at most 1/7")
WIDEST = Asked(most=1 / 2.5, text="at most 1/2.5")
NO_WORSE = Asked(most=1.0)
FULL, OWN, POINTS = "penalised_median_um", "median_um", "points_median_um"
"""Median errors: with what is missing counted as infinitely wrong, at answered pixels, at the points of a cloud."""


def pair_questions(specimens: Specimens, *, widest: bool) -> list[Question]:
    """Ask the dense method on all views, and the seed's on two."""
    scenes = [scene for name in TWO_VIEW_SCENES for scene in specimens.of(name)]
    return [(scene, who) for scene in scenes for who in (dense(), seed_of_pair(widest=widest))]


def pair_lines(specimens: Specimens, found: Found, *, bar: str, widest: bool) -> list[Line]:
    """Hold the dense error at all judged pixels against that of the seed's method at its points."""
    asked, other = WIDEST if widest else ADJACENT, seed_of_pair(widest=widest).name
    groups = {name: specimens.of(name) for name in TWO_VIEW_SCENES}
    every = [scene for scenes in groups.values() for scene in scenes]
    said = " and ".join(TWO_VIEW_SCENES)
    lines = [_against(bar, said, asked, list(groups.values()), found, other, POINTS)]
    lines += [
        _against(bar, name, asked, [scenes], found, other, POINTS, detail=True) for name, scenes in groups.items()
    ]
    own = [_ratios(found, scenes, OWN, other, POINTS) for scenes in groups.values()]
    if (found.numbers(every, DENSE, "completeness") < 1).any():
        what = f"{said}, at the pixels that {DENSE} answers"
        lines.append(Line(bar, what, asked, ratio_over_specimens(own), detail=True))
    told = (("median", "from_truth_ratio"), ("rms", "from_truth_rms_ratio"))
    for which, metric in () if widest else told:
        what = f"{which} error if cameras and shading began at the true surface, over that of the answer"
        ratios = [_known(found.numbers(scenes, DENSE, metric)) for scenes in groups.values()]
        lines.append(Line(bar, what, TOLD, ratio_over_specimens(ratios), detail=True))
    return lines


def smooth_questions(specimens: Specimens) -> list[Question]:
    """Ask everybody on the smooth fracture, with all detectors."""
    return [(scene, who) for scene in specimens.of(SMOOTH, channels=True) for who in all_methods()]


def smooth_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Hold the dense error against that of the best other contender: of all, and of those with the same pictures."""
    scenes = specimens.of(SMOOTH, channels=True)
    others = [each for each in all_methods() if each.name != DENSE]
    alike = [each for each in others if "channels" not in each.needs]
    asked = (
        ("all contenders, each by its own gauge", others, ""),
        ("those with the same pictures, each by its own gauge", alike, ""),
        ("those with the same pictures, by a gauge common to all", alike, "common_"),
    )
    return [_against_best(what, scenes, found, among, prefix) for what, among, prefix in asked]


def diatom_questions(specimens: Specimens) -> list[Question]:
    """Ask the dense method and the seed's, with all views."""
    return [(scene, who) for scene in specimens.of(DIATOM) for who in (dense(), method_named(SEED))]


def diatom_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Hold the dense error at the seed's points against that of the points."""
    scenes = specimens.of(DIATOM)
    ratios, share = (found.numbers(scenes, DENSE, f"same_points_{name}") for name in ("ratio", "share"))
    one, other = (found.numbers(scenes, DENSE, f"same_points_{name}um") for name in ("dense_", ""))
    note = f"{_um(one)} against {_um(other)} um at {_percent(share)} of the points of {SEED}"
    failures = [*found.failures(scenes, DENSE), *found.failures(scenes, SEED)]
    measured = ratio_over_specimens([_known(ratios)])
    head = Line("diatom", f"{DIATOM}, same points", NO_WORSE, measured, "; ".join([note, *failures]))
    told = (
        ("share of these points in pits", "in_pits", ""),
        ("how much higher heights come out there than at the others, um", "dense_filled_um", ""),
        ("the same of the points themselves, um", "filled_um", f"by {SEED}"),
    )
    values = {
        name: mean_over_specimens([_known(found.numbers(scenes, DENSE, f"same_points_{name}"))]) for _, name, _ in told
    }
    return [head, *(Line("diatom", what, TOLD, values[name], said, detail=True) for what, name, said in told)]


def _against(
    bar: str,
    what: str,
    asked: Asked,
    groups: Sequence[Sequence[BenchScene]],
    found: Found,
    other: str,
    metric: str,
    *,
    detail: bool = False,
) -> Line:
    every = [scene for scenes in groups for scene in scenes]
    ratios = [_ratios(found, scenes, FULL, other, metric) for scenes in groups]
    ours, theirs = found.numbers(every, DENSE, FULL), found.numbers(every, other, metric)
    note = [
        f"{_um(ours)} against {_um(theirs)} um, completeness {_percent(found.numbers(every, DENSE, 'completeness'))}"
    ]
    note += [*found.failures(every, DENSE), *found.failures(every, other)]
    return Line(bar, what, asked, ratio_over_specimens(ratios), "; ".join(note), detail)


def _against_best(what: str, scenes: Sequence[BenchScene], found: Found, others: Sequence[Any], prefix: str) -> Line:
    """Hold against the contender whose mean error is least, and which answers on every specimen."""
    metric = prefix + FULL
    errors = {each.name: found.numbers(scenes, each.name, metric) for each in others}
    means = {name: float(np.mean(values)) for name, values in errors.items() if np.isfinite(values).all()}
    if not means:
        ours = _um(found.numbers(scenes, DENSE, metric))
        return Line("smooth", what, NO_WORSE, ratio_over_specimens([]), f"no other contender answers; ours {ours} um")
    best = min(means, key=lambda name: means[name])
    ratios = _ratios(found, scenes, metric, best, metric)
    complete = found.numbers(scenes, DENSE, "completeness")
    note = f"{_um(found.numbers(scenes, DENSE, metric))} against {_um(errors[best])} um of {best}"
    if (complete < 1).any():
        own = _um(found.numbers(scenes, DENSE, prefix + OWN))
        note += f", completeness {_percent(complete)}, {own} um at the pixels that {DENSE} answers"
    note = "; ".join([note, *found.failures(scenes, DENSE)])
    return Line("smooth", what, NO_WORSE, ratio_over_specimens([ratios]), note)


def _ratios(found: Found, scenes: Sequence[BenchScene], ours: str, other: str, theirs: str) -> Array:
    """Ratios of two errors, specimen by specimen: infinite where the dense method failed, left out where the other."""
    one = np.nan_to_num(found.numbers(scenes, DENSE, ours), nan=INF, posinf=INF)
    with np.errstate(divide="ignore"):
        return _known(one / found.numbers(scenes, other, theirs))


def _known(values: Array) -> Array:
    return np.asarray(values[~np.isnan(values)])


def _um(values: Array) -> str:
    return f"{np.mean(values):.3g}"


def _percent(shares: Array) -> str:
    return f"{100 * np.mean(shares):.3g} %"
