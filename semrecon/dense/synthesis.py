"""Heights whose parallax and whose shading both agree with the views: analysis by synthesis, one step of it.

With W the mean of the views drawn onto the surface, B its brightness on a wide scale and T the tone of the surface
(`semrecon.dense.reflectance`), a step makes smaller, over the heights z::

    differences(z)  +  sum rho(P (W - B T(z)) / s)^2  +  sum w |second differences of z|^2

The first term holds the differences between the views, with the change of their tone by tilt expected
(`semrecon.dense.tilt_tones`): without that, they would pull the surface to where shading seems to stand still. The
picture that all views have in common is eliminated there. P takes the surroundings away: paint, shadows of wide hollows
and charging change over many pixels, and there parallax knows better. rho is Cauchy's; s holds the noise of the mean
and what the reflectance cannot explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semrecon.data import Array, Mask
from semrecon.dense.coarse_grids import corrected
from semrecon.dense.parallax import ParallaxOptions, bending, drawn, mean_of, shared, within_reach
from semrecon.dense.reflectance import (
    CAUCHY,
    Reflectance,
    Tones,
    brightness,
    less_surroundings,
    slopes,
    slopes_transposed,
    tones,
)
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.smoothness import applied, edge_weights
from semrecon.dense.spline import Float, Spline
from semrecon.dense.tilt_tones import Windows, differences, gentle


@dataclass(frozen=True)
class SynthesisOptions:
    """How one step weighs what the views say.

    Parameters
    ----------
    steps
        Conjugate gradients at full size.
    deviation
        Standard deviation of the mean picture from what the reflectance says, in units of the noise of one view.
    brightness_px
        Standard deviation of the window in which the brightness of a place is measured.
    detail_px
        Standard deviation of the surroundings that are taken away: shading says nothing beyond.
    edge
        Second difference from which a bend is taken for an edge, in standard deviations of the prior.
    windows
        Of the differences between views.
    """

    steps: int = 12
    deviation: float = 2.0
    brightness_px: float = 8.0
    detail_px: float = 4.0
    edge: float = 1.5
    windows: Windows = field(default_factory=Windows)

    def at_level(self, level: int) -> SynthesisOptions:
        """Measure in pixels of a pyramid level."""
        brightness_px, detail_px = self.brightness_px / 2**level, self.detail_px / 2**level
        return replace(self, brightness_px=brightness_px, detail_px=detail_px, windows=self.windows.at_level(level))


def step(
    splines: Sequence[Spline],
    lines: Sightlines,
    heights: Array,
    reflectance: Reflectance,
    black: float,
    parallax: ParallaxOptions,
    options: SynthesisOptions,
) -> Array:
    """One Gauss-Newton step, (rows, columns), px."""
    views, gradient = drawn(splines, lines, heights)
    by_views = differences(views, gradient, lines, heights, black, parallax, options.windows)
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
    return within_reach(change, lines)


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
    options: SynthesisOptions,
) -> Linearised:
    """Compare the mean picture (rows, columns) with that of the present heights."""
    bright = brightness(mean, black, options.brightness_px)
    tone = tones(heights, rotations, reflectance)
    grey = Tones(bright * tone.value, bright * tone.across, bright * tone.down, tuple(bright * b for b in tone.bends))
    residual = less_surroundings(mean - grey.value, seen, options.detail_px)
    robust = np.where(seen, 1 / (1 + (residual / (CAUCHY * options.deviation)) ** 2), 0) / options.deviation**2
    weight = np.asarray(gentle(heights) * robust, dtype=np.float32)
    share = np.asarray(np.maximum(shared(seen, options.detail_px), 1e-3), dtype=np.float32)
    return Linearised(grey, reflectance.reaches_px, seen, share, residual, weight, options.detail_px)
