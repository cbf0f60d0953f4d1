"""How bright a surface of known shape is to secondary electrons, as a share of its surroundings.

The pictures count electrons on a scale of unit noise, twice the root of their number, so that relative changes of the
number count half. With n the normal in the camera's axes, phi its angle to the beam and D_s the surface less its mean
over a reach s, divided by ``sqrt(1 + slope^2)``::

    tone = a (1/2) log sec(phi) + b . n_xy + sum_s r_s max(D_s, 0) + h_s min(D_s, 0)

the secant law, a detector at one side, the glow of ridges and the shadow of hollows. b is measured on the heights from
parallax, at a size at which they can be trusted. The others would come out too small there (errors in the regressors).
They are fixed at round values of what fits to simulated specimens with known heights had in common: a 0.55 to 0.7, in
place of the 1 of a bare secant law, because steep places lie in shadow as well. Other detectors may differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from semrecon.data import Array, Mask
from semrecon.dense.bands import in_bands
from semrecon.dense.parallax import shared
from semrecon.dense.spline import Float

ACROSS, SMOOTH = np.array([-0.5, 0.0, 0.5]), np.array([0.25, 0.5, 0.25])
"""Slopes by Sobel's stencil: its blur, 0.6 px along and 0.7 across, stands for that of a usual spot."""
LEAST_COSINE = 0.4
"""The secant is bounded: steeper places give no more."""
LEAST_BRIGHTNESS = 1e-3
FIT_BLUR_PX, FIT_SURROUNDINGS_PX = 5.0, 20.0
CAUCHY = 2.385
FIT_ROUNDS = 8
RIDGE = 1e-3
STEEPEST = 3.0
LEAST_PIXELS = 500


@dataclass(frozen=True)
class Reflectance:
    """Coefficients of the tone.

    Parameters
    ----------
    secant
        a.
    side
        b, (right, down).
    reaches_px
        s.
    ridges, hollows
        r_s and h_s, px^-1.
    """

    secant: float = 0.6
    side: tuple[float, float] = (0.0, 0.0)
    reaches_px: tuple[float, ...] = (1.2, 4.0)
    ridges: tuple[float, ...] = (0.05, 0.03)
    hollows: tuple[float, ...] = (0.02, 0.015)

    def at_level(self, level: int) -> Reflectance:
        """Measure in pixels of a pyramid level."""
        step = 2.0**level
        reaches = tuple(reach / step for reach in self.reaches_px)
        ridges, hollows = (tuple(share * step for share in shares) for shares in (self.ridges, self.hollows))
        return Reflectance(self.secant, self.side, reaches, ridges, hollows)


@dataclass(frozen=True)
class Tones:
    """Tone of a surface and its derivatives, (rows, columns) each.

    Parameters
    ----------
    value
        The tone, mean over the views.
    across, down
        By the slope along columns and rows.
    bends
        By D_s before the division, one map a reach.
    """

    value: Float
    across: Float
    down: Float
    bends: tuple[Float, ...]


def brightness(mean: Float, black: float, reach_px: float) -> Float:
    """Brightness of the surroundings, (rows, columns): of what a tone is a share.

    Parameters
    ----------
    mean
        Mean picture of the views, (rows, columns).
    black
        What makes it twice the root of the number of electrons.
    reach_px
        Standard deviation of the window.
    """
    return np.asarray(np.maximum(shared(mean, reach_px) + black, LEAST_BRIGHTNESS), dtype=np.float32)


def slopes(heights: Array) -> tuple[Float, Float]:
    """Slope along columns and along rows, px a px."""
    import cv2

    plain, edge = heights.astype(np.float32), cv2.BORDER_REFLECT_101
    across = cv2.sepFilter2D(plain, cv2.CV_32F, ACROSS, SMOOTH, borderType=edge)
    return np.asarray(across), np.asarray(cv2.sepFilter2D(plain, cv2.CV_32F, SMOOTH, ACROSS, borderType=edge))


def slopes_transposed(across: Float, down: Float) -> Float:
    """Apply the transpose of `slopes`, up to the edges of the picture, (rows, columns)."""
    import cv2

    edge = cv2.BORDER_REFLECT_101
    out = -cv2.sepFilter2D(across, cv2.CV_32F, ACROSS, SMOOTH, borderType=edge)
    return np.asarray(out - cv2.sepFilter2D(down, cv2.CV_32F, SMOOTH, ACROSS, borderType=edge))


