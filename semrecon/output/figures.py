"""The picture that a person opens first: what was measured, how far to trust it, and what to mind, on one page."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semrecon.output.charts import REFERENCE, draw_beams, draw_histogram, draw_pairs, draw_tilts
from semrecon.output.glance import block_means, facts, grey_range, in_words, plain, view_tilts, warning_lines
from semrecon.output.maps import draw_heights, draw_image, draw_relief, draw_residuals, draw_sigma
from semrecon.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorizer import ColorizingArtist
    from matplotlib.figure import Figure

Draw = Callable[["Axes", Reconstruction], "ColorizingArtist | None"]

DPI = 110
WIDTH, MARGIN, GAP = 14.0, 0.35, 0.45
"""Of the page, its rim, and the space between two panels; lengths on the page are inches."""
CELL = (WIDTH - 2 * MARGIN - 2 * GAP) / 3
TITLE, BAR = 0.32, 0.62
"""Above a panel, and below it for its colour bar or axis."""
CHART = 3.1
HEADLINE, LINE = 0.45, 0.2
LETTERS, MOST_WARNING_LINES = 170, 16
FACT_COLUMNS, FACT_NAME = 3, 0.95
INSETS: dict[Draw, float] = {draw_histogram: 0.1, draw_tilts: 0.6, draw_pairs: 0.35}
UNITS: dict[Draw, str] = {
    draw_heights: "height, µm",
    draw_sigma: "sigma, µm",
    draw_residuals: "rms reprojection error, px",
    draw_pairs: "across the epipolar lines, px",
}
THUMBS_A_ROW, LEAST_A_ROW = 10, 7
LETTER = 0.083
THUMB_WORDS = 0.46


@dataclass
class Sheet:
    """A page that is filled from the top.

    Parameters
    ----------
    figure
        Of the full height of the page.
    height
        Of the page.
    below_top
        Where the next thing goes.
    """

    figure: Figure
    height: float
    below_top: float = MARGIN

    def axes(self, left: float, width: float, height: float) -> Axes:
        """Place a panel at the present line."""
        bottom = self.height - self.below_top - height
        return self.figure.add_axes((left / WIDTH, bottom / self.height, width / WIDTH, height / self.height))

    def write(self, left: float, words: str, **how: object) -> None:
        """Write one line of words at the present line."""
        how = {"fontsize": 9.5, "va": "top", "parse_math": False} | how
        self.figure.text(left / WIDTH, 1 - self.below_top / self.height, words, **how)  # type: ignore[arg-type]


def write_summary(result: Reconstruction, path: Path) -> None:
    """Write the summary page as a PNG."""
    with warnings.catch_warnings():
        # names of files may hold letters that no font here has; they come out as boxes
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        draw_page(result).savefig(path)


def draw_page(result: Reconstruction) -> Figure:
    """Draw images, heights, sigma, residuals and camera directions, with the facts and the warnings above them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    known = facts(result)
    said = warning_lines(result.warnings, LETTERS, MOST_WARNING_LINES) or ["No warnings."]
    height = page_height(result, math.ceil(len(known) / FACT_COLUMNS) + len(said))
    figure = Figure(figsize=(WIDTH, height), dpi=DPI)
    FigureCanvasAgg(figure)
    sheet = Sheet(figure, height)
    _draw_header(sheet, result, known, said)
    maps = map_height(result)
    _draw_row(sheet, result, maps, (draw_image, draw_heights, draw_sigma))
    _draw_row(sheet, result, maps, (draw_relief, draw_residuals, draw_histogram))
    _draw_row(sheet, result, CHART, (draw_beams, draw_tilts, draw_pairs))
    _draw_thumbnails(sheet, result)
    return figure


def map_height(result: Reconstruction) -> float:
    """Height of a panel that holds an image, whatever its shape."""
    rows, columns = result.heights.z_um.shape
    return float(CELL * min(max(rows / columns, 0.45), 1.4))


def page_height(result: Reconstruction, lines: int) -> float:
    """Height of the page with so many lines of facts and warnings."""
    header = HEADLINE + LINE * (lines + 2)
    rows = 2 * map_height(result) + CHART + 3 * (TITLE + BAR)
    columns, thumb = _thumbnail_grid(result)
    return 2 * MARGIN + header + rows + TITLE + math.ceil(len(result.series) / columns) * (thumb + THUMB_WORDS)


