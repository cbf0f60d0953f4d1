"""Bar on the choice between parallax alone and parallax with shading: it never loses much to parallax alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.bars.entrants import dense
from benchmarks.bars.honesty import fit_scenes
from benchmarks.bars.line import INF, Asked, Line, mean_over_specimens, ratio_over_specimens, worst_of
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens
from benchmarks.suite import BenchScene
from semrecon.errors import InputError

ASKED = Asked(most=1.1)
ALONE: dict[str, str] = {"shading": "off"}
"""Options of the dense method by which it uses parallax alone ..."""
CHOICES: dict[str, dict[str, str]] = {"by default": {}, "shading auto": {"shading": "auto"}}
"""... and those by which it may use shading, by what tables call them."""


def shading_questions(specimens: Specimens) -> list[Question]:
    """Ask the dense method with each of its choices, on all scenes of the suite."""
    found = [_dense(options) for options in (ALONE, *CHOICES.values())]
    asked = {each.name: each for each in found if not isinstance(each, str)}
    return [(s, who) for scenes in fit_scenes(specimens).values() for s in scenes for who in asked.values()]


def shading_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Take the worst scene of every choice, then every scene."""
    alone = _dense(ALONE)
    heads: list[Line] = []
    details: list[Line] = []
    known: dict[str, Line] = {}
    for what, options in CHOICES.items():
        choice = _dense(options)
        said = [each for each in (alone, choice) if isinstance(each, str)]
        if said:
            heads.append(Line("shading", what, ASKED, mean_over_specimens([]), said[0]))
        elif choice.name in known:
            heads.append(replace(known[choice.name], what=what, note=f"is the same as {known[choice.name].what}"))
        elif choice.name == alone.name:
            heads.append(Line("shading", what, ASKED, ratio_over_specimens([np.ones(specimens.meshes)]), "is the same"))
        else:
            lines = _scene_lines(specimens, found, what, choice.name, alone.name)
            measured = [line for line in lines if not np.isnan(line.measured.value)]
            heads.append(worst_of(measured or lines, f"{what}, worst scene"))
            known[choice.name] = heads[-1]
            details += lines
    return heads + details


def _dense(options: dict[str, str]) -> Any:
    """Make the dense method with options, or return the sentence why it cannot be had."""
    try:
        return dense(**options)
    except InputError as error:
        return str(error)


def _scene_lines(specimens: Specimens, found: Found, what: str, choice: str, alone: str) -> list[Line]:
    groups = fit_scenes(specimens)
    return [_line(found, scenes, f"{what}, {name}", choice, alone) for name, scenes in groups.items()]


def _line(found: Found, scenes: tuple[BenchScene, ...], what: str, choice: str, alone: str) -> Line:
    """Ratio of the medians at answered pixels; infinite where only the choice failed, left out where both did."""
    one, other = (found.numbers(scenes, who, "median_um") for who in (choice, alone))
    ratios = np.where(np.isnan(one), INF, one) / other
    share, least = (100 * found.numbers(scenes, who, "completeness").mean() for who in (choice, alone))
    note = f"{one.mean():.3g} against {other.mean():.3g} um, completeness {share:.3g} against {least:.3g} %"
    note = "; ".join([note, *found.failures(scenes, choice), *found.failures(scenes, alone)])
    return Line("shading", what, ASKED, ratio_over_specimens([ratios[~np.isnan(ratios)]]), note, detail=True)