def tones(heights: Array, rotations: Array, reflectance: Reflectance) -> Tones:
    """Work out tones of a surface.

    Parameters
    ----------
    heights
        (rows, columns), px.
    rotations
        From the axes of the reference camera to those of each view, (views, 3, 3).
    """
    across, down = slopes(heights)
    out = np.empty((3, *heights.shape), dtype=np.float32)
    law = np.array([reflectance.secant, *reflectance.side])
    in_bands(len(heights), lambda start, stop: _tones(across, down, rotations, law, out, start, stop))
    upright, bends = 1 / np.sqrt(1 + across**2 + down**2), []
    for reach, ridge, hollow in zip(reflectance.reaches_px, reflectance.ridges, reflectance.hollows, strict=True):
        rise = upright * (heights - shared(heights, reach)).astype(np.float32)
        share = np.where(rise > 0, np.float32(ridge), np.float32(hollow))
        out[0] += share * rise
        bends.append(np.asarray(share * upright, dtype=np.float32))
    return Tones(out[0], out[1], out[2], tuple(bends))


def calibrated(mean: Float, brightness: Float, seen: Mask, heights: Array, rotations: Array) -> Reflectance:
    """Find the side of the detector by a robust fit, at a size of some pixels at which the heights can be trusted.

    Parameters
    ----------
    mean, brightness
        Mean picture of the views, and what it is on a wide scale in units of its tone, (rows, columns).
    seen
        Where they are known.
    """
    smooth, blurred = shared(heights, FIT_BLUR_PX).astype(np.float64), shared(mean, FIT_BLUR_PX)
    across, down = slopes(smooth)
    kept = ndimage.binary_erosion(seen, iterations=3) & (np.hypot(across, down) < STEEPEST)
    if kept.sum() < LEAST_PIXELS:
        return Reflectance()
    sides = ((1.0, 0.0), (0.0, 1.0))
    laws = [Reflectance(1.0, ridges=(0.0, 0.0), hollows=(0.0, 0.0))]
    laws += [Reflectance(0.0, side, ridges=(0.0, 0.0), hollows=(0.0, 0.0)) for side in sides]
    laws += [Reflectance(0.0, ridges=pair, hollows=(0.0, 0.0)) for pair in sides]
    laws += [Reflectance(0.0, ridges=(0.0, 0.0), hollows=pair) for pair in sides]

    def detail(picture: Float) -> Array:
        return np.asarray(less_surroundings(picture, seen, FIT_SURROUNDINGS_PX)[kept], dtype=np.float64)

    design = np.stack([detail(brightness * tones(smooth, rotations, law).value) for law in laws], axis=1)
    target = detail(blurred)
    found = _robust(design, target)
    return Reflectance(side=(float(found[1]), float(found[2])))


def less_surroundings(picture: Float, seen: Mask, reach_px: float) -> Float:
    """Subtract the mean over the surroundings, as far as they are seen; 0 where a pixel is not."""
    share = np.maximum(shared(seen, reach_px), 1e-3)
    return np.asarray(np.where(seen, picture - shared(np.where(seen, picture, 0), reach_px) / share, 0), np.float32)


def _robust(design: Array, target: Array) -> Array:
    """Least squares with Cauchy weights and a faint pull to zero, (coefficients,)."""
    weights: Array = np.ones(len(target))
    pull = RIDGE * np.diag((design**2).sum(axis=0)) + 1e-12 * np.eye(design.shape[1])
    for _ in range(FIT_ROUNDS):
        weighted = (design * weights[:, None]).T
        found: Array = np.asarray(np.linalg.solve(weighted @ design + pull, weighted @ target), dtype=np.float64)
        left: Array = np.asarray(target - design @ found, dtype=np.float64)
        scale = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weights = np.asarray(1 / (1 + (left / (CAUCHY * scale)) ** 2), dtype=np.float64)
    return found


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _tones(across: Float, down: Float, rotations: Array, law: Array, out: Float, start: int, stop: int) -> None:
    """Secant law and side detector, mean over the views, and their derivatives; (p, q, 1) is the inward normal."""
    half, views = -0.5 * law[0], len(rotations)
    for y in range(start, stop):
        for x in range(across.shape[1]):
            p, q = float(across[y, x]), float(down[y, x])
            square = p * p + q * q + 1.0
            length = np.sqrt(square)
            cosines, right, below, by_p, by_q = 1.0, 0.0, 0.0, 0.0, 0.0
            for r in rotations:
                right += (r[0, 0] * p + r[0, 1] * q + r[0, 2]) / length
                below += (r[1, 0] * p + r[1, 1] * q + r[1, 2]) / length
                towards = r[2, 0] * p + r[2, 1] * q + r[2, 2]
                by_p += law[1] * r[0, 0] / length + law[2] * r[1, 0] / length
                by_q += law[1] * r[0, 1] / length + law[2] * r[1, 1] / length
                cosines *= max(towards / length, LEAST_COSINE)
                if towards > LEAST_COSINE * length:
                    by_p += half * (r[2, 0] / towards - p / square)
                    by_q += half * (r[2, 1] / towards - q / square)
            side = law[1] * right + law[2] * below
            out[0, y, x] = (half * np.log(cosines) + side) / views
            out[1, y, x] = (by_p - side * p / square) / views
            out[2, y, x] = (by_q - side * q / square) / views
