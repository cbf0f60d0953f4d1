"""Accuracy that is committed to: means over repetitions, how far each may move, and the file that says so.

A repetition has its own seed, the same before and after a change, so that on one machine a change that alters nothing
moves nothing, to the bit. What a mean may move by has three parts, of which the largest counts:

- `SPREADS` standard errors of the mean, from the spread between the repetitions: what another draw of the noise does.
  When baselines are written, more repetitions are measured (`FOR_SPREAD` times as many) than the mean rests on, since
  the spread of three values is hardly known;
- `LEAST` of the mean itself, for figures that hardly scatter: another processor or library rounds otherwise, and a
  threshold here and there falls on its other side;
- `FLOOR`, in the unit of the figure, for figures that are zero but for rounding.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cattrs
import numpy as np

from semrecon.errors import InputError

SPREADS = 4.0
LEAST = 0.03
FLOOR = 1e-4
FOR_SPREAD = 2

Say = Callable[[str], None]
"""Called with what is measured next."""
Figures = Mapping[str, float]
"""What one repetition measured, units in the names."""
Means = dict[str, dict[str, float]]
"""Contender, metric: mean over the repetitions."""


@dataclass(frozen=True)
class Bound:
    """What a mean was, and how far from there it may be."""

    mean: float
    tolerance: float


@dataclass(frozen=True)
class Part:
    """What was measured of one kind.

    Parameters
    ----------
    repetitions
        Each mean is over so many.
    columns
        Width of the pictures; 0 where there are none, or where they are of several sizes.
    bounds
        Scene, contender, metric.
    """

    repetitions: int
    columns: int
    bounds: dict[str, dict[str, dict[str, Bound]]]

    def only(self, scene: str, contender: str) -> Part:
        """Pick one contender on one scene."""
        return replace(self, bounds={scene: {contender: self.bounds[scene][contender]}})


Commitment = dict[str, Part]
"""Parts by kind: "kernels", "methods" and "study"; a file of one's own has "methods" alone."""


@dataclass(frozen=True)
class Shift:
    """A mean that left its tolerance; `why` says what happened where there is no mean any more."""

    scene: str
    contender: str
    metric: str
    before: float
    after: float
    tolerance: float
    why: str = ""

    def __str__(self) -> str:
        """Say what moved, from where to where, and what was allowed."""
        reason = f" ({self.why})" if self.why else ""
        return (
            f"{self.scene}, {self.contender}: {self.metric} was {self.before:.5g} and is {self.after:.5g}{reason}, "
            f"which is more than the tolerance of {self.tolerance:.2g} away"
        )


def means_of(figures: Mapping[str, Sequence[Figures]]) -> Means:
    """Average over the repetitions; a metric that some repetition lacks, or has as no number, is NaN.

    Parameters
    ----------
    figures
        By contender, of every repetition.
    """
    return {
        name: {metric: float(_values(each, metric).mean()) for metric in _metrics(each)}
        for name, each in figures.items()
    }


def bounds_of(figures: Mapping[str, Sequence[Figures]], repetitions: int) -> dict[str, dict[str, Bound]]:
    """Commit to the means over the first `repetitions`, with tolerances from the spread of all; NaN is left out."""
    answer = {}
    for name, each in figures.items():
        values = {metric: _values(each, metric) for metric in _metrics(each)}
        known = {metric: bound(one, repetitions) for metric, one in values.items() if np.isfinite(one).all()}
        answer[name] = dict(sorted(known.items()))
    return answer


def bound(values: np.ndarray, repetitions: int) -> Bound:
    """Mean over the first `repetitions` of several values, and its tolerance by the rule of this file."""
    mean = float(values[:repetitions].mean())
    error = float(values.std(ddof=1)) / np.sqrt(repetitions) if len(values) > 1 else 0.0
    return Bound(float(f"{mean:.6g}"), float(f"{max(SPREADS * error, LEAST * abs(mean), FLOOR):.3g}"))


def shifts(scene: str, now: Means, part: Part, why: Mapping[str, str] | None = None) -> list[Shift]:
    """List every committed mean of a scene that left its tolerance; one that is gone or not a number has left it.

    Parameters
    ----------
    now
        Means by contender; contenders that were not committed to are not looked at.
    why
        What a contender said instead of an answer.
    """
    found = []
    for contender, metrics in part.bounds[scene].items():
        for metric, known in metrics.items():
            value = now.get(contender, {}).get(metric, float("nan"))
            if not abs(value - known.mean) <= known.tolerance:
                said = (why or {}).get(contender, "")
                found.append(Shift(scene, contender, metric, known.mean, value, known.tolerance, said))
    return found


def report(found: Iterable[object], renew: str) -> str:
    """Sentences on what moved, one a line, and a last one on what to do if it was meant."""
    return "\n".join(
        [
            *map(str, found),
            f"If that is meant, run `{renew}` and say under Results in the changelog what moved and why.",
        ]
    )


def read_commitment(path: Path) -> Commitment:
    """Read baselines; raises `InputError` for a file that is not there or is none."""
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        commitment = cattrs.structure(content, Commitment)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); name a file that `baselines` wrote") from None
    except Exception:  # cattrs raises groups of whatever went wrong
        raise InputError(f"{path} holds no baselines; name a file that `baselines` wrote") from None
    if not any(part.bounds for part in commitment.values()):
        raise InputError(f"{path} commits to nothing; write it anew with `baselines`")
    return commitment


def write_commitment(commitment: Commitment, path: Path) -> None:
    """Replace baselines; a file that was half written is never seen."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        partial.write_text(
            json.dumps(cattrs.unstructure(commitment), indent=1, sort_keys=True) + "\n", encoding="utf-8"
        )
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None


def _metrics(figures: Sequence[Figures]) -> list[str]:
    return list(dict.fromkeys(metric for each in figures for metric in each))


def _values(figures: Sequence[Figures], metric: str) -> np.ndarray:
    return np.array([each.get(metric, np.nan) for each in figures], dtype=np.float64)
