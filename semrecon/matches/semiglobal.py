"""Semi-global matching of a rectified pair, then least squares on the grey values for the fraction of a pixel.

Hirschmueller 2008, as OpenCV has it: the Birchfield-Tomasi dissimilarity over a small block, aggregated along eight
directions, with a left-right check. Its parabola leaves disparities crowded about whole pixels, so that each is then
moved to where the two pictures agree best in a Gaussian window (Lucas and Kanade 1981, in one dimension), and smoothed
within surfaces. The gradient is the mean of both pictures', as that of one noisy picture is biased. Brightness and
contrast change with tilt, so both steps see pictures whose local mean and contrast are taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.errors import InputError

Picture = NDArray[np.float32]
SUBPIXELS = 16
"""Steps of OpenCV's disparity."""
MUCH_MEMORY = 3e8
"""Cells of the cost volume above which five directions are aggregated instead of eight, in one pass."""
LEAST_POWER = 1e-3
"""Squared gradient, of normalised grey a pixel, below which there is nothing to fit."""
FAR = 20.0
"""Disparity, px, by which a missing neighbour is set apart, so that smoothing leaves it out."""


@dataclass(frozen=True)
class SemiGlobalOptions:
    """How a rectified pair is matched.

    Parameters
    ----------
    block_px
        Edge of the block that is compared, odd.
    smooth
        Penalties for a change of disparity by one pixel and by more, in grey levels (of 256) a pixel of the block.
    uniqueness
        Percent by which the best disparity must beat the second.
    agree_px
        Most difference between left-right and right-left disparity, whole px.
    speckle_px
        Patches of disparity of fewer pixels are taken for wrong.
    local_px
        Standard deviation of the window in which mean and contrast are taken out, px.
    blur_px
        Blur of both pictures before they are compared, px.
    window_px
        Standard deviation of the window of the least squares, px; 0 leaves the parabola's disparity.
    steps
        Steps of the least squares.
    """

    block_px: int = 5
    smooth: tuple[float, float] = (16.0, 64.0)
    uniqueness: int = 5
    agree_px: int = 1
    speckle_px: int = 100
    local_px: float = 6.0
    blur_px: float = 0.4
    window_px: float = 4.0
    steps: int = 3

    def __post_init__(self) -> None:
        if self.block_px < 1 or self.block_px % 2 == 0:
            raise InputError(f"option block_px must be an odd number of pixels, not {self.block_px}")
        if not 0 <= self.smooth[0] < self.smooth[1]:
            raise InputError(f"option smooth must be two rising numbers, not {list(self.smooth)}")


@dataclass(frozen=True)
class Disparities:
    """Left less right column at each pixel of the left picture.

    Parameters
    ----------
    values_px
        (rows, columns), NaN where nothing was found.
    sigma_px
        One standard deviation by the rule of the least squares, (rows, columns): what the difference left between the
        pictures does to the fit. Shading that travels with the tilt is not in it, nor is the smoothing over rims: on a
        speckled plane the errors are about 1.5 times as large, on rough specimens 3 times and more.
    """

    values_px: Array
    sigma_px: Array


def match_rows(left: Picture, right: Picture, count: int, options: SemiGlobalOptions) -> Disparities:
    """Match the rows of two rectified pictures.

    Parameters
    ----------
    left, right
        (rows, columns) of one shape, NaN where there is nothing.
    count
        Disparities looked for: 0 to `count`; the first `count` columns of the left picture have no answer.
    """
    first, second = (locally_normalised(one, options) for one in (left, right))
    coarse = _semi_global(first, second, count, options)
    coarse[~np.isfinite(left)] = np.nan
    if options.window_px <= 0:
        return Disparities(coarse.astype(np.float64), np.where(np.isfinite(coarse), 1 / SUBPIXELS, np.nan))
    return _least_squares(first, second, np.isfinite(left), np.isfinite(right), coarse, options)


def locally_normalised(picture: Picture, options: SemiGlobalOptions) -> Picture:
    """Take out local mean and contrast: mean 0, standard deviation 1, and 0 where there is nothing.

    Contrast below a tenth of the picture's own is taken for noise and not raised further.
    """
    known = np.isfinite(picture)
    weight = known.astype(np.float32)
    grey = np.where(known, picture, 0).astype(np.float32)
    if options.blur_px > 0:
        grey = np.where(known, _mean(grey, weight, options.blur_px), 0).astype(np.float32)
    level = np.where(known, grey - _mean(grey, weight, options.local_px), 0).astype(np.float32)
    variance = _mean(level**2, weight, options.local_px)
    floor = 0.01 * float((level[known] ** 2).mean()) if known.any() else 0.0
    return np.asarray(np.where(known, level / np.sqrt(variance + floor + 1e-20), 0), dtype=np.float32)


def _mean(values: Picture, weight: Picture, sigma_px: float) -> Picture:
    """Gaussian mean of what is known; `values` is 0 elsewhere."""
    total = ndimage.gaussian_filter(values, sigma_px, mode="constant")
    share = ndimage.gaussian_filter(weight, sigma_px, mode="constant")
    return np.asarray(total / np.maximum(share, 1e-6), dtype=np.float32)


