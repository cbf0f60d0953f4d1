"""Bar on the stated sigma: how many heights are wrong by no more than it, and by no more than twice of it."""

from __future__ import annotations

import numpy as np

from benchmarks.bars.entrants import DENSE, dense
from benchmarks.bars.line import TOLD, Asked, Line, mean_over_specimens
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens
from benchmarks.suite import BenchScene

ASKED = {1: Asked(63.0, 73.0, "68 +- 5 %"), 2: Asked(90.0, 100.0, "95 +- 5 %")}
"""Of heights within so many sigmas, in percent; 68.3 and 95.4 where sigma is right."""


def fit_scenes(specimens: Specimens) -> dict[str, tuple[BenchScene, ...]]:
    """All scenes of the suite that offer what the dense method needs."""
    needs = set(dense().needs)
    every = {name: specimens.of(name) for name in specimens.names}
    return {name: scenes for name, scenes in every.items() if needs <= set(scenes[0].offers)}


def sigma_questions(specimens: Specimens) -> list[Question]:
    """Ask the dense method on all scenes of the suite."""
    return [(scene, dense()) for scenes in fit_scenes(specimens).values() for scene in scenes]


def sigma_lines(specimens: Specimens, found: Found) -> list[Line]:
    """Take the mean over the suite, then tell every scene."""
    groups = fit_scenes(specimens)
    lines = []
    for sigmas, asked in ASKED.items():
        shares = {name: _shares(specimens, found, name, sigmas) for name in groups}
        known = {name: each for name, each in shares.items() if len(each)}
        means = {name: float(each.mean()) for name, each in known.items()}
        what = f"within {sigmas} sigma, mean over {len(known)} scenes"
        lines.append(Line("sigma", what, asked, mean_over_specimens(list(known.values())), _extremes(means)))
        lines += [
            Line("sigma", f"within {sigmas} sigma, {name}", TOLD, mean_over_specimens([each]), detail=True)
            for name, each in known.items()
        ]
    failures = [each for scenes in groups.values() for each in found.failures(scenes, DENSE)]
    return [*lines, *(Line("sigma", "no answer", TOLD, mean_over_specimens([]), each) for each in failures)]


def _shares(specimens: Specimens, found: Found, name: str, sigmas: int) -> np.ndarray:
    """Percent within so many sigmas, of every specimen that was answered."""
    shares = 100 * found.numbers(specimens.of(name), DENSE, f"within_{sigmas}_sigma")
    return np.asarray(shares[np.isfinite(shares)])


def _extremes(means: dict[str, float]) -> str:
    if not means:
        return ""
    least, most = (choose(means, key=lambda name: means[name]) for choose in (min, max))
    return f"from {means[least]:.3g} % ({least}) to {means[most]:.3g} % ({most})"
