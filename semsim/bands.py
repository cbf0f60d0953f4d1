"""Rows of a picture shared out among threads.

Threads of our own rather than numba's: its threading layers differ from machine to machine, and some of them warn.
Compiled kernels let go of the interpreter's lock, so that the threads run at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from semsim.workers import threads

BANDS_A_THREAD = 4
"""More bands than threads, because some are full of specimen and others empty."""


def in_bands(rows: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` for bands that cover all `rows`; an exception in one is raised here."""
    step = max(1, -(-rows // (threads() * BANDS_A_THREAD)))
    starts = range(0, rows, step)
    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(lambda start: work(start, min(start + step, rows)), starts))
