"""Shift between two whole pictures by phase correlation (Kuglin and Hines 1975), with a test against chance."""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage

from semrecon.data import Array, View
from semrecon.matches.features import usable_pixels

SIGNIFICANT = 7.0
"""Height of the peak over the standard deviation of the correlation: one in a million pictures by chance."""
BLUR_PX = 1.5
"""Before correlating: noise of single pixels has nothing in common."""
LIKENESS_PX = 12.0
"""Brightness is levelled over this distance, so that slow shading has no part in the phase."""


def phase_shift(first: View, second: View, relative: Array, shift_px: Array) -> Array | None:
    """Find what is still to be added to the shift of a view, in pixels of the first one.

    Parameters
    ----------
    first, second
        Two views of one size.
    relative
        Map from positions in the first to positions in the second view, both from the image centre, (2, 2).
    shift_px
        Shift of the second view so far, (2,) as (column, row).

    Returns
    -------
    (2,); None where no shift stands out.
    """
    centre = (np.array(first.image.shape)[::-1] - 1) / 2
    matrix = np.asarray(relative)[::-1, ::-1]  # SciPy counts (row, column)
    offset = (centre + shift_px - relative @ centre)[::-1]
    one, known = _levelled(first)
    other, there = _levelled(second)
    drawn = ndimage.affine_transform(other, matrix, offset, order=1)
    both = known & (ndimage.affine_transform(there.astype(np.float32), matrix, offset, order=1) > 0.99)
    if not both.any() or one[both].std() == 0 or drawn[both].std() == 0:
        return None
    taper = _taper(first.image.shape)
    return _peak(one * both * taper, drawn * both * taper)


def _levelled(view: View) -> tuple[Array, np.ndarray]:
    """Blurred grey values about their local mean, and where they may be used."""
    usable = usable_pixels(view)
    if not usable.any():
        return np.zeros(view.image.shape), usable
    plain = np.where(usable, view.image, np.median(view.image[usable])).astype(np.float64)
    level = ndimage.gaussian_filter(plain, BLUR_PX) - ndimage.gaussian_filter(plain, LIKENESS_PX)
    return level / max(float(level.std()), 1e-300), usable


def _taper(shape: tuple[int, ...]) -> Array:
    return np.asarray(np.outer(np.hanning(shape[0]), np.hanning(shape[1])))


def _peak(one: Array, other: Array) -> Array | None:
    """Sub-pixel place of the highest peak of the phase correlation, None where chance would do as well."""
    spectrum = fft.rfft2(other) * np.conj(fft.rfft2(one))
    size = np.abs(spectrum)
    # what is far below the mean strength holds no phase but that of rounding
    correlation = fft.irfft2(spectrum / (size + 0.1 * size.mean() + 1e-300), s=one.shape)
    row, column = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    if correlation[row, column] < SIGNIFICANT * correlation.std():
        return None
    fine = [_vertex(correlation, int(row), int(column), axis) for axis in (1, 0)]
    rows, columns = one.shape
    place = np.array([column + fine[0], row + fine[1]])
    size_px = np.array([columns, rows])
    return np.asarray((place + size_px / 2) % size_px - size_px / 2)


def _vertex(values: Array, row: int, column: int, axis: int) -> float:
    """Offset of a parabola's top through the peak and its neighbours, within half a pixel."""
    step = (1, 0) if axis == 0 else (0, 1)
    rows, columns = values.shape
    low = values[(row - step[0]) % rows, (column - step[1]) % columns]
    high = values[(row + step[0]) % rows, (column + step[1]) % columns]
    bend = low - 2 * values[row, column] + high
    return float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5)) if bend < 0 else 0.0
