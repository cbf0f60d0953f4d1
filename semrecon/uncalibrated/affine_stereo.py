"""Dense heights from affine cameras: pairs rectified along their epipolar lines, semi-global matching, a joint height.

In px from the image centre a point of depth Z at x1 in the reference view is at ``x2 = A x1 + Z r + t`` in another.
With the unit vector along r and the one across it as axes, the second image turned into these axes and the first one
mapped by ``A x1 + t`` into the same have equal rows, and their disparity is ``|r| Z``. (Affine rectification;
Hirschmueller 2008 for the matching.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, HeightMap, TiltSeries, View
from semrecon.matches.features import normalised_grey, usable_pixels
from semrecon.uncalibrated.affine_cameras import AffineCameras

SUBPIXELS = 16
"""Steps of OpenCV's disparity."""
MUCH_MEMORY = 3e8
"""Cells of the matching volume above which fewer directions are aggregated."""


@dataclass(frozen=True)
class StereoOptions:
    """How dense heights are found.

    Parameters
    ----------
    block_px
        Edge of the window that is compared.
    margin
        Depths are searched this much beyond the middle 98 % of the sparse points, in parts of their width.
    margin_px
        And at least so many px of disparity.
    uniqueness
        Percent by which the best disparity must beat the second.
    speckle_px
        Patches of disparity below so many pixels are noise.
    agree_px
        Heights of several pairs agree where their disparities do to this many px.
    """

    block_px: int = 7
    margin: float = 0.25
    margin_px: float = 8.0
    uniqueness: int = 5
    speckle_px: int = 100
    agree_px: float = 1.5


def dense_heights(
    series: TiltSeries, cameras: AffineCameras, depths_px: Array, depth_sigma: float, options: StereoOptions
) -> HeightMap:
    """Height of every pixel of the reference view.

    Parameters
    ----------
    cameras
        Metric ones, in px from the image centre, in camera axes of the reference view.
    depths_px
        Of sparse points, (points,): where to search.
    depth_sigma
        Relative standard deviation of the scale of heights.
    """
    others = [v for v in range(len(series)) if v != series.reference and np.linalg.norm(cameras.matrices[v, :, 2]) > 0]
    parallax = np.array([np.linalg.norm(cameras.matrices[v, :, 2]) for v in others])
    maps = np.stack([pair_depths(series, cameras, v, depths_px, options) for v in others])
    depth, weight, noise_px = _joint(maps, parallax, options.agree_px)
    height = -depth * series.optics.pixel_size_um
    middle = float(np.nanmedian(height)) if np.isfinite(height).any() else 0.0
    noise = noise_px * series.optics.pixel_size_um / np.sqrt(np.where(weight > 0, weight, np.nan))
    return HeightMap(height, np.hypot(noise, depth_sigma * (height - middle)), series.optics.pixel_size_um)


