"""The bars, by name: what each asks, of whom, and how its lines are drawn up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.bars import depth, honesty, left_out, limit, real, shading, size, tilts
from benchmarks.bars.derived import Numbers, same_points, tilts_of
from benchmarks.bars.entrants import DENSE, SEED
from benchmarks.bars.line import Line
from benchmarks.bars.plan import Found, Question
from benchmarks.bars.specimens import Specimens
from benchmarks.bars.start import begun_at_truth
from benchmarks.running.case import Case
from benchmarks.running.runner import Job
from benchmarks.suite import BenchScene
from semrecon.errors import InputError

Answered = Mapping[tuple[str, str], Case]
"""Cases that have an estimate on record, by name of scene and of method."""
Derivation = tuple[Callable[..., tuple[tuple[str, str], Numbers]], tuple[Any, ...]]
"""A call that works out numbers beside the scores, for a worker."""


@dataclass(frozen=True)
class Bar:
    """One promise, or a few that are measured alike.

    Parameters
    ----------
    name, about
        Name on the command line, and a sentence for people.
    questions
        Scenes, and who is asked on them.
    lines
        What is said of the answers.
    derivations
        What else is worked out from answers on record.
    jobs
        What is measured otherwise than as a case.
    efficiency
        Whether the physical limit is needed.
    alone
        Whether its jobs run one by one when all else is done, because they are timed.
    """

    name: str
    about: str
    lines: Callable[[Specimens, Found], list[Line]]
    questions: Callable[[Specimens], list[Question]] = lambda _: []
    derivations: Callable[[Specimens, Answered, Path], list[Derivation]] = lambda *_: []
    jobs: Callable[[Specimens], list[Job]] = lambda _: []
    efficiency: bool = False
    alone: bool = False


def all_bars(*, quick: bool) -> tuple[Bar, ...]:
    """Make all bars, in the order of tables; `quick` is for those that choose their own pictures."""
    return (
        _against_pair("adjacent", widest=False),
        _against_pair("widest", widest=True),
        Bar(
            "smooth",
            "On the smooth fracture no worse than the best other contender.",
            depth.smooth_lines,
            depth.smooth_questions,
        ),
        Bar(
            "diatom",
            f"On the diatom better than {SEED} at its very points.",
            depth.diatom_lines,
            depth.diatom_questions,
            _diatom_derivations,
        ),
        Bar(
            "efficiency",
            "Median error over the least that the electrons allow, on textured scenes.",
            limit.efficiency_lines,
            limit.efficiency_questions,
            efficiency=True,
        ),
        Bar(
            "tilt_error",
            f"Tilts that are stated {tilts.OFF_DEG:g} degrees off are found again.",
            tilts.tilt_lines,
            tilts.tilt_questions,
            _tilt_derivations,
        ),
        Bar("sigma", "The stated sigma is that of the errors.", honesty.sigma_lines, honesty.sigma_questions),
        Bar(
            "shading",
            "The choice of shading never loses more than a tenth to parallax alone.",
            shading.shading_lines,
            shading.shading_questions,
        ),
        Bar(
            "size",
            "Seconds and memory on series of the usual sizes; they are of this machine.",
            partial(size.size_lines, quick=quick),
            jobs=partial(size.size_jobs, quick=quick),
            alone=True,
        ),
        Bar(
            "real",
            "Halves of a real series that share no picture agree, and a picture left out is predicted.",
            lambda _, found: real.real_lines(found) + left_out.left_out_lines(found),
            jobs=lambda _: real.real_jobs(quick=quick) + left_out.left_out_jobs(quick=quick),
        ),
    )


def chosen(bars: Sequence[Bar], names: Sequence[str]) -> tuple[Bar, ...]:
    """Pick bars by name, all if none is named; raises `InputError` for a name that is not one."""
    known = {bar.name: bar for bar in bars}
    for name in names:
        if name not in known:
            raise InputError(f"--only names no bar {name!r}; there are {', '.join(known)}")
    return tuple(bar for bar in bars if bar.name in names or not names)


def _against_pair(name: str, *, widest: bool) -> Bar:
    which = "the pair of widest baseline" if widest else "an adjacent pair"
    return Bar(
        name,
        f"Median error at all judged pixels over that of {SEED} at its points on {which}.",
        partial(depth.pair_lines, bar=name, widest=widest),
        partial(depth.pair_questions, widest=widest),
        (lambda *_: []) if widest else _truth_derivations,
    )


def _truth_derivations(specimens: Specimens, answered: Answered, ledger: Path) -> list[Derivation]:
    asked = [(scene.name, DENSE) for name in depth.TWO_VIEW_SCENES for scene in specimens.of(name)]
    return [(begun_at_truth, (ledger, answered[each])) for each in asked if each in answered]


def _diatom_derivations(specimens: Specimens, answered: Answered, ledger: Path) -> list[Derivation]:
    pairs = [(scene.name, DENSE, SEED) for scene in specimens.of(depth.DIATOM)]
    return [
        (same_points, (ledger, answered[scene, one], answered[scene, other]))
        for scene, one, other in pairs
        if (scene, one) in answered and (scene, other) in answered
    ]


def _tilt_derivations(specimens: Specimens, answered: Answered, ledger: Path) -> list[Derivation]:
    asked: list[BenchScene] = [scene for scene, _ in tilts.tilt_questions(specimens)]
    return [(tilts_of, (ledger, answered[s.name, DENSE])) for s in asked if (s.name, DENSE) in answered]
