"""Work that never changes, beside which kernels and methods are timed, and the clock that times them.

A time means little on another machine, and not much on this one while others work on it. What is gated is a ratio:
time of a call over that of a reference of like character, taken in turns in one process, the least of several turns
each. The time is that of the processor (all threads together), not of the wall, so that waiting for a turn on a busy
machine does not count; what remains is what neighbours do to caches and clock rates, which the turns share out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from semrecon.data import Array

TURNS, FEWER, LONG_S = 5, 2, 0.3
"""Turns of a call, and of one that takes longer than `LONG_S`."""
SAMPLE_S = 0.02
"""Shorter calls are repeated until one turn takes about so long."""
MOST_CALLS = 10_000


@dataclass(frozen=True)
class Timing:
    """Least processor time of a call and of its reference, seconds."""

    call_s: float
    reference_s: float

    @property
    def ratio(self) -> float:
        """How many times the reference the call takes."""
        return self.call_s / self.reference_s

    def least(self, other: Timing) -> Timing:
        """Pool two measurements: the least of each, as what disturbs a time only adds to it."""
        return Timing(min(self.call_s, other.call_s), min(self.reference_s, other.reference_s))


def timed(call: Callable[[], Any], reference: str) -> Timing:
    """Time a call, which has run before, and a reference in turns, so that nothing is compiled on the clock."""
    other = REFERENCES[reference]
    other()
    call_s, other_s = _seconds(call, 1), _seconds(other, 1)
    often, others = _calls(call_s), _calls(other_s)
    for _ in range(FEWER if call_s > LONG_S else TURNS):
        other_s = min(other_s, _seconds(other, others))
        call_s = min(call_s, _seconds(call, often))
    return Timing(call_s, other_s)


def _calls(seconds: float) -> int:
    """Count the calls that make a sample long enough for the clock."""
    return min(max(1, math.ceil(SAMPLE_S / max(seconds, 1e-7))), MOST_CALLS)


def _seconds(call: Callable[[], Any], count: int) -> float:
    started = time.process_time()
    for _ in range(count):
        call()
    return (time.process_time() - started) / count


def loops() -> float:
    """Compiled loops over a picture of two megabytes: bilinear samples, sums and a root, as in kernels of our own."""
    return float(_sampled(_PICTURE))


def arrays() -> float:
    """NumPy on arrays of some megabytes: sums of products, small systems, sorting, as in the sparse stages."""
    products = np.einsum("nij,nik->njk", _STACK, _STACK) + np.eye(3)
    solved = np.linalg.solve(products, _STACK[:, 0, :, None])
    return float(np.sort(np.sqrt(_STACK**2 + 1.0).ravel())[0] + solved[0, 0, 0])


REFERENCES: dict[str, Callable[[], float]] = {"loops": loops, "arrays": arrays}


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _sampled(picture: Array) -> float:  # pragma: no cover - compiled
    total = 0.0
    rows, columns = picture.shape
    for turn in range(24):
        shift = 0.37 + 0.1 * turn
        for y in range(rows - 2):
            for x in range(columns - 2):
                u = x + shift
                i = int(u)
                a = u - i
                low = picture[y, i] + a * (picture[y, i + 1] - picture[y, i])
                high = picture[y + 1, i] + a * (picture[y + 1, i + 1] - picture[y + 1, i])
                total += math.sqrt(1.0 + (high - low) ** 2) * (1.0 if high > low else 0.5)
    return total


_PICTURE = np.random.default_rng(0).normal(size=(512, 512))
_STACK = np.random.default_rng(1).normal(size=(20_000, 4, 3))