def _semi_global(left: Picture, right: Picture, count: int, options: SemiGlobalOptions) -> Picture:
    """OpenCV's matcher on normalised pictures, 32 grey levels a standard deviation; NaN where it refuses."""
    import cv2

    grey = [np.clip(np.rint(128 + 32 * one), 0, 255).astype(np.uint8) for one in (left, right)]
    number = 16 * int(np.ceil((count + 1) / 16))
    # columns that OpenCV gives no answer, beyond those that the frame has to spare
    pad = number - min(count, number)
    wide = [cv2.copyMakeBorder(one, 0, 0, pad, 0, cv2.BORDER_REPLICATE) for one in grey]
    block = options.block_px**2
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        minDisparity=0,
        numDisparities=number,
        blockSize=options.block_px,
        P1=round(options.smooth[0] * block),
        P2=round(options.smooth[1] * block),
        disp12MaxDiff=options.agree_px,
        preFilterCap=63,
        uniquenessRatio=options.uniqueness,
        speckleWindowSize=options.speckle_px,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH if wide[0].size * number < MUCH_MEMORY else cv2.STEREO_SGBM_MODE_SGBM,
    )
    found = matcher.compute(*wide)[:, pad:].astype(np.float32) / SUBPIXELS
    return np.where((found >= 0) & (found <= count), found, np.nan).astype(np.float32)


def _least_squares(
    left: Picture, right: Picture, left_known: Mask, right_known: Mask, start: Picture, options: SemiGlobalOptions
) -> Disparities:
    """Move each disparity to the least squared difference in its window; a pixel that leaves its match is missing."""
    spline = ndimage.spline_filter1d(right, order=3, axis=1, output=np.float32, mode="mirror")
    slope = _slope(left)
    smooth = _smoothed(start)
    disparity = smooth.copy()
    for _ in range(options.steps):
        disparity = _smoothed(disparity)
        difference, gradient, power = _compared(left, slope, left_known, spline, right_known, disparity, options)
        pull = _window(-gradient * difference, options)
        disparity = disparity + np.clip(pull / power, -0.5, 0.5)
    difference, gradient, power = _compared(left, slope, left_known, spline, right_known, disparity, options)
    trusted = np.isfinite(disparity) & (np.abs(disparity - smooth) <= 1) & (gradient != 0)
    # a Gaussian window holds 4 pi sigma^2 pixels, and noise that was blurred is alike over as many of its own
    pixels = options.window_px**2 / (options.blur_px**2 + 1 / (4 * np.pi))
    sigma = np.sqrt(_window(difference**2, options) / (pixels * power))
    return Disparities(*(np.where(trusted, one, np.nan).astype(np.float64) for one in (disparity, sigma)))


def _compared(
    left: Picture,
    slope: Picture,
    left_known: Mask,
    spline: Picture,
    right_known: Mask,
    disparity: Picture,
    options: SemiGlobalOptions,
) -> tuple[Picture, Picture, Picture]:
    """Difference, mean gradient and windowed power of it at the present disparities; 0 where there is nothing."""
    seen, seen_slope = _seen(spline, right_known, disparity)
    trusted = left_known & np.isfinite(seen)
    gradient = np.where(trusted, (slope + seen_slope) / 2, 0).astype(np.float32)
    difference = np.where(trusted, left - seen, 0).astype(np.float32)
    # the product of two gradients of independent noise: the square of one would count its noise as texture
    common = np.where(trusted, slope * seen_slope, 0).astype(np.float32)
    power = np.maximum(_window(common, options), 0.25 * _window(gradient**2, options))
    return difference, gradient, power + LEAST_POWER


def _window(values: Picture, options: SemiGlobalOptions) -> Picture:
    return np.asarray(ndimage.gaussian_filter(values, options.window_px, mode="constant"))


def _slope(picture: Picture) -> Picture:
    """Differentiate the B-spline through each row."""
    spline = ndimage.spline_filter1d(picture, order=3, axis=1, output=np.float32, mode="mirror")
    return np.asarray(ndimage.correlate1d(spline, [-0.5, 0.0, 0.5], axis=1, mode="mirror"))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _seen(spline: Picture, known: Mask, disparity: Picture) -> tuple[Picture, Picture]:
    """Value and derivative of the rows' splines at ``column - disparity``; NaN where there is nothing."""
    rows, columns = spline.shape
    value, slope = np.full_like(spline, np.nan), np.full_like(spline, np.nan)
    for row in range(rows):
        for column in range(columns):
            if not np.isfinite(disparity[row, column]):
                continue
            place = column - disparity[row, column]
            i = int(np.floor(place))
            if i < 1 or i > columns - 3 or not (known[row, i] and known[row, i + 1]):
                continue
            t = place - i
            a, b, c, d = spline[row, i - 1], spline[row, i], spline[row, i + 1], spline[row, i + 2]
            u = 1 - t
            value[row, column] = (
                u**3 * a + (4 - 6 * t**2 + 3 * t**3) * b + (4 - 6 * u**2 + 3 * u**3) * c + t**3 * d
            ) / 6
            slope[row, column] = (-(u**2) * a + (3 * t**2 - 4 * t) * b - (3 * u**2 - 4 * u) * c + t**2 * d) / 2
    return value, slope


def _smoothed(disparity: Picture) -> Picture:
    """Smooth within surfaces, not across steps of more than a pixel or so; what is missing stays so."""
    import cv2

    known = np.isfinite(disparity)
    if not known.any():
        return disparity
    apart = np.where(known, disparity, float(disparity[known].min()) - FAR).astype(np.float32)
    smooth = cv2.bilateralFilter(apart, 9, 1.0, 2.0)
    return np.where(known, smooth, np.nan).astype(np.float32)
