"""Strips of error maps: one picture a method, a tile a scene."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.reporting.error_maps import ErrorMap, Strip
from benchmarks.reporting.leaderboard import MARK
from benchmarks.reporting.report_figures import ERRORS, MISSING, UNJUDGED
from benchmarks.running.case import is_oracle
from semrecon.output.maps import round_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
WIDTH_PX, MARGIN_PX, COLUMNS = 1600, 10, 6
TILE_PX, TILE_HEIGHT_PX = 252, 189
ABOVE_PX, BELOW_PX, HEAD_PX = 24, 42, 70
QUALITIES = (88, 80, 72, 64, 56, 48, 40, 32, 24)
"""Of a JPEG: the first that makes it small enough."""
MOST_BYTES = 145_000
"""All strips together stay near 2 MB."""
LEAST_UM = 0.001
"""Below it a number is rounding."""
LINE, LINES = 34, 9
"""Letters a line and lines of a sentence on a tile."""


def draw_strip(path: Path, strip: Strip) -> None:
    """Draw the error maps of a method; the ending of `path` says the format.

    Colours run from too low (blue) to too high (red), ends in um above each tile; light grey has no height, dark
    grey is not judged, as some view does not see it. Below stand the median absolute error and the completeness.
    """
    rows = -(-len(strip.maps) // COLUMNS)
    height = HEAD_PX + rows * (ABOVE_PX + TILE_HEIGHT_PX + BELOW_PX) + MARGIN_PX
    figure = _figure(WIDTH_PX, height)
    _head(figure, strip, height)
    pitch = (WIDTH_PX - 2 * MARGIN_PX) / COLUMNS
    for number, one in enumerate(strip.maps):
        row, column = divmod(number, COLUMNS)
        left = MARGIN_PX + column * pitch + (pitch - TILE_PX) / 2
        top = HEAD_PX + row * (ABOVE_PX + TILE_HEIGHT_PX + BELOW_PX) + ABOVE_PX
        _tile(_axes(figure, left, top, TILE_PX, TILE_HEIGHT_PX, height), one)
    path.parent.mkdir(parents=True, exist_ok=True)
    _save(figure, path)


def headline(strip: Strip) -> str:
    """Name of the method and what was taken off its heights; an oracle says what it was given."""
    method = strip.method
    given = f" {MARK} (given {method.given})" if is_oracle(method) else ""
    return f"{method.name}{given}: estimated minus true height, after removal of {', '.join(method.gauge) or 'nothing'}"


def caption(one: ErrorMap) -> str:
    """Numbers of a map; a second line says what a wider gauge than an offset has forgiven."""
    said = f"median {_said(one.median_um)} µm, {100 * one.completeness:.0f} % complete"
    forgiven = one.offset_only_um > one.median_um * (1 + 1e-9)
    return f"{said}\n{_said(one.offset_only_um)} µm after an offset alone" if forgiven else said


def _tile(axes: Axes, one: ErrorMap) -> None:
    if one.failure:
        axes.set_title(one.scene, fontsize=10, pad=5)
        axes.set_facecolor("#f2f2f2")
        said = textwrap.wrap(one.failure, LINE, max_lines=LINES, placeholder=" ...")
        axes.text(0.5, 0.5, "\n".join(said), transform=axes.transAxes, ha="center", va="center", fontsize=9)
        return
    shown = np.where(one.judged, one.error_um, np.nan)
    axes.imshow(shown, cmap=_colours(), vmin=-one.limit_um, vmax=one.limit_um, interpolation="nearest", aspect="auto")
    axes.imshow(_cover(one), interpolation="nearest", aspect="auto")
    axes.set_title(f"{one.scene}, ±{_said(one.limit_um)} µm", fontsize=10, pad=5)
    axes.set_xlabel(caption(one), fontsize=10, labelpad=4)
    _scale_bar(axes, one)


def _cover(one: ErrorMap) -> Any:
    """Dark grey over what is not judged, clear elsewhere."""
    answer = np.zeros((*one.judged.shape, 4))
    answer[~one.judged] = (*_shares(UNJUDGED), 1.0)
    return answer


def _scale_bar(axes: Axes, one: ErrorMap) -> None:
    rows, columns = one.judged.shape
    length_um = round_length(0.25 * columns * one.pixel_size_um)
    ends = 0.04 * columns, 0.04 * columns + length_um / one.pixel_size_um
    box: dict[str, Any] = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    label = axes.text(sum(ends) / 2, 0.9 * rows, f"{length_um:g} µm", ha="center", va="bottom", fontsize=8)
    label.set_bbox(box)
    axes.plot(ends, (0.94 * rows, 0.94 * rows), color="black", linewidth=3, solid_capstyle="butt")
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))


def _head(figure: Figure, strip: Strip, height: int) -> None:
    figure.text(MARGIN_PX / WIDTH_PX, 1 - 12 / height, headline(strip), fontsize=13, va="top", weight="bold")
    bar = _axes(figure, MARGIN_PX + 90, 44, 260, 14, height)
    bar.imshow(np.linspace(-1, 1, 256)[None], cmap=_colours(), aspect="auto")
    place = 1 - 51 / height
    figure.text((MARGIN_PX + 82) / WIDTH_PX, place, "too low", fontsize=10, va="center", ha="right")
    figure.text(
        (MARGIN_PX + 358) / WIDTH_PX, place, "too high, ends as stated above each map", fontsize=10, va="center"
    )
    for left, colour, label in ((720, MISSING, "no height"), (850, UNJUDGED, "not judged: not seen by all views")):
        patch = _axes(figure, left, 44, 22, 14, height)
        patch.set_facecolor(_shares(colour))
        figure.text((left + 30) / WIDTH_PX, place, label, fontsize=10, va="center")


def _colours() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("errors", ERRORS).with_extremes(bad=_shares(MISSING))


def _shares(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = (each / 255 for each in colour)
    return red, green, blue


def _said(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    if 0 < value < LEAST_UM:
        return f"< {LEAST_UM:g}"
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _axes(figure: Figure, left: float, top: float, width: float, height: float, of_height: float) -> Axes:
    """Add axes at a place in pixels from the upper left corner, without ticks."""
    box = (left / WIDTH_PX, 1 - (top + height) / of_height, width / WIDTH_PX, height / of_height)
    axes = figure.add_axes(box)
    axes.set(xticks=[], yticks=[])
    return axes


def _figure(width_px: float, height_px: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    """Write the picture as its ending says; a JPEG as good as its size allows."""
    from PIL import Image

    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")  # type: ignore[attr-defined]
    if path.suffix != ".jpg":
        picture.save(path)
        return
    for quality in QUALITIES:
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=quality, optimize=True)
        if buffer.tell() <= MOST_BYTES:
            break
    path.write_bytes(buffer.getvalue())
