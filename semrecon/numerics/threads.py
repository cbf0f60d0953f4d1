"""How many threads are worth having."""

from __future__ import annotations

import os

LIMIT = "OMP_NUM_THREADS"
"""Environment variable that bounds the threads of a process: whoever runs several side by side sets it."""


def threads() -> int:
    """One a core that this process may use, or fewer where ``OMP_NUM_THREADS`` says so."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    wanted = os.environ.get(LIMIT, "")
    return max(1, min(cores, int(wanted))) if wanted.isdecimal() else cores
