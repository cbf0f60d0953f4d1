"""Processes that work side by side, share the cores out among them, and end with whoever started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What tells libraries, and our own bands of rows, how many threads to start."""


def cores() -> int:
    """Count the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def threads() -> int:
    """How many threads are worth having: one a core, or fewer where ``OMP_NUM_THREADS`` says so."""
    wanted = os.environ.get(THREADS[0], "")
    return max(1, min(cores(), int(wanted))) if wanted.isdecimal() else cores()


def process_pool(workers: int) -> ProcessPoolExecutor:
    """Make an executor of fresh processes that end when this one does, even if it is killed.

    Each has its share of the cores: threads that outnumber them wait for each other. What the environment says of
    threads already holds.
    """
    context = multiprocessing.get_context("spawn")
    share = max(1, cores() // workers)
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(share,))


def _begin(share: int) -> None:
    """Share the cores out before any library reads the environment, and end with the parent."""
    for name in THREADS:
        os.environ.setdefault(name, str(share))
    _end_with_parent()


def _end_with_parent() -> None:
    """Watch the parent: an orphaned worker would wait for work, and hold its memory, for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
