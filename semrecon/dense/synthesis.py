"""Heights whose parallax and whose shading both agree with the views: analysis by synthesis.

With W the mean of the views drawn onto the surface, B its brightness on a wide scale and T the tone of the surface
(`semrecon.dense.reflectance`), the stage minimises over the heights z::

    differences(z)  +  sum rho(P (W - B T(z)) / s)^2  +  sum w |second differences of z|^2

The first term holds the differences between the views, with the change of their tone by tilt expected
(`semrecon.dense.tilt_tones`): without that, they would pull the surface to where shading seems to stand still. The
picture that all views have in common is eliminated there. P takes the surroundings away: paint, shadows of wide hollows
and charging change over many pixels, and there parallax knows better. rho is Cauchy's; s holds the noise of the mean
and what the reflectance cannot explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.data import Array, Mask, TiltSeries
from semrecon.dense.coarse_grids import corrected
from semrecon.dense.parallax import ParallaxOptions, bending, drawn, mean_of, shared
from semrecon.dense.pictures import filled, noise_model
from semrecon.dense.reflectance import (
    CAUCHY,
    Reflectance,
    Tones,
    brightness,
    calibrated,
    less_surroundings,
    slopes,
    slopes_transposed,
    tones,
)
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.smoothness import applied, edge_weights
from semrecon.dense.spline import Float, Spline
from semrecon.dense.tilt_tones import differences, gentle, misfit
from semrecon.matches.features import usable_pixels

BRIGHTNESS_PX = 8.0
"""Standard deviation of the window in which the brightness of a place is measured."""
BLACK_SHARE = 0.25, 0.85
"""Twice the root of the electrons at black, in parts of that at the mean grey value: least and most."""


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
    edge
        Second difference from which a bend is taken for an edge, in standard deviations of the prior.
    judged_px
        Standard deviation of the window in which it is judged whether the views agree better on the heights with
        shading than on those without.
    better
        Fall of their misfit, a pixel, from which shading counts in full.
    """

    rounds: int = 12
    steps: int = 16
    deviation: float = 2.0
    detail_px: float = 4.0
    edge: float = 1.5
    judged_px: float = 12.0
    better: float = 0.02


@dataclass(frozen=True)
class Shaded:
    """What shading made of the heights.

    Parameters
    ----------
    heights
        (rows, columns), px.
    trust
        Weight of the heights with shading, (rows, columns), 0 to 1: where it is 0, heights are as from parallax.
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
        Use shading even where the views agree less on it.
    """
    black = black_level(series)
    if black is None:
        return Shaded(heights, np.zeros(heights.shape, np.float32), {"shading": "noise does not grow with brightness"})
    mean, counts = mean_of(drawn(splines, lines, heights)[0])
    bright = brightness(mean, black, BRIGHTNESS_PX)
    reflectance = calibrated(mean, bright, counts >= 2, heights, lines.matrices[:, :, :3])
    detailed = heights
    for _ in range(options.rounds):
        detailed = detailed + step(splines, lines, detailed, reflectance, black, parallax, options)
    trust = np.ones(heights.shape, np.float32)
    if not everywhere:
        trust = trust_in_shading(splines, lines, heights, detailed, black, parallax, options)
    found = {"detector_side": reflectance.side, "black_level": black, "share_by_shading": float(trust.mean())}
    return Shaded(heights + trust * (detailed - heights), trust, found)


