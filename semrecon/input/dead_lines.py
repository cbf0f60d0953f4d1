"""Dead lines: rows and columns that hold no picture, wherever they are. They stand still while the specimen moves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Image, Mask
from semrecon.input.databar import find_data_bar

ONE_VALUE, PICTURE = 0.98, 0.9
"""A line is flat if this part of its pixels has one value; a line of a picture has less than the other."""
JUMP = 1.5
"""A black or white line differs from its neighbours by more than this many times of what they differ from theirs."""
MOST_LINES = 8
"""More flat lines side by side are a dark background or a saturated place, not a fault of the scan."""
MOST_REPEATED = 0.05
"""Of more lines than this part, an image with repeated lines has been enlarged."""
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class DeadLines:
    """Indices of the `rows` and `columns` of an image that hold no picture, in order."""

    rows: Indices
    columns: Indices

    def __bool__(self) -> bool:
        return bool(len(self.rows) or len(self.columns))

    def __str__(self) -> str:
        """Name them for a sentence, counted from 0: rows 3-5 and column 17."""
        named = [_named("row", self.rows), _named("column", self.columns)]
        return " and ".join(name for name in named if name)


def find_dead_lines(image: Image) -> DeadLines:
    """Find rows and columns that are flat (black, white or any one value), repeat their neighbour, or are all NaN.

    A flat line counts only between lines of a picture that go on past it as if it were not there. So dark backgrounds,
    saturated places and bright edges along the scan are none, and neither is the plain paper of a data bar.

    Parameters
    ----------
    image
        (rows, columns); NaN where there is no value.
    """
    return DeadLines(_dead_rows(image), _dead_rows(image.T))


def dead_lines_of(image: Image) -> DeadLines:
    """Find the dead lines of a micrograph above its data bar, where it has one: a bar has flat rows by nature."""
    lines = find_dead_lines(image)
    bar = find_data_bar(image) if lines else None
    return lines if bar is None else DeadLines(lines.rows[lines.rows < len(image) - bar], lines.columns)


def said_of(found: Iterable[tuple[str, DeadLines]]) -> list[str]:
    """Write a sentence for all pictures, by name, that have the same dead lines."""
    names: dict[str, list[str]] = {}
    for name, lines in found:
        if lines:
            names.setdefault(str(lines), []).append(name)
    return [f"{', '.join(those)}: no picture in {lines} (counted from 0), left out" for lines, those in names.items()]


def without(lines: DeadLines, shape: tuple[int, int]) -> Mask:
    """Make a mask (rows, columns) of what may be used: False in dead lines."""
    usable = np.ones(shape, dtype=np.bool_)
    usable[lines.rows] = False
    usable[:, lines.columns] = False
    return usable


def _dead_rows(image: Image) -> Indices:
    if min(image.shape) < 2 * MOST_LINES:
        return np.zeros(0, dtype=np.int64)
    empty = np.isnan(image).all(axis=1)
    same = _share_of_one_value(image)
    dead = empty | _repeated(image, same)
    for start, stop in _runs((same >= ONE_VALUE) & ~empty):
        if stop - start <= MOST_LINES and _stands_out(image, same, start, stop):
            dead[start:stop] = True
    return np.flatnonzero(dead)


def _share_of_one_value(image: Image) -> NDArray[np.float64]:
    """Part of each row that has the row's median, (rows,): 1 where it is flat."""
    middle = np.partition(image, image.shape[1] // 2, axis=1)[:, image.shape[1] // 2]
    return np.asarray((image == middle[:, None]).mean(axis=1))


def _repeated(image: Image, same: NDArray[np.float64]) -> Mask:
    """Rows of a picture that are the row above over again."""
    repeated = np.zeros(len(image), dtype=np.bool_)
    repeated[1:] = (image[1:] == image[:-1]).all(axis=1) & (same[1:] < PICTURE)
    return repeated if repeated.mean() <= MOST_REPEATED else np.zeros_like(repeated)


def _runs(flat: Mask) -> Iterable[tuple[int, int]]:
    """First row and one past the last of each stretch of flat rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]]).astype(np.int8)))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _stands_out(image: Image, same: NDArray[np.float64], start: int, stop: int) -> bool:
    """Tell whether the picture on each side that there is ends at the run at once, and does not lead up to it.

    A grey line between lines of a picture needs no more; black and white ones could be what clipping leaves of it.
    """
    clipped = image[start].max() == np.nanmax(image) or image[start].min() == np.nanmin(image)
    least = JUMP if clipped else 0.0
    sides = [(start, start - 1, start - 2)] if start >= 2 else []
    sides += [(stop - 1, stop, stop + 1)] if stop + 2 <= len(image) else []
    return bool(sides) and all(
        same[[near, next_]].max() <= PICTURE
        and _difference(image, line, near) > least * _difference(image, near, next_)
        for line, near, next_ in sides
    )


def _difference(image: Image, first: int, second: int) -> float:
    """Mean absolute difference of two rows."""
    return float(np.nanmean(np.abs(image[first].astype(np.float64) - image[second])))


def _named(noun: str, indices: Indices) -> str:
    if not len(indices):
        return ""
    breaks = np.flatnonzero(np.diff(indices) > 1) + 1
    spans = [f"{part[0]}" if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in np.split(indices, breaks)]
    return f"{noun}{'s' if len(indices) > 1 else ''} {', '.join(spans)}"
