"""Speed that is committed to: how many times a reference each kernel and each method takes, and what is too slow.

The committed ratio is the median of `SERIES` measurements, each the least of several turns (`references.timed`). It may
grow by a factor of ``exp(SPREADS s)``, s being the standard deviation of the logarithm over those measurements, but by
no less than `LEAST` and no more than `MOST`: what a machine at work for others scatters is allowed for, and what takes
twice as long is caught. A ratio that is too high is measured again before it counts, and the least times of call and
reference are pooled: another's burst of work passes, a slower kernel stays slow. Ratios differ between processors; on
another machine write them anew, and gate there on those.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cattrs
import numpy as np

from benchmarks.gate.references import timed
from semrecon.errors import InputError

SERIES = 3
SPREADS = 4.0
LEAST, MOST = 1.5, 1.7
AGAIN = 2


@dataclass(frozen=True)
class Pace:
    """How many times its reference something takes, and by what factor that may grow."""

    reference: str
    ratio: float
    factor: float


Paces = dict[str, Pace]
"""By name of the kernel, or of scene and method."""


@dataclass(frozen=True)
class Slower:
    """Something that takes more than its factor allows."""

    name: str
    known: Pace
    ratio: float

    def __str__(self) -> str:
        """Say what became slower, from where to where, and what was allowed."""
        return (
            f"{self.name}: processor time was {self.known.ratio:.4g} and is {self.ratio:.4g} times that of the "
            f"reference {self.known.reference!r}, which is {self.ratio / self.known.ratio:.2f} times as much; the "
            f"tolerance is {self.known.factor:.2f} times"
        )


def slower(name: str, known: Pace, call: Callable[[], Any]) -> tuple[float, Slower | None]:
    """Measure a ratio, again if it is too high; return it and, if it is still too high, what to say.

    The call has been made before, so that nothing is compiled on the clock.
    """
    pooled = timed(call, known.reference)
    for _ in range(AGAIN):
        if not too_slow(known, pooled.ratio):
            return pooled.ratio, None
        pooled = pooled.least(timed(call, known.reference))
    return pooled.ratio, Slower(name, known, pooled.ratio) if too_slow(known, pooled.ratio) else None


def too_slow(known: Pace, ratio: float) -> bool:
    """Whether a ratio has grown by more than its factor; one that is not a number has."""
    return not ratio <= known.ratio * known.factor


def pace_of(call: Callable[[], Any], reference: str) -> Pace:
    """Commit to the speed of a call, which is made once before the clock runs."""
    call()
    return pace(reference, np.array([timed(call, reference).ratio for _ in range(SERIES)]))


def pace(reference: str, ratios: np.ndarray) -> Pace:
    """Commit to the median of ratios, with the factor of this file's rule."""
    spread = float(np.exp(SPREADS * np.log(ratios).std(ddof=1)))
    return Pace(reference, float(f"{np.median(ratios):.4g}"), float(f"{np.clip(spread, LEAST, MOST):.3g}"))


def read_paces(path: Path) -> Paces:
    """Read committed ratios; raises `InputError` for a file that is not there or is none."""
    try:
        return cattrs.structure(json.loads(path.read_text(encoding="utf-8")), Paces)
    except Exception:  # cattrs raises groups of whatever went wrong
        raise InputError(f"{path} holds no committed times; write it with `baselines --times`") from None


def write_paces(paces: Paces, path: Path) -> None:
    """Replace committed ratios."""
    text = json.dumps(cattrs.unstructure(paces), indent=1, sort_keys=True) + "\n"
    path.write_text(text, encoding="utf-8")
