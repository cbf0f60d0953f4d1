"""The picture that a person opens first: image, heights, uncertainty and relief on one page."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semrecon.data import Array
from semrecon.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BACKGROUND = "#dddddd"
"""Where nothing was measured."""
PAGE_INCHES = 11.0
LINE, MOST = 140, 4
"""Letters a line, and warnings, above the panels."""
SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = 315.0, 55.0
"""Light from the upper left, as maps are drawn."""


def write_summary(result: Reconstruction, path: Path) -> None:
    """Draw reference image, height map, sigma map and shaded relief, each with a scale bar."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    optics = result.series.optics
    # a panel is half a page wide, less the colour bar
    panel_height = 0.42 * PAGE_INCHES * min(max(optics.height_px / optics.width_px, 0.5), 1.6)
    title = _title(result)
    title_height = 0.9 + 0.19 * len(title.splitlines())
    figure = Figure(figsize=(PAGE_INCHES, 2 * panel_height + title_height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    _draw_image(axes[0, 0], result)
    _draw_map(figure, axes[0, 1], result.heights.z_um, "height", "viridis", optics.pixel_size_um)
    _draw_map(figure, axes[1, 0], result.heights.sigma_um, "1 sigma", "magma", optics.pixel_size_um)
    _draw_relief(axes[1, 1], result)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    figure.savefig(path)


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


def _draw_image(axes: Axes, result: Reconstruction) -> None:
    view = result.series.views[result.series.reference]
    low, high = np.percentile(view.image, [0.5, 99.5])
    axes.imshow(view.image, cmap="gray", vmin=low, vmax=max(high, low + 1))
    _finish(axes, f"{view.name or 'reference view'}, tilt {view.tilt_deg:g}°", result.heights.pixel_size_um)


def _draw_map(figure: Figure, axes: Axes, values: Array, name: str, colours: str, pixel_size_um: float) -> None:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        axes.text(0.5, 0.5, f"no {name} stated", transform=axes.transAxes, ha="center", va="center")
        axes.set_axis_off()
        return
    low, high = np.percentile(finite, [1, 99])
    shown = axes.imshow(values, cmap=colours, vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    # sparse uncertainties stand at single pixels; a map needs its background to be told from missing
    axes.set_facecolor(BACKGROUND)
    figure.colorbar(shown, ax=axes, label=f"{name}, µm", extend="both", shrink=0.9)
    _finish(axes, f"{name}, median {np.median(finite):.3g} µm", pixel_size_um)


def _draw_relief(axes: Axes, result: Reconstruction) -> None:
    blur_px = point_spacing_px(result)
    z_um = smoothed(result.heights.z_um, blur_px) if blur_px > 2 else result.heights.z_um
    shade = hillshade(z_um, result.heights.pixel_size_um)
    axes.imshow(shade, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_facecolor(BACKGROUND)
    over = f", smoothed over {blur_px:.0f} px" if blur_px > 2 else ""
    _finish(axes, f"relief, lit from the upper left{over}", result.heights.pixel_size_um)


def _finish(axes: Axes, title: str, pixel_size_um: float) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])
    _scale_bar(axes, pixel_size_um)


def _scale_bar(axes: Axes, pixel_size_um: float) -> None:
    """Draw a bar of a round length, about a quarter of the width, in the lower left corner."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    width = right - left
    length_um = round_length(width * pixel_size_um / 4)
    x, y = left + 0.04 * width, bottom + 0.05 * (top - bottom)
    outline: dict[str, Any] = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 2.0}
    axes.plot([x, x + length_um / pixel_size_um], [y, y], color="black", linewidth=5, solid_capstyle="butt")
    axes.plot([x, x + length_um / pixel_size_um], [y, y], color="white", linewidth=3, solid_capstyle="butt")
    axes.annotate(
        f"{length_um:g} µm", (x, y), xytext=(0, 6), textcoords="offset points", color="white", fontsize=8, bbox=outline
    )


def _title(result: Reconstruction) -> str:
    tilts = ", ".join(f"{tilt:g}" for tilt in result.series.tilts_deg)
    sigma = result.median_sigma_um
    lines = [
        f"{result.method}: {len(result.series)} views at {tilts}°, "
        f"{1000 * result.series.optics.pixel_size_um:.4g} nm a pixel",
        f"{len(result.points)} points, heights on {result.completeness:.0%} of the image, "
        f"relief {result.relief_um:.3g} µm, median sigma {'not stated' if math.isnan(sigma) else f'{sigma:.2g} µm'}",
    ]
    shown = [textwrap.fill(f"Warning: {warning}", LINE, subsequent_indent="   ") for warning in result.warnings[:MOST]]
    more = [f"and {len(result.warnings) - MOST} more warnings in report.json"] if len(result.warnings) > MOST else []
    return "\n".join([*lines, *shown, *more])
