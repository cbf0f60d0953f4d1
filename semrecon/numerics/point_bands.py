"""Work on many points in bands, several at once, with an answer that does not depend on the threads.

Kernels that release the interpreter's lock run side by side. Bands are cut by a fixed length, never by the number of
threads, and their answers come back in order, so that sums over bands are the same bits on any machine.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from semrecon.numerics.threads import threads

LENGTH = 1024
"""Points in a band: long enough to make a call worth while, short enough to share the work out."""

T = TypeVar("T")


def in_bands(work: Callable[[int, int], T], points: int, length: int = LENGTH) -> list[T]:
    """Call ``work(first, last)`` for consecutive bands of points and return the answers in order.

    Parameters
    ----------
    work
        Must write to its own rows only; called from several threads at once where there is more than one band.
    points
        How many there are; none is no call.
    length
        Of a band.
    """
    bands = [(first, min(first + length, points)) for first in range(0, points, length)]
    if len(bands) < 2:
        return [work(*band) for band in bands]
    with ThreadPoolExecutor(threads()) as pool:
        return list(pool.map(lambda band: work(*band), bands))
