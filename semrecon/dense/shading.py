"""The stage of the dense method that reckons with brightness: which sizes, how many steps, and what is kept.

Steps (`semrecon.dense.synthesis`) change the detail at once and what is wide only slowly. So they are taken at half
the size first, where they cost a quarter and reach twice as far, with windows that are as wide on the specimen, and
each goes on a little in the direction of the last. What they find is kept where the views agree better on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from semrecon.data import Array, TiltSeries
from semrecon.dense.parallax import ParallaxOptions, drawn, mean_of, shared, within_reach
from semrecon.dense.pictures import HALVING_BLUR_PX, Level, filled, noise_model, noise_variance, pyramid
from semrecon.dense.reflectance import Reflectance, brightness, calibrated
from semrecon.dense.sightlines import Sightlines
from semrecon.dense.spline import Float, Spline, spline_of
from semrecon.dense.surface import enlarged
from semrecon.dense.synthesis import SynthesisOptions, step
from semrecon.dense.tilt_tones import misfit
from semrecon.matches.features import usable_pixels

BLACK_SHARE = 0.25, 0.85
"""Twice the root of the electrons at black, in parts of that at the mean grey value: least and most."""
LEAST_PX = 64
"""Pictures whose shorter side is less are not halved."""


@dataclass(frozen=True)
class ShadingOptions:
    """How shading is used.

    Parameters
    ----------
    synthesis
        How a step weighs what the views say.
    rounds, rounds_at_half
        Gauss-Newton steps at full size, and before them at half of it.
    momentum
        Share of the last step that the next one repeats.
    judged_px
        Standard deviation of the window in which it is judged whether the views agree better on the heights with
        shading than on those without.
    better
        Fall of their misfit, a pixel, from which shading counts in full.
    """

    synthesis: SynthesisOptions = field(default_factory=SynthesisOptions)
    rounds: int = 6
    rounds_at_half: int = 8
    momentum: float = 0.5
    judged_px: float = 12.0
    better: float = 0.025


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
    pictures: Sequence[Level],
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
    pictures
        All views, prepared.
    heights
        From parallax, (rows, columns), px; finite.
    everywhere
        Use shading even where the views agree less on it.
    """
    black = black_level(series)
    if black is None:
        return Shaded(heights, np.zeros(heights.shape, np.float32), {"shading": "noise does not grow with brightness"})
    splines = [spline_of(picture) for picture in pictures]
    mean, counts = mean_of(drawn(splines, lines, heights)[0])
    bright = brightness(mean, black, options.synthesis.brightness_px)
    reflectance = calibrated(mean, bright, counts >= 2, heights, lines.matrices[:, :, :3])
    detailed = heights
    if min(heights.shape) >= LEAST_PX:
        detailed = heights + change_at_half(pictures, lines, heights, reflectance, black, parallax, options)

    def one(z: Array) -> Array:
        return step(splines, lines, z, reflectance, black, parallax, options.synthesis)

    detailed = stepped(one, lines, detailed, options.rounds, options.momentum)
    trust = np.ones(heights.shape, np.float32)
    if not everywhere:
        trust = trust_in_shading(splines, lines, heights, detailed, black, parallax, options)
    found = {"detector_side": reflectance.side, "black_level": black, "share_by_shading": float(trust.mean())}
    return Shaded(heights + trust * (detailed - heights), trust, found)


def change_at_half(
    pictures: Sequence[Level],
    lines: Sightlines,
    heights: Array,
    reflectance: Reflectance,
    black: float,
    parallax: ParallaxOptions,
    options: ShadingOptions,
) -> Array:
    """Find how steps at half the size change heights (rows, columns), px of the full size as they are."""
    unit = 1 / np.sqrt(noise_variance(1))
    halves = [pyramid(picture, 1)[1] for picture in pictures]
    splines = [spline_of(Level(np.asarray(half.values * unit, np.float32), half.valid)) for half in halves]
    start = shared(heights, HALVING_BLUR_PX).astype(np.float64)[::2, ::2] / 2
    at_half, law, weighed = lines.at_level(1), reflectance.at_level(1), options.synthesis.at_level(1)

    def one(z: Array) -> Array:
        return step(splines, at_half, z, law, black * unit, parallax, weighed)

    found = stepped(one, at_half, start, options.rounds_at_half, options.momentum)
    return enlarged(found - start, heights.shape)


def stepped(one: Callable[[Array], Array], lines: Sightlines, heights: Array, rounds: int, momentum: float) -> Array:
    """Take steps with momentum (Polyak 1964) from heights (rows, columns), px.

    Parameters
    ----------
    one
        Change of heights that a Gauss-Newton step asks for.
    """
    change = np.zeros_like(heights)
    for _ in range(rounds):
        change = within_reach(one(heights) + momentum * change, lines)
        heights = heights + change
    return heights


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
