"""What a height from a slope is worth: whether other views find it again, whose it is, and its standard deviation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.dense.sightlines import Sightlines

WIDE = 8 / 3
"""Windows across which relief is judged where a height belongs to another place."""


def seen_from(lines: Sightlines, view: int) -> Sightlines:
    """Take the stage positions relative to another view."""
    matrices = lines.matrices.copy()
    matrices[:, :2, 3] -= lines.matrices[view, :2, 3]
    return replace(lines, matrices=matrices, reference=view)


def check_views(lines: Sightlines) -> tuple[int, ...]:
    """Choose where heights are looked for again: the view farthest along the path, and one half way to it."""
    away = np.linalg.norm(lines.matrices[:, :2, 3] - lines.matrices[lines.reference, :2, 3], axis=1)
    far = int(np.argmax(away))
    middle = int(np.argmin(np.abs(away - away[far] / 2)))
    return tuple(dict.fromkeys(view for view in (far, middle) if view != lines.reference))


def found_again(heights: Array, theirs: Array, lines: Sightlines, view: int, tolerance_px: float) -> Mask:
    """Tell which heights another view's map has too, (rows, columns); what lies outside its picture counts as found.

    Parameters
    ----------
    heights, theirs
        Of the reference and of the other view, each on its own grid, px; along the beam both are the same.
    tolerance_px
        Motion between the two views by which they may differ.
    """
    k = lines.k
    shift = lines.matrices[view, :2, 3] - lines.matrices[lines.reference, :2, 3]
    row, column = np.indices(heights.shape)
    stretch = 1 / (1 - k * np.where(np.isfinite(heights), heights, 0.0))
    i = np.rint(row + shift[1] * stretch).astype(np.int64)
    j = np.rint(column + shift[0] * stretch).astype(np.int64)
    inside = (i >= 0) & (j >= 0) & (i < heights.shape[0]) & (j < heights.shape[1])
    nearest = np.full(heights.shape, np.inf)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            there = theirs[np.clip(i + di, 0, heights.shape[0] - 1), np.clip(j + dj, 0, heights.shape[1] - 1)]
            nearest = np.fmin(nearest, np.abs(there - heights))
    motion = k * stretch**2 * float(np.linalg.norm(shift))
    unknown = ~np.isfinite(theirs[np.clip(i, 0, heights.shape[0] - 1), np.clip(j, 0, heights.shape[1] - 1)])
    return np.asarray(~inside | unknown | (nearest * motion <= tolerance_px))


def off_centre(weight: Array, window_px: float) -> Array:
    """Measure how far the middle of the weight within a Gaussian window lies from the window's own, (rows, columns) px.

    For a Gaussian window that is ``window^2 |grad log(windowed weight)|``: nothing in even texture, the distance itself
    beside a lone edge. There the height is that of the edge, and not that of the pixel.
    """
    windowed = ndimage.gaussian_filter(weight, window_px, mode="constant")
    down, across = np.gradient(np.log(np.maximum(windowed, 1e-12)))
    return np.asarray(window_px**2 * np.hypot(down, across))


def stated_sigma(
    heights: Array, noise: Array, aside_px: Array, *, window_px: float, relief: float, aside: float
) -> Array:
    """Add to the noise what a window costs where the surface is no plane within it, one sigma, (rows, columns) px.

    To the noise come the deviation of the heights from a plane within the window, `relief` times; and that within a
    wider one, `aside` times the share of the window by which the height belongs to another place. In even texture on a
    plane next to nothing is added. Shading that moves with the beam (1.7 degrees over the path of the bench) is in the
    first: it bends the heights as relief does.
    """
    known = np.isfinite(heights)
    if not known.any():
        return np.full(heights.shape, np.nan)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    whole = heights[tuple(nearest)]
    doubt = np.where(np.isfinite(noise), noise, np.nanmedian(noise)) ** 2
    near, wide = (_off_plane(whole, doubt, window_px, size) for size in (1.0, WIDE))
    share = aside_px / window_px
    return np.asarray(np.sqrt(noise**2 + relief**2 * near + (aside * share) ** 2 * wide))


def _off_plane(heights: Array, variance: Array, window_px: float, size: float) -> Array:
    """Mean square deviation from the local plane within `size` windows, less that of the noise, (rows, columns) px^2.

    Noise that was averaged over a Gaussian window w deviates within one of size r w by ``(r^2 / (1 + r^2))^2`` of its
    variance.
    """
    level, across_px = heights - np.median(heights), size * window_px
    mean, square = (ndimage.gaussian_filter(one, across_px, mode="nearest") for one in (level, level**2))
    down, across = np.gradient(mean)
    of_noise = (size**2 / (1 + size**2)) ** 2 * ndimage.gaussian_filter(variance, across_px, mode="nearest")
    return np.asarray(np.maximum(square - mean**2 - across_px**2 * (down**2 + across**2) - of_noise, 0.0))