def _draw_header(sheet: Sheet, result: Reconstruction, known: list[tuple[str, str]], said: list[str]) -> None:
    sheet.write(MARGIN, f"Surface from {len(result.series)} views by {result.method}", fontsize=15, weight="bold")
    sheet.below_top += HEADLINE
    rows = math.ceil(len(known) / FACT_COLUMNS)
    for row in range(rows):
        for column, (name, value) in enumerate(known[row::rows]):
            left = MARGIN + column * (CELL + GAP)
            sheet.write(left, name, color="#666666")
            sheet.write(left + FACT_NAME, value)
        sheet.below_top += LINE
    sheet.below_top += 0.5 * LINE
    for line in said:
        sheet.write(MARGIN, line, color="#8a2f00" if result.warnings else "#666666")
        sheet.below_top += LINE
    sheet.below_top += 0.5 * LINE


def _draw_row(sheet: Sheet, result: Reconstruction, height: float, draws: tuple[Draw, ...]) -> None:
    """Draw three panels side by side, each with a colour bar where it has colours."""
    sheet.below_top += TITLE
    for column, draw in enumerate(draws):
        # the axis labels of a chart stand inside its cell
        inset = INSETS.get(draw, 0.0)
        axes = sheet.axes(MARGIN + column * (CELL + GAP) + inset, CELL - inset, height)
        axes.set_anchor("NW")
        shown = draw(axes, result)
        if shown is not None:
            _draw_bar(sheet, axes, shown, draw)
    sheet.below_top += height + BAR


def _draw_bar(sheet: Sheet, axes: Axes, shown: ColorizingArtist, draw: Draw) -> None:
    """Draw a colour bar along what was drawn: below a map, beside a square."""
    axes.apply_aspect()
    box, upright = axes.get_position(), draw is draw_pairs
    thick, away = 0.12, 0.1
    if upright:
        place = (box.x1 + away / WIDTH, box.y0, thick / WIDTH, box.height)
    else:
        place = (box.x0, box.y0 - (away + thick) / sheet.height, box.width, thick / sheet.height)
    direction = "vertical" if upright else "horizontal"
    bar = sheet.figure.colorbar(shown, cax=sheet.figure.add_axes(place), orientation=direction, extend="both")
    bar.set_label(UNITS[draw], fontsize=9, labelpad=3 if upright else 1)
    bar.ax.tick_params(labelsize=9)


def _thumbnail_grid(result: Reconstruction) -> tuple[int, float]:
    """Columns and height of the thumbnails."""
    optics = result.series.optics
    columns = min(max(len(result.series), LEAST_A_ROW), THUMBS_A_ROW)
    width = (WIDTH - 2 * MARGIN) / columns - 0.1
    return columns, width * min(optics.height_px / optics.width_px, 1.4)


def _draw_thumbnails(sheet: Sheet, result: Reconstruction) -> None:
    """Draw all images with their tilts; the reference has a frame."""
    columns, height = _thumbnail_grid(result)
    step, tilts = (WIDTH - 2 * MARGIN) / columns, view_tilts(result)
    sheet.write(
        MARGIN, "All images, with the stated tilt" + (" → the tilt found" if tilts.refined else ""), fontsize=10
    )
    sheet.below_top += TITLE
    for i, view in enumerate(result.series.views):
        axes = sheet.axes(MARGIN + (i % columns) * step, step - 0.1, height)
        low, high = grey_range(view.image)
        shown = block_means(view.image.astype(np.float64), math.ceil(max(view.image.shape) / 200))
        axes.imshow(shown, cmap="gray", vmin=low, vmax=high)
        axes.set(xticks=[], yticks=[])
        axes.set_anchor("N")
        reference = i == tilts.reference
        axes.spines[:].set(color=REFERENCE if reference else "#999999", linewidth=2.5 if reference else 0.5)
        found = f" → {in_words(tilts.found_deg[i])}°" if tilts.refined and np.isfinite(tilts.found_deg[i]) else ""
        words = f"{shortened(f'{i + 1}: {view.name}', int(step / LETTER))}\n{plain(view.tilt_deg)}°{found}"
        axes.set_xlabel(words, fontsize=9, parse_math=False, color=REFERENCE if reference else "black", labelpad=3)
        if i % columns == columns - 1:
            sheet.below_top += height + THUMB_WORDS


def shortened(name: str, letters: int) -> str:
    """Cut the middle out of a long name: series differ at the end, specimens at the beginning."""
    half = (letters - 1) // 2
    return name if len(name) <= letters else f"{name[:half]}…{name[-half:]}"
