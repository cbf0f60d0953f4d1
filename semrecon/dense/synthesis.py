"""Heights whose parallax and whose shading both agree with the views: analysis by synthesis.

With W the mean of the views drawn onto the surface, B its brightness on a wide scale and T the tone of the surface
(`semrecon.dense.reflectance`), the stage minimises over the heights z::

    parallax(z)  +  sum rho(P (W - B T(z)) / s)^2  +  sum w |second differences of z|^2

P takes the surroundings away: paint, shadows of wide hollows and charging change over many pixels, and there the
parallax knows better. rho is Cauchy's; s holds the noise of the mean and what the reflectance cannot explain. The
picture that all views have in common is eliminated within the first term (`semrecon.dense.parallax`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.data import Array, Mask, TiltSeries
from semrecon.dense.coarse_grids import corrected
from semrecon.dense.parallax import ParallaxOptions, bending, normal_equations, shared
from semrecon.dense.pictures import filled, noise_model
from semrecon.dense.reflectance import (
    ACROSS,
    CAUCHY,
    SMOOTH,
    Reflectance,
    Tones,
    calibrated,
    less_surroundings,
    slopes,
    tones,
)
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.smoothness import applied, edge_weights
from semrecon.dense.spline import Float, Spline, sampled
from semrecon.dense.visibility import visible
from semrecon.matches.features import usable_pixels

BRIGHTNESS_PX = 8.0
"""Standard deviation of the window in which the brightness of a place is measured."""
STEEPEST = 4.0
"""Where the surface is steeper than this its tone says little."""
LEAST_BRIGHTNESS = 1e-3


@dataclass(frozen=True)
class ShadingOptions:
    """How shading is used.

    Parameters
    ----------
    rounds
        Gauss-Newton steps.
    steps
        Conjugate gradients at full size in each.
    deviation
        Standard deviation of the mean picture from what the reflectance says, in units of the noise of one view.
    detail_px
        Standard deviation of the surroundings that are taken away: shading says nothing beyond.
    bend_px
        Prior of the second difference of heights where shading counts in full: one standard deviation, px. Where it
        counts nothing the prior is that of parallax.
    edge
        Second difference from which a bend is taken for an edge, in standard deviations of the prior.
    likeness
        Correlation between picture and tone of the heights from parallax below which shading counts nothing, and from
        which it counts in full.
    judged_px
        Blur under which they are compared, and standard deviation of the window.
    """

    rounds: int = 4
    steps: int = 25
    deviation: float = 2.0
    detail_px: float = 4.0
    bend_px: float = 2.0
    edge: float = 1.5
    likeness: tuple[float, float] = (0.4, 0.7)
    judged_px: tuple[float, float] = (2.5, 12.0)


@dataclass(frozen=True)
class Shaded:
    """What shading made of the heights.

    Parameters
    ----------
    heights
        (rows, columns), px.
    trust
        Weight that shading had, (rows, columns), 0 to 1: where it is 0 near and far, heights are as from parallax.
    diagnostics
        Side of the detector, mean weight of shading; or why shading was not used.
    """

    heights: Array
    trust: Float
    diagnostics: dict[str, Any]


def shaded(
    series: TiltSeries,
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    parallax: ParallaxOptions,
    options: ShadingOptions,
    *,
    everywhere: bool = False,
) -> Shaded:
    """Add the detail that shading tells of to heights from parallax.

    Parameters
    ----------
    splines
        Of the prepared views at full size.
    heights
        From parallax, (rows, columns), px; finite.
    everywhere
        Use shading even where brightness does not follow the heights from parallax.
    """
    black = black_level(series)
    if black is None:
        return Shaded(heights, np.zeros(heights.shape, np.float32), {"shading": "noise does not grow with brightness"})
    rotations = lines.matrices[:, :, :3]
    mean, seen = mean_picture(splines, lines, heights)
    bright = brightness(mean, black)
    reflectance = calibrated(mean, bright, seen, heights, rotations)
    trust = np.ones(heights.shape, np.float32)
    if not everywhere:
        trust = trust_in_shading(mean, bright, seen, heights, rotations, reflectance, options)
    found = {"detector_side": reflectance.side, "share_by_shading": float(trust.mean())}
    if trust.any():
        for _ in range(options.rounds):
            heights = heights + step(splines, lines, heights, reflectance, black, trust, parallax, options)
    return Shaded(heights, trust, found)


def trust_in_shading(
    mean: Float,
    bright: Float,
    seen: Mask,
    heights: Array,
    rotations: Array,
    reflectance: Reflectance,
    options: ShadingOptions,
) -> Float:
    """Weigh shading by whether brightness follows the heights from parallax, (rows, columns), 0 to 1.

    Picture and tone of the heights are correlated over a window, at a size at which the heights can be trusted. Where
    paint or dirt makes the picture, or the heights are too poor to begin with, they have little in common.
    """
    blur, window = options.judged_px
    smooth = shared(heights, blur).astype(np.float64)
    tone = less_surroundings(bright * tones(smooth, rotations, reflectance).value, seen, 4 * blur)
    picture = less_surroundings(shared(mean, blur), seen, 4 * blur)
    both = shared(tone * picture, window)
    each = np.sqrt(shared(tone**2, window) * shared(picture**2, window)) + 1e-6
    low, high = options.likeness
    return np.asarray(np.clip((both / each - low) / (high - low), 0, 1), dtype=np.float32)


def black_level(series: TiltSeries) -> float | None:
    """Find what to add to stabilised grey values to make them twice the root of the number of electrons.

    By photon transfer, mean of all views; None where noise does not grow with the grey value in one of them.
    """
    levels = []
    for view in series.views:
        valid = usable_pixels(view)
        if not valid.any():
            return None
        noise = noise_model(filled(np.asarray(view.image, dtype=np.float64), valid), valid)
        if noise.gain <= 0:
            return None
        levels.append(2 * np.sqrt(noise.floor) / noise.gain)
    return float(np.mean(levels))


def mean_picture(splines: Sequence[Spline], lines: Sightlines, heights: Array) -> tuple[Float, Mask]:
    """Mean of the views drawn onto the surface, and where at least two see it, (rows, columns) each."""
    total, counts = np.zeros(heights.shape, np.float32), np.zeros(heights.shape, np.float32)
    for view, spline in enumerate(splines):
        values = sampled(spline, lines, view, heights).values
        known = visible(heights, lines, view) & np.isfinite(values)
        total += np.where(known, values, 0)
        counts += known
    return np.asarray(total / np.maximum(counts, 1), dtype=np.float32), np.asarray(counts >= 2)


def brightness(mean: Float, black: float) -> Float:
    """Brightness of the surroundings, (rows, columns): of what a tone is a share."""
    return np.asarray(np.maximum(shared(mean, BRIGHTNESS_PX) + black, LEAST_BRIGHTNESS), dtype=np.float32)


def step(
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    reflectance: Reflectance,
    black: float,
    trust: Float,
    parallax: ParallaxOptions,
    options: ShadingOptions,
) -> Array:
    """One Gauss-Newton step, (rows, columns), px."""
    equations = normal_equations(splines, lines, heights, 1.0, parallax)
    information = shared(equations.information, parallax.window_px).astype(np.float64)
    bend = bending(heights, parallax)
    bend += trust * (np.maximum(bend, options.bend_px) - bend)
    weights = edge_weights(heights, options.edge * bend) / bend**2
    mean, seen = mean_picture(splines, lines, heights)
    shading = linearised(mean, seen, black, heights, reflectance, trust, lines.matrices[:, :, :3], options)
    bent, zero = np.zeros_like(weights), np.zeros_like(heights)
    right = shared(equations.right, parallax.window_px) + shading.transposed(shading.weight * shading.residual)
    right = right - applied(zero, weights, heights, bent)

    def system(z: Array) -> Array:
        by_shading = shading.transposed(shading.weight * shading.change(z))
        return np.asarray(applied(information, weights, z, bent) + by_shading)

    diagonal = information + 6 * weights.sum(axis=0) + shading.diagonal() + 1e-6
    change = corrected(system, right, information, weights, diagonal, steps=options.steps)
    limit = 0.7 / max(float(np.abs(lines.parallax()).max()), 1e-6)  # the linearisation holds for part of a pixel
    return np.clip(change, -limit, limit)


@dataclass(frozen=True)
class Linearised:
    """Shading near a surface: a change of height by dz changes the synthetic picture by ``change(dz)``.

    Parameters
    ----------
    tone
        In grey values: multiplied by the brightness.
    reaches_px
        Of its bends.
    seen
        Where there is a picture.
    share
        How much of the surroundings is seen.
    residual, weight
        Picture less synthetic picture, without their surroundings, and its weight.
    detail_px
        Reach of the surroundings.
    """

    tone: Tones
    reaches_px: tuple[float, ...]
    seen: Mask
    share: Float
    residual: Float
    weight: Float
    detail_px: float

    def change(self, z: Array) -> Float:
        """Change of the synthetic picture by a change of heights (rows, columns), px."""
        across, down = slopes(z)
        out = self.tone.across * across + self.tone.down * down
        for bend, reach in zip(self.tone.bends, self.reaches_px, strict=True):
            out += bend * (z - shared(z, reach)).astype(np.float32)
        around = shared(np.where(self.seen, out, 0), self.detail_px) / self.share
        return np.asarray(np.where(self.seen, out - around, 0))

    def transposed(self, picture: Float) -> Float:
        """Apply the transpose of `change`, up to the edges of the picture."""
        import cv2

        picture = np.where(self.seen, picture, 0)
        picture = picture - np.where(self.seen, shared(picture / self.share, self.detail_px), 0)
        edge = cv2.BORDER_REFLECT_101
        across, down = self.tone.across * picture, self.tone.down * picture
        out = -cv2.sepFilter2D(across, cv2.CV_32F, ACROSS, SMOOTH, borderType=edge)
        out -= cv2.sepFilter2D(down, cv2.CV_32F, SMOOTH, ACROSS, borderType=edge)
        for bend, reach in zip(self.tone.bends, self.reaches_px, strict=True):
            part = bend * picture
            out += part - shared(part, reach)
        return np.asarray(out)

    def diagonal(self) -> Float:
        """About the diagonal of ``transposed(weight * change)``: 0.3 is the power of the slopes' stencils."""
        power = 0.3 * (self.tone.across**2 + self.tone.down**2) + 0.5 * sum(bend**2 for bend in self.tone.bends)
        return np.asarray(self.weight * power)


def linearised(
    mean: Float,
    seen: Mask,
    black: float,
    heights: Array,
    reflectance: Reflectance,
    trust: Float,
    rotations: Array,
    options: ShadingOptions,
) -> Linearised:
    """Compare the mean picture (rows, columns) with that of the present heights."""
    bright = brightness(mean, black)
    tone = tones(heights, rotations, reflectance)
    grey = Tones(bright * tone.value, bright * tone.across, bright * tone.down, tuple(bright * b for b in tone.bends))
    residual = less_surroundings(mean - grey.value, seen, options.detail_px)
    robust = np.where(seen, 1 / (1 + (residual / (CAUCHY * options.deviation)) ** 2), 0) / options.deviation**2
    weight = np.asarray(trust * np.where(np.hypot(*slopes(heights)) < STEEPEST, robust, 0), dtype=np.float32)
    share = np.asarray(np.maximum(shared(seen, options.detail_px), 1e-3), dtype=np.float32)
    return Linearised(grey, reflectance.reaches_px, seen, share, residual, weight, options.detail_px)
