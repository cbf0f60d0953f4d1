"""Is the relief inside out? Geometry cannot tell (Necker reversal); shading can, where it is strong enough.

In secondary electrons what stands out of its surroundings is bright and what lies in a pit is dark: electrons leave
freely from the one and are caught again in the other. Slopes are bright, too, whichever way they fall, so that they are
taken out before heights and brightness are compared. With the wrong sign of the tilts the comparison changes its sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from semrecon.data import Array, HeightMap, Mask, TiltSeries
from semrecon.errors import InputError
from semrecon.matches.features import usable_pixels


@dataclass(frozen=True)
class ReliefOptions:
    """What counts as evidence.

    Parameters
    ----------
    scales
        Sizes of the places compared with their surroundings, as shares of the image's diagonal.
    clear
        Least correlation, mean over the scales, that is called clear; every scale must agree with its sign.
    sigmas
        Least mean correlation in standard deviations of what independent places would give by chance.
    least_places
        Fewest places of a scale, each as large as its blur, for it to be asked.
    """

    scales: tuple[float, ...] = (1 / 128, 1 / 64, 1 / 32)
    clear: float = 0.15
    sigmas: float = 3.0
    least_places: int = 40


@dataclass(frozen=True)
class ScaleCue:
    """Correlation of brightness with height against the surroundings at one scale.

    Parameters
    ----------
    scale_px
        Standard deviation of the blur that makes the surroundings.
    correlation
        Partial rank correlation, slope taken out: positive where what is high is bright.
    places
        How many places of that size the height map has.
    """

    scale_px: float
    correlation: float
    places: int


@dataclass(frozen=True)
class ReliefSign:
    """What shading says of the sign of a relief.

    Parameters
    ----------
    score
        Mean correlation over the scales, -1 to 1: positive is right side out, negative inside out; NaN if none could
        be asked.
    sigma
        Standard deviation of the score by chance.
    cues
        Per scale.
    clear
        True where all scales agree and the score is neither small nor chance.
    sentences
        What was found, for a report.
    """

    score: float
    sigma: float
    cues: tuple[ScaleCue, ...]
    clear: bool
    sentences: tuple[str, ...]


def relief_sign(series: TiltSeries, heights: HeightMap, options: ReliefOptions = ReliefOptions()) -> ReliefSign:
    """Compare the heights with the brightness of the reference view.

    Turning the heights over changes the sign of the score and nothing else.

    Raises
    ------
    InputError
        The height map is not on the grid of the series.
    """
    if heights.z_um.shape != series.optics.shape:
        raise InputError(f"the height map is of shape {heights.z_um.shape}, the images are of {series.optics.shape}")
    view = series.views[series.reference]
    known = np.isfinite(heights.z_um) & usable_pixels(view)
    z = np.where(known, heights.z_um, 0.0) / heights.pixel_size_um
    grey = np.where(known, view.image, 0).astype(np.float64)
    diagonal = float(np.hypot(*z.shape))
    asked = (shading_cue(z, grey, known, share * diagonal) for share in options.scales)
    cues = tuple(cue for cue in asked if cue.places >= options.least_places and np.isfinite(cue.correlation))
    if not cues:
        return ReliefSign(float("nan"), float("nan"), (), False, ("the height map is too small for shading",))
    score = float(np.mean([cue.correlation for cue in cues]))
    sigma = float(np.mean([cue.places**-0.5 for cue in cues]))
    agree = all(cue.correlation * score > 0 for cue in cues)
    clear = agree and abs(score) >= max(options.clear, options.sigmas * sigma)
    return ReliefSign(score, sigma, cues, clear, (_sentence(score, sigma, clear),))


def shading_cue(z_px: Array, grey: Array, known: Mask, scale_px: float) -> ScaleCue:
    """Correlate the ranks of height and brightness, each against its surroundings, with the slope taken out of both.

    Parameters
    ----------
    z_px, grey
        Heights and grey values on one grid, (rows, columns); only `known` pixels are read.
    """
    height = _against_surroundings(z_px, known, scale_px)
    brightness = _against_surroundings(grey, known, scale_px)
    slope = np.hypot(*np.gradient(_blur(z_px, known, scale_px / 2)))
    inner = ndimage.binary_erosion(known, iterations=max(int(scale_px), 1), border_value=0)
    places = int(inner.sum() / (np.pi * scale_px**2))
    step = max(int(scale_px / 3), 1)
    chosen = np.zeros_like(known)
    chosen[::step, ::step] = inner[::step, ::step]
    if chosen.sum() < 10:
        return ScaleCue(scale_px, float("nan"), places)
    steep = _ranks(slope[chosen])
    design = np.column_stack([np.ones_like(steep), steep, steep**2])
    rest = [_without(design, _ranks(values[chosen])) for values in (height, brightness)]
    size = float(np.linalg.norm(rest[0]) * np.linalg.norm(rest[1]))
    return ScaleCue(scale_px, float(rest[0] @ rest[1]) / size if size > 1e-9 else float("nan"), places)


def inside_out_warning(series: TiltSeries, heights: HeightMap, options: ReliefOptions = ReliefOptions()) -> str | None:
    """Say so where shading clearly says that the relief is inside out; None where it is not, or cannot be told."""
    found = relief_sign(series, heights, options)
    return found.sentences[0] if found.clear and found.score < 0 else None


def _sentence(score: float, sigma: float, clear: bool) -> str:
    numbers = f"(correlation of height with brightness {score:+.2f}, by chance +-{sigma:.2f})"
    if not clear:
        return f"shading does not tell whether the relief stands up or is inside out {numbers}"
    if score > 0:
        return f"what stands out is bright, as it should be in secondary electrons {numbers}"
    return (
        f"the relief looks inside out: what stands out is dark and what lies deep is bright {numbers}, the opposite of "
        "secondary electrons; if these are secondary electron images, the tilts count the other way: give --flip-tilt"
    )


def _against_surroundings(values: Array, known: Mask, scale_px: float) -> Array:
    return _blur(values, known, scale_px / 2) - _blur(values, known, scale_px)


def _blur(values: Array, known: Mask, sigma_px: float) -> Array:
    """Gaussian mean of the known values, (rows, columns)."""
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma_px)
    return np.asarray(ndimage.gaussian_filter(np.where(known, values, 0.0), sigma_px) / np.maximum(weight, 1e-6))


def _ranks(values: Array) -> Array:
    """Ranks from -1/2 to 1/2, the same for equal values."""
    from scipy.stats import rankdata

    return np.asarray((rankdata(values) - 0.5 * (len(values) + 1)) / len(values))


def _without(design: Array, values: Array) -> Array:
    """Leave out the least-squares fit of the design's columns."""
    return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])
