"""Bands of rows, or other pieces of work, shared out among threads of our own.

Compiled kernels let go of the interpreter's lock. Numba's own threads are not used: its threading layers differ from
machine to machine, and some of them warn. Every piece writes to its own place, so that order does not matter.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from semrecon.numerics.threads import threads

T = TypeVar("T")
BANDS_A_THREAD = 2
FEW_ROWS = 64
"""So few rows are done before a thread has woken up."""
_here = threading.local()


def in_bands(rows: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` for bands that cover all `rows`; an exception in one is raised here."""
    if rows <= FEW_ROWS:
        work(0, rows)
        return
    step = max(1, -(-rows // (threads() * BANDS_A_THREAD)))
    each(range(0, rows, step), lambda start: work(start, min(start + step, rows)))


def each(items: Iterable[T], work: Callable[[T], object]) -> None:
    """Call `work` for each item, several at once; what is called from there calls one after the other."""
    if threads() == 1 or getattr(_here, "busy", False):
        for item in items:
            work(item)
        return
    list(_pool(threads()).map(work, items))


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Threads that wait for work: to start them anew for each piece takes longer than many a piece."""
    return ThreadPoolExecutor(workers, initializer=lambda: setattr(_here, "busy", True))
