"""Bands of rows, or other pieces of work, shared out among threads of our own.

Compiled kernels let go of the interpreter's lock. Numba's own threads are not used: its threading layers differ from
machine to machine, and some of them warn. Every piece writes to its own place, so that order does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from semrecon.numerics.threads import threads

T = TypeVar("T")
BANDS_A_THREAD = 2


def in_bands(rows: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` for bands that cover all `rows`; an exception in one is raised here."""
    step = max(1, -(-rows // (threads() * BANDS_A_THREAD)))
    each(range(0, rows, step), lambda start: work(start, min(start + step, rows)))


def each(items: Iterable[T], work: Callable[[T], object]) -> None:
    """Call `work` for each item, several at once."""
    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(work, items))