def pair_depths(
    series: TiltSeries, cameras: AffineCameras, other: int, depths_px: Array, options: StereoOptions
) -> NDArray[np.float32]:
    """Depth of every pixel of the reference view from one other view, (rows, columns) px, NaN where none is found."""
    import cv2

    centre = series.optics.centre_px
    shift = cameras.matrices[other, :, 2]
    parallax = float(np.linalg.norm(shift))
    axes = np.array([[shift[0], shift[1]], [-shift[1], shift[0]]]) / parallax
    first, second = axes @ cameras.matrices[other, :, :2], axes
    corner, size = _canvas(series, first, second, axes @ cameras.offsets[other])
    to_first = np.column_stack([first, axes @ cameras.offsets[other] - corner - first @ centre])
    to_second = np.column_stack([second, -corner - second @ centre])
    left, right = (
        cv2.warpAffine(_grey(series.views[v]), m, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for v, m in ((series.reference, to_first), (other, to_second))
    )
    disparity = _matched(left, right, -parallax * depths_px, options)
    rows, columns = np.indices(series.optics.shape, dtype=np.float32)
    at = [(to_first[k, 0] * columns + to_first[k, 1] * rows + to_first[k, 2]).astype(np.float32) for k in (0, 1)]
    nan = float("nan")
    found = cv2.remap(disparity, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=nan)
    inside = _inside(at[0] - found, at[1], to_second, series.optics.shape)
    return np.where(inside & usable_pixels(series.views[series.reference]), found / -parallax, np.nan)


def _canvas(series: TiltSeries, first: Array, second: Array, shift: Array) -> tuple[Array, tuple[int, int]]:
    """Upper left corner and size of the frame that holds both mapped images."""
    half = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * (series.optics.centre_px + 0.5)
    corners = np.concatenate([half @ first.T + shift, half @ second.T])
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    return low, (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)


def _grey(view: View) -> NDArray[np.uint8]:
    return normalised_grey(view.image, usable_pixels(view), (0.5, 99.5), view.name)


def _matched(
    left: NDArray[np.uint8], right: NDArray[np.uint8], expected_px: Array, options: StereoOptions
) -> NDArray[np.float32]:
    """Semi-global matching: left minus right column, NaN where it is refused."""
    import cv2

    low, high = np.percentile(expected_px, (1, 99))
    margin = options.margin * (high - low) + options.margin_px
    least = int(np.floor(low - margin))
    count = 16 * int(np.ceil((high + margin - least) / 16))
    # OpenCV gives no disparity to a strip at the side that the search leaves: lend it one
    pad = (max(least + count, 0), max(-least, 0))
    wide = [cv2.copyMakeBorder(one, 0, 0, pad[0], pad[1], cv2.BORDER_REPLICATE) for one in (left, right)]
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        minDisparity=least,
        numDisparities=count,
        blockSize=options.block_px,
        P1=8 * options.block_px**2,
        P2=32 * options.block_px**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=options.uniqueness,
        speckleWindowSize=options.speckle_px,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH if wide[0].size * count < MUCH_MEMORY else cv2.STEREO_SGBM_MODE_SGBM,
    )
    found = matcher.compute(wide[0], wide[1])[:, pad[0] : pad[0] + left.shape[1]]
    return np.where(found >= SUBPIXELS * least, found / np.float32(SUBPIXELS), np.nan).astype(np.float32)


def _inside(
    column: NDArray[np.float32], row: NDArray[np.float32], to_second: Array, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Tell whether rectified positions lie within the second image."""
    back = np.linalg.inv(to_second[:, :2])
    x, y = (back[k, 0] * (column - to_second[0, 2]) + back[k, 1] * (row - to_second[1, 2]) for k in (0, 1))
    return np.asarray((x > -0.5) & (x < shape[1] - 0.5) & (y > -0.5) & (y < shape[0] - 0.5))


def _joint(maps: NDArray[np.float32], parallax: Sequence[float] | Array, agree_px: float) -> tuple[Array, Array, float]:
    """Weighted mean of the pairs that agree with their median: depth, sum of squared parallax, noise of a disparity."""
    known = np.isfinite(maps)
    steps = np.asarray(parallax)[:, None, None]
    count = known.sum(axis=0)
    ordered = np.sort(np.where(known, maps, np.inf), axis=0)
    low, high = (np.take_along_axis(ordered, np.maximum(k, 0)[None], axis=0)[0] for k in ((count - 1) // 2, count // 2))
    high = np.where(np.isfinite(high), high, low)
    with np.errstate(invalid="ignore"):
        middle = (low + high) / 2
        good = known & (np.abs(maps - middle) * steps <= agree_px)
    good &= good.sum(axis=0) >= np.minimum(count, 2)
    weight = np.where(good, steps**2, 0.0).sum(axis=0)
    total = np.where(good, maps * steps**2, 0.0).sum(axis=0)
    depth = np.where(weight > 0, total / np.where(weight > 0, weight, 1.0), np.nan)
    several = good & (good.sum(axis=0) > 1)
    misses = np.abs((maps - depth) * steps)[several]
    shrink = np.sqrt(1 - 1 / max(len(maps), 2))
    noise = 1.4826 * float(np.median(misses)) / shrink if misses.size else 0.5
    return depth, weight, noise