def trust_in_shading(
    splines: Sequence[Spline],
    lines: Sightlines,
    plain: Array,
    detailed: Array,
    black: float,
    parallax: ParallaxOptions,
    options: ShadingOptions,
) -> Float:
    """Weigh heights with shading against those without by how well the views agree on them, (rows, columns), 0 to 1.

    A detail that the shading of the mean picture suggests moves what each view shows of it. If the surface has it, the
    differences between the views become smaller; if it is paint, or a shadow, they grow, or were noise already.

    Parameters
    ----------
    plain, detailed
        Heights without and with shading, (rows, columns), px.
    """
    without, given = drawn(splines, lines, plain)[0], drawn(splines, lines, detailed)[0]
    cases = ((without, plain, None), (without, plain, black), (given, detailed, black))
    fits = [misfit(views, lines, heights, level, parallax) for views, heights, level in cases]
    known = np.asarray(np.isfinite(np.stack(fits)).all(axis=0))
    share = np.maximum(shared(known, options.judged_px), 1e-3)
    unshaded, toned, after = (shared(np.where(known, fit, 0), options.judged_px) / share for fit in fits)
    return np.asarray(np.clip((np.minimum(unshaded, toned) - after) / options.better, 0, 1), dtype=np.float32)


def black_level(series: TiltSeries) -> float | None:
    """Find what to add to stabilised grey values to make them twice the root of the number of electrons.

    By photon transfer, from what the views have in common, within what the mean grey value makes likely: contrast is
    set so that black is not far below the darkest places. None where noise does not grow with the grey value.
    """
    gains, floors, levels = [], [], []
    for view in series.views:
        valid = usable_pixels(view)
        if not valid.any():
            return None
        image = filled(np.asarray(view.image, dtype=np.float64), valid)
        noise = noise_model(image, valid)
        gains.append(noise.gain)
        floors.append(noise.floor)
        levels.append(float(noise.stabilised(image)[valid].mean()))
    gain, floor, level = (float(np.median(each)) for each in (gains, floors, levels))
    if gain <= 0:
        return None
    least, most = (share / (1 - share) * level for share in BLACK_SHARE)
    return float(np.clip(2 * np.sqrt(floor) / gain, least, most))


def step(
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    reflectance: Reflectance,
    black: float,
    parallax: ParallaxOptions,
    options: ShadingOptions,
) -> Array:
    """One Gauss-Newton step, (rows, columns), px."""
    views, gradient = drawn(splines, lines, heights)
    by_views = differences(views, gradient, lines, heights, black, parallax)
    bend = bending(heights, parallax)
    weights = edge_weights(heights, options.edge * bend) / bend**2
    mean, counts = mean_of(views)
    shading = linearised(mean, counts >= 2, black, heights, reflectance, lines.matrices[:, :, :3], options)
    bent, zero = np.zeros_like(weights), np.zeros_like(heights)
    right = by_views.asked() + shading.transposed(shading.weight * shading.residual)
    right = right - applied(zero, weights, heights, bent)
    information = by_views.heights

    def system(z: Array) -> Array:
        by_shading = shading.transposed(shading.weight * shading.change(z))
        return np.asarray(applied(information, weights, z, bent) + by_views.by_slopes(z) + by_shading)

    diagonal = information + 6 * weights.sum(axis=0) + by_views.diagonal() + shading.diagonal() + 1e-6
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
        picture = np.where(self.seen, picture, 0)
        picture = picture - np.where(self.seen, shared(picture / self.share, self.detail_px), 0)
        out = slopes_transposed(self.tone.across * picture, self.tone.down * picture)
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
    rotations: Array,
    options: ShadingOptions,
) -> Linearised:
    """Compare the mean picture (rows, columns) with that of the present heights."""
    bright = brightness(mean, black, BRIGHTNESS_PX)
    tone = tones(heights, rotations, reflectance)
    grey = Tones(bright * tone.value, bright * tone.across, bright * tone.down, tuple(bright * b for b in tone.bends))
    residual = less_surroundings(mean - grey.value, seen, options.detail_px)
    robust = np.where(seen, 1 / (1 + (residual / (CAUCHY * options.deviation)) ** 2), 0) / options.deviation**2
    weight = np.asarray(gentle(heights) * robust, dtype=np.float32)
    share = np.asarray(np.maximum(shared(seen, options.detail_px), 1e-3), dtype=np.float32)
    return Linearised(grey, reflectance.reaches_px, seen, share, residual, weight, options.detail_px)
