"""Which pixel records a place: the way back from the beam to the picture, where the scan has errors."""

from __future__ import annotations

import numba
import numpy as np

from semsim.bands import in_bands
from semsim.mesh import Array

CLOSEST_PX = 1e-10
"""Where the search for the column ends."""
MOST_STEPS = 100


def offset_at(offsets_px: Array, xy_px: Array) -> Array:
    """Displacement of the beam at positions (..., 2) between the pixels, bilinear, continued beyond the border.

    Parameters
    ----------
    offsets_px
        (rows, columns, 2), of `semsim.scan.scan_offsets`.
    """
    from scipy.ndimage import map_coordinates

    rows_columns = np.moveaxis(np.asarray(xy_px, dtype=np.float64), -1, 0)[::-1]
    found = [map_coordinates(offsets_px[..., k], rows_columns, order=1, mode="nearest") for k in (0, 1)]
    return np.stack(found, axis=-1)


def recorded_at(offsets_px: Array, beam_px: Array) -> Array:
    """Find the positions (..., 2) at which places under the beam are recorded: ``recorded + offset(recorded) = beam``.

    By fixed-point iteration over the column, with the row that belongs to each worked out exactly: lines that
    approach each other slow an iteration over both, and lines that part make it diverge. Where lines cross, so that the
    beam passes a place more than once, the first time counts.

    Parameters
    ----------
    offsets_px
        (rows, columns, 2), of `semsim.scan.scan_offsets`; between the pixels as `offset_at` has them.
    beam_px
        (..., 2); NaN stays NaN.
    """
    beam = np.ascontiguousarray(np.reshape(beam_px, (-1, 2)), dtype=np.float64)
    answer = np.empty_like(beam)
    reach = int(np.ceil(np.abs(offsets_px[..., 1]).max()))
    in_bands(len(beam), lambda start, stop: _search(start, stop, offsets_px, reach, beam, answer))
    return answer.reshape(np.shape(beam_px))


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _search(
    start: int, stop: int, offsets: Array, reach: int, beam: Array, answer: Array
) -> None:  # pragma: no cover - compiled
    for i in range(start, stop):
        answer[i] = np.nan
        if np.isnan(beam[i, 0]) or np.isnan(beam[i, 1]):
            continue
        column = beam[i, 0]
        for _ in range(MOST_STEPS):
            row = _row(offsets, column, beam[i, 1], reach)
            nearer = beam[i, 0] - _offset(offsets, row, column, 0)
            done = abs(nearer - column) < CLOSEST_PX
            column = nearer
            if done:
                answer[i, 0], answer[i, 1] = column, row
                break


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _row(offsets: Array, column: float, beam_y: float, reach: int) -> float:  # pragma: no cover - compiled
    """First row, in order of the scan, at which a column passes `beam_y`; no line strays farther than `reach`."""
    last = len(offsets) - 1
    line = min(max(int(np.floor(beam_y)) - reach - 1, 0), last)
    above = line + _offset(offsets, float(line), column, 1)
    if above > beam_y:
        return float(line + beam_y - above)
    while line < last:
        below = line + 1 + _offset(offsets, line + 1.0, column, 1)
        if below >= beam_y:
            return float(line + (beam_y - above) / (below - above))
        line, above = line + 1, below
    return float(last + beam_y - above)


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _offset(offsets: Array, row: float, column: float, axis: int) -> float:  # pragma: no cover - compiled
    rows, columns = offsets.shape[:2]
    y, x = min(max(row, 0.0), rows - 1.0), min(max(column, 0.0), columns - 1.0)
    r, c = min(int(y), max(rows - 2, 0)), min(int(x), max(columns - 2, 0))
    down, right = min(r + 1, rows - 1), min(c + 1, columns - 1)
    v, u = y - r, x - c
    upper = (1 - u) * offsets[r, c, axis] + u * offsets[r, right, axis]
    lower = (1 - u) * offsets[down, c, axis] + u * offsets[down, right, axis]
    return float((1 - v) * upper + v * lower)
