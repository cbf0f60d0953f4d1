"""Panels of the summary page that lie on the pixel grid of the reference view."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from semrecon.data import Array
from semrecon.output.glance import block_means, grey_range, plain, region_medians, view_tilts
from semrecon.reconstruction import Reconstruction, finite_median

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorizer import ColorizingArtist

MISSING = "#d9d9d9"
"""Where nothing was measured."""
HEIGHTS, DOUBTS = "viridis", "magma"
"""Colours even in lightness, also to the colour-blind: of heights, and of sigma and residuals."""
MOST_PX = 800
"""Finer maps are averaged: a panel has half as many pixels."""
SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = 315.0, 55.0
"""Light from the upper left, as maps are drawn."""
OUTLINE: dict[str, Any] = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 2.0}


def draw_image(axes: Axes, result: Reconstruction) -> None:
    """Draw the reference image, and the tilt axis on it."""
    view = result.series.views[result.series.reference]
    low, high = grey_range(view.image)
    _show_averaged(axes, view.image.astype(np.float64), cmap="gray", vmin=low, vmax=high)
    _finish(axes, result, f"Reference: {view.name or 'view'}, tilt {plain(view.tilt_deg)}°")
    _draw_axis(axes, result)


def draw_heights(axes: Axes, result: Reconstruction) -> ColorizingArtist | None:
    """Draw the height map."""
    return _draw_values(axes, result, result.heights.z_um, HEIGHTS, "Height", "no height was measured")


def draw_sigma(axes: Axes, result: Reconstruction) -> ColorizingArtist | None:
    """Draw the sigma map; of a sparse method the median over regions."""
    sigma, z_um = result.heights.sigma_um, result.heights.z_um
    known = np.isfinite(sigma)
    if known.sum() > 0.5 * np.isfinite(z_um).sum():
        return _draw_values(axes, result, sigma, DOUBTS, "Sigma (1 standard deviation)", "no sigma is stated")
    rows, columns = np.nonzero(known)
    xy_px = np.stack([columns, rows], axis=1).astype(np.float64)
    return _draw_regions(axes, result, xy_px, sigma[known], "Sigma", "no sigma is stated")


def draw_residuals(axes: Axes, result: Reconstruction) -> ColorizingArtist | None:
    """Draw where in the image the points fit badly: median residual over regions."""
    points = result.fitted
    return _draw_regions(axes, result, points.xy_px, points.residual_px, "Residual", "no residuals are stated")


def draw_relief(axes: Axes, result: Reconstruction) -> None:
    """Draw the height map as a landscape lit from the upper left; between sparse points it is smoothed."""
    z_um, pixel_um = result.heights.z_um, result.heights.pixel_size_um
    if min(z_um.shape) <= panel_factor(z_um.shape) or not np.isfinite(z_um).any():
        say(axes, "no relief was measured")
        return
    blur_px, factor = point_spacing_px(result), panel_factor(z_um.shape)
    coarse = block_means(z_um, factor)
    over = f", smoothed over {blur_px:.0f} px" if blur_px > 2 else ""
    shade = hillshade(smoothed(coarse, blur_px / factor) if over else coarse, factor * pixel_um)
    _show(axes, shade, factor, cmap="gray", vmin=0, vmax=1)
    _finish(axes, result, f"Relief, lit from the upper left{over}")


def hillshade(z_um: Array, pixel_size_um: float) -> Array:
    """Lambert shading of a height map under one light, (rows, columns) in 0 to 1, NaN at missing heights."""
    down, right = np.gradient(z_um, pixel_size_um)
    normal = np.stack([-right, down, np.ones_like(z_um)])  # image rows run down, y runs up
    azimuth, elevation = np.deg2rad([SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG])
    sun = [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    return np.asarray(np.clip(np.tensordot(sun, normal / np.linalg.norm(normal, axis=0), axes=1), 0, 1))


def point_spacing_px(result: Reconstruction) -> float:
    """Mean distance of the points in the image, px: finer relief than this is interpolation."""
    measured = int(np.isfinite(result.heights.z_um).sum())
    return math.sqrt(measured / max(len(result.points), 1))


def smoothed(z_um: Array, sigma_px: float) -> Array:
    """Blur heights by a Gaussian over what is measured; what is missing stays missing."""
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(z_um)
    weight = gaussian_filter(known.astype(np.float64), sigma_px)
    blurred = gaussian_filter(np.where(known, z_um, 0.0), sigma_px)
    return np.where(known, blurred / np.maximum(weight, 1e-12), np.nan)


def round_length(length: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is not above `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))


def say(axes: Axes, sentence: str) -> None:
    """Put a sentence where there is nothing to draw."""
    axes.set_facecolor("#f4f4f4")
    axes.set(xticks=[], yticks=[])
    axes.text(0.5, 0.5, sentence, transform=axes.transAxes, ha="center", va="center", color="#555555", fontsize=9)


def _draw_values(
    axes: Axes, result: Reconstruction, values: Array, colours: str, name: str, none: str
) -> ColorizingArtist | None:
    median = finite_median(values)
    if not math.isfinite(median):
        say(axes, none)
        return None
    low, high = colour_range(values)
    shown = _show_averaged(axes, values, cmap=colours, vmin=low, vmax=high)
    _finish(axes, result, f"{name}, median {median:.3g} µm")
    return shown


def _draw_regions(
    axes: Axes, result: Reconstruction, xy_px: Array, values: Array, name: str, none: str
) -> ColorizingArtist | None:
    known = np.isfinite(values) & np.isfinite(xy_px).all(axis=1)
    if not known.any():
        say(axes, none)
        return None
    medians, edge = region_medians(xy_px, values, result.heights.z_um.shape)
    low, high = colour_range(medians)
    across = (-0.5, medians.shape[1] * edge - 0.5, medians.shape[0] * edge - 0.5, -0.5)
    shown = axes.imshow(medians, cmap=DOUBTS, vmin=low, vmax=high, extent=across, interpolation="nearest")
    _finish(axes, result, f"{name}, medians over {edge:.0f} × {edge:.0f} px")
    return shown


def colour_range(values: Array, percent: float = 1.0) -> tuple[float, float]:
    """Values to show as darkest and brightest, without the outermost percent; never nearer than ticks can name."""
    low, high = (float(level) for level in np.nanpercentile(values, [percent, 100 - percent]))
    return low, max(high, low + max(0.02 * abs(low), 1e-6))


def panel_factor(shape: tuple[int, ...]) -> int:
    """Pixels to average along each edge, so that a panel can hold the map."""
    return max(math.ceil(max(shape) / MOST_PX), 1)


def _show_averaged(axes: Axes, values: Array, **how: Any) -> ColorizingArtist:
    factor = panel_factor(values.shape)
    return _show(axes, block_means(values, factor), factor, **how)


def _show(axes: Axes, shown: Array, factor: int, **how: Any) -> ColorizingArtist:
    """Show a map that was averaged over blocks of `factor` pixels, on the pixel grid that it had."""
    extent = (-0.5, shown.shape[1] * factor - 0.5, shown.shape[0] * factor - 0.5, -0.5)
    return axes.imshow(shown, extent=extent, interpolation="nearest", **how)


def _finish(axes: Axes, result: Reconstruction, title: str) -> None:
    rows, columns = result.heights.z_um.shape
    axes.set_facecolor(MISSING)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=10, loc="left", parse_math=False)
    _scale_bar(axes, result.heights.pixel_size_um)


def _scale_bar(axes: Axes, pixel_size_um: float) -> None:
    """Draw a bar of a round length, about a quarter of the width, in the lower left corner."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    width = right - left
    length_um = round_length(width * pixel_size_um / 4)
    x, y = left + 0.04 * width, bottom + 0.05 * (top - bottom)
    for colour, thickness in (("black", 5), ("white", 3)):
        axes.plot([x, x + length_um / pixel_size_um], [y, y], color=colour, lw=thickness, solid_capstyle="butt")
    axes.annotate(
        f"{length_um:g} µm", (x, y), xytext=(0, 6), textcoords="offset points", color="white", fontsize=9, bbox=OUTLINE
    )


def _draw_axis(axes: Axes, result: Reconstruction) -> None:
    """Draw the tilt axis through the centre, as found or else as stated; angles run from image up to image right."""
    rows, columns = result.heights.z_um.shape
    phi = np.deg2rad(view_tilts(result).axis_deg)
    along = 0.46 * np.array([np.sin(phi), -np.cos(phi)]) * min(rows, columns)
    centre = np.array([columns - 1, rows - 1]) / 2
    start, end = centre - along, centre + along
    for colour, thickness in (("black", 3.0), ("white", 1.4)):
        axes.annotate("", end, xytext=start, arrowprops={"arrowstyle": "->", "color": colour, "lw": thickness})
    axes.annotate(
        "tilt axis", end, xytext=(8, -8), textcoords="offset points", color="white", fontsize=9, va="top", bbox=OUTLINE
    )
