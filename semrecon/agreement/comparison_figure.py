"""The picture of a comparison: both surfaces, their difference, and whether their sigmas explain it."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semrecon.data import Array
from semrecon.output.maps import MISSING, OUTLINE, round_length, say

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from semrecon.agreement.comparison import Comparison

PAGE_INCHES, LETTERS = 11.0, 140
SPAN = 5.0
"""Half of the histogram's width, in sigmas."""


def write_figure(comparison: Comparison, path: Path) -> None:
    """Draw both height maps in the same colours, the difference in diverging ones, and the normalised difference."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, columns = comparison.first_um.shape
    panel_height = 0.42 * PAGE_INCHES * min(max(rows / columns, 0.5), 1.6)
    title = "\n".join(textwrap.fill(line, LETTERS, subsequent_indent="   ") for line in str(comparison).splitlines())
    size = (PAGE_INCHES, 2 * panel_height + 0.9 + 0.19 * len(title.splitlines()))
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    pixel, both = comparison.pixel_size_um, np.stack([comparison.first_um, comparison.second_um])
    low, high = np.nanpercentile(both, [1, 99])
    _map(figure, axes[0, 0], both[0], f"{comparison.first}: height", "viridis", (low, high), pixel)
    _map(figure, axes[0, 1], both[1], f"{comparison.second}, aligned: height", "viridis", (low, high), pixel)
    limit = max(comparison.quantile_um(0.95), 1e-9)
    name = f"{comparison.second} - {comparison.first}"
    _map(figure, axes[1, 0], comparison.difference_um, name, "RdBu_r", (-limit, limit), pixel)
    _histogram(axes[1, 1], comparison)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    figure.savefig(path)


def _map(
    figure: Figure, axes: Axes, values: Array, name: str, colours: str, limits: tuple[float, float], pixel: float
) -> None:
    low, high = limits
    shown = axes.imshow(values, cmap=colours, vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    axes.set_facecolor(MISSING)
    axes.set(xticks=[], yticks=[])
    axes.set_title(name, fontsize=10, parse_math=False)
    figure.colorbar(shown, ax=axes, label="µm", extend="both", shrink=0.9)
    _scale_bar(axes, values.shape, pixel)


def _scale_bar(axes: Axes, shape: tuple[int, ...], pixel: float) -> None:
    """Draw a bar of a round length, about a quarter of the width, in the lower left corner."""
    length_um = round_length(shape[1] * pixel / 4)
    x, y = 0.04 * shape[1], 0.95 * shape[0]
    for colour, thickness in (("black", 5), ("white", 3)):
        axes.plot([x, x + length_um / pixel], [y, y], color=colour, lw=thickness, solid_capstyle="butt")
    axes.annotate(
        f"{length_um:g} µm", (x, y), xytext=(0, 6), textcoords="offset points", color="white", fontsize=9, bbox=OUTLINE
    )


def _histogram(axes: Axes, comparison: Comparison) -> None:
    """Draw the density of difference / sigma beside the normal one that calibrated, independent sigmas would give."""
    values = comparison.normalised
    if not values.size:
        say(axes, "not both state a sigma")
        return
    edges = np.linspace(-SPAN, SPAN, 101)
    density = np.histogram(values, edges)[0] / (values.size * (edges[1] - edges[0]))
    axes.stairs(density, edges, fill=True, color="#7aa6c2", label="found")
    axes.plot(edges, np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi), color="black", label="if sigmas are right")
    beyond = float(np.mean(np.abs(values) > SPAN))
    axes.set_title(f"difference / sigma of both together; {beyond:.1%} beyond ±{SPAN:g}", fontsize=10)
    axes.set_xlabel("sigmas")
    axes.set_yticks([])
    axes.legend(fontsize=8, frameon=False)
