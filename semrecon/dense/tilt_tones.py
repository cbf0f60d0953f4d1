"""What differences between views say when brightness changes with tilt: of heights, and of slopes.

A slope brightens as it is tilted away from the beam. By the secant law view v shows it by ``log sec(phi_v)`` brighter,
and between views a few degrees apart that differs by the tilt times the slope along it. Parallax alone takes this for
motion, and is then wrong by about the radius of curvature, whatever the tilts and the dose. Here it is expected. With
s_v the motion of the picture by height, t_v the derivative of the tone by the slopes, both less their means over the
views, and r_v what differs at the present heights, a change dz leaves::

    sum over the views of w_v (r_v + s_v dz - t_v . grad dz)^2

Its normal equations couple neighbours: over short distances slopes change brightness more than heights move pictures.
Places as steep as walls are left out: their glow, shadows and overhangs follow no law of the slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from semrecon.data import Array
from semrecon.dense.bands import in_bands
from semrecon.dense.parallax import CAUCHY, ParallaxOptions, alike, mean_of, shared
from semrecon.dense.reflectance import LEAST_COSINE, brightness, slopes, slopes_transposed
from semrecon.dense.sightlines import Sightlines, motion
from semrecon.dense.spline import Float

STEEP_BLUR_PX = 2.0
"""Standard deviation of the blur under which steepness is judged ..."""
STEEP = 2.0
"""... and the slope at which the tone counts half."""
MISFIT_BLUR_PX = 1.0
NOISE_LEFT = 1 / np.sqrt(4 * np.pi * MISFIT_BLUR_PX**2)
"""Noise that is left of one unit by that blur."""


@dataclass(frozen=True)
class Windows:
    """Windows of the tones.

    Parameters
    ----------
    bright_px
        Standard deviation of that in which the brightness is measured that tones multiply.
    surroundings_px
        Standard deviation of the surroundings of which each view shows its own brightness: the glow of walls and the
        shade of hollows change with tilt as well, by a few parts in a thousand over tens of pixels, and would tip what
        is flat.
    """

    bright_px: float = 4.0
    surroundings_px: float = 5.0

    def at_level(self, level: int) -> Windows:
        """Measure in pixels of a pyramid level."""
        return Windows(self.bright_px / 2**level, self.surroundings_px / 2**level)


@dataclass(frozen=True)
class Differences:
    """Normal equations of the differences between views, by heights and slopes.

    Parameters
    ----------
    heights
        Square of the motion, by height, (rows, columns).
    mixed
        Motion times tone, by the slopes along columns and rows, (2, rows, columns).
    slopes
        Square of the tone, by both slopes: columns, mixed, rows, (3, rows, columns).
    right
        What is asked of the height and of both slopes, (3, rows, columns).
    """

    heights: Array
    mixed: Float
    slopes: Float
    right: Float

    def asked(self) -> Array:
        """Right-hand side, (rows, columns)."""
        return np.asarray(self.right[0] + slopes_transposed(self.right[1], self.right[2]), dtype=np.float64)

    def by_slopes(self, z: Array) -> Array:
        """Apply all but ``heights * z`` to a change of heights (rows, columns), px."""
        (across, down), plain = slopes(z), z.astype(np.float32)
        (a, b), (aa, ab, bb) = self.mixed, self.slopes
        turned = slopes_transposed(a * plain + aa * across + ab * down, b * plain + ab * across + bb * down)
        return np.asarray(a * across + b * down + turned)

    def diagonal(self) -> Float:
        """About the diagonal of `by_slopes`: 0.3 is the power of the slopes' stencils."""
        return np.asarray(0.3 * (self.slopes[0] + self.slopes[2]))


def differences(
    views: Float,
    gradient: Float,
    lines: Sightlines,
    heights: Array,
    black: float,
    options: ParallaxOptions,
    windows: Windows,
) -> Differences:
    """Compare all views at the present heights (rows, columns), px, noise of one unit.

    Parameters
    ----------
    views, gradient
        As from `semrecon.dense.parallax.drawn`, (views, rows, columns) and (2, rows, columns).
    black
        What makes grey values twice the root of the number of electrons, see `black_level`.
    """
    values = views.copy()
    across, down = slopes(heights)
    weight, rotations = gentle(heights), np.ascontiguousarray(lines.matrices[:, 2, :3])
    show_mean_tone(values, heights, lines, black)
    bright = brightness(mean_of(values)[0], black, windows.bright_px)
    alike(values, 1.0, windows.surroundings_px)
    geometry = np.array([lines.of(view) for view in range(len(values))])
    out = np.zeros((9, *heights.shape), dtype=np.float32)
    in_bands(
        len(heights),
        lambda start, stop: _accumulate(
            values, gradient, across, down, weight * bright, rotations, geometry, heights, out, start, stop
        ),
    )
    fields = np.stack([shared(field, options.window_px) for field in out])
    return Differences(fields[0].astype(np.float64), fields[1:3], fields[3:6], fields[6:])


def show_mean_tone(values: Float, heights: Array, lines: Sightlines, black: float) -> None:
    """Give all views (views, rows, columns), in place, the tone that the surface has in their mean."""
    across, down = slopes(heights)
    weight, beams = gentle(heights), np.ascontiguousarray(lines.matrices[:, 2, :3])
    in_bands(len(heights), lambda start, stop: _show_mean_tone(values, across, down, weight, beams, black, start, stop))


def misfit(views: Float, lines: Sightlines, heights: Array, black: float | None, options: ParallaxOptions) -> Array:
    """Say how much the views differ at heights (rows, columns), px: robustly, a view in excess, NaN where none is.

    Parameters
    ----------
    views
        Drawn onto the surface, (views, rows, columns).
    black
        As for `differences`; None compares without regard to tones.
    """
    values = views.copy()
    if black is not None:
        show_mean_tone(values, heights, lines, black)
    alike(values, 1.0, options.likeness_px)
    seen = np.isfinite(values)
    mean, counts = mean_of(values)
    values, excess = values - mean, counts - 1
    total = np.zeros(heights.shape)
    for one, known in zip(values, seen, strict=True):
        blurred = shared(np.where(known, one, 0), MISFIT_BLUR_PX) / NOISE_LEFT
        total += np.log1p((blurred / CAUCHY) ** 2)
    return np.asarray(np.where(excess > 0, total / np.maximum(excess, 1), np.nan))


def gentle(heights: Array, steep: float = STEEP) -> Float:
    """Weigh places by how far they are from steep, (rows, columns), 0 to 1.

    Parameters
    ----------
    steep
        Slope at which the weight is a half.
    """
    steepness = np.hypot(*slopes(shared(heights, STEEP_BLUR_PX).astype(np.float64)))
    return np.asarray(1 / (1 + (steepness / steep) ** 4), dtype=np.float32)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _show_mean_tone(
    values: Float,
    across: Float,
    down: Float,
    weight: Float,
    beams: Array,
    black: float,
    start: int,
    stop: int,
) -> None:
    views = len(values)
    tone = np.empty(views)
    for y in range(start, stop):
        for x in range(values.shape[2]):
            p, q = float(across[y, x]), float(down[y, x])
            length, mean = np.sqrt(p * p + q * q + 1.0), 0.0
            for view in range(views):
                cosine = (beams[view, 0] * p + beams[view, 1] * q + beams[view, 2]) / length
                tone[view] = -0.5 * np.log(max(cosine, LEAST_COSINE))
                mean += tone[view] / views
            for view in range(views):
                factor = np.exp(weight[y, x] * (mean - tone[view]))
                values[view, y, x] = (values[view, y, x] + black) * factor - black


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _accumulate(
    values: Float,
    gradient: Float,
    across: Float,
    down: Float,
    bright: Float,
    beams: Array,
    geometry: Array,
    heights: Array,
    out: Float,
    start: int,
    stop: int,
) -> None:
    views, _, columns = values.shape
    each = np.empty((4, views))  # motion along columns and rows, tone by both slopes
    weight, mean = np.empty(views), np.empty(4)
    for y in range(start, stop):
        for x in range(columns):
            n, centre = 0, 0.0
            for view in range(views):
                if not np.isnan(values[view, y, x]):
                    n, centre = n + 1, centre + values[view, y, x]
            if n < 2:
                continue
            centre /= n
            p, q = float(across[y, x]), float(down[y, x])
            square = p * p + q * q + 1.0
            total, level = 0.0, 0.0
            mean[:] = 0.0
            for view in range(views):
                value = values[view, y, x]
                weight[view] = 0.0
                if np.isnan(value):
                    continue
                weight[view] = 1 / (1 + ((value - centre) / (CAUCHY * 1.5)) ** 2)
                each[0, view], each[1, view] = motion(geometry[view], float(x), float(y), heights[y, x])
                each[2, view] = each[3, view] = 0.0
                cosine = beams[view, 0] * p + beams[view, 1] * q + beams[view, 2]
                if cosine > LEAST_COSINE * np.sqrt(square):
                    each[2, view] = -0.5 * (beams[view, 0] / cosine - p / square)
                    each[3, view] = -0.5 * (beams[view, 1] / cosine - q / square)
                total += weight[view]
                level += weight[view] * value
                for k in range(4):
                    mean[k] += weight[view] * each[k, view]
            level /= total
            for k in range(4):
                mean[k] /= total
            for view in range(views):
                w = weight[view]
                if w == 0:
                    continue
                s = gradient[0, y, x] * (each[0, view] - mean[0]) + gradient[1, y, x] * (each[1, view] - mean[1])
                a = -bright[y, x] * (each[2, view] - mean[2])
                b = -bright[y, x] * (each[3, view] - mean[3])
                r = values[view, y, x] - level
                out[0, y, x] += w * s * s
                out[1, y, x] += w * s * a
                out[2, y, x] += w * s * b
                out[3, y, x] += w * a * a
                out[4, y, x] += w * a * b
                out[5, y, x] += w * b * b
                out[6, y, x] -= w * s * r
                out[7, y, x] -= w * a * r
                out[8, y, x] -= w * b * r
