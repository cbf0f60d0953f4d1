"""Pictures of the report: maps as small WebP images, colours as CSS, plots as what plotly draws in the browser."""

from __future__ import annotations

import base64
import gzip
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judging.efficiency import SceneLimit
from semrecon.data import Array, Image, Mask
from semrecon.output.glance import block_means, grey_range
from semrecon.output.maps import round_length

HEIGHTS = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725")
"""Even in lightness, also to the colour-blind: viridis at nine places."""
ERRORS = ("#053061", "#2166ac", "#4393c3", "#92c5de", "#f7f7f7", "#f4a582", "#d6604d", "#b2182b", "#67001f")
"""Too low is blue, right is white, too high is red: told apart by the colour-blind too."""
MISSING, UNJUDGED = (205, 205, 205), (105, 105, 105)
"""Where a method has no height, and where not all views see the surface."""
MAP_PX, IMAGE_PX = 320, 640
"""Most columns of a map and of a micrograph."""
CURVES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#7f7f7f")
"""Colours of curves, told apart by the colour-blind (Okabe and Ito, the yellow darkened)."""
DASHES = ("solid", "dash", "dot", "dashdot")
SYMBOLS = ("circle", "diamond-open", "square", "cross")
"""Of points, one for each of the dashes."""
LEAST_UM = 1e-3
"""Smaller errors are drawn here: on an axis of ratios 0 is infinitely far."""
BOUND = "Cramér-Rao bound"
"""What the physical limit is called in plots."""
SHARES = np.linspace(0.01, 1.0, 100)
Figure = dict[str, Any]
"""`data` and `layout` of plotly."""


@dataclass(frozen=True)
class Panel:
    """A picture with its legend.

    Parameters
    ----------
    source
        Data URI.
    alt
        What it shows, for who cannot see it.
    bar_percent, bar_label
        Scale bar, in percent of the width.
    low, high, colours
        Ends and CSS colours of the colour bar; none for a micrograph.
    """

    source: str
    alt: str
    width_px: int
    height_px: int
    bar_percent: float
    bar_label: str
    low: str = ""
    high: str = ""
    colours: tuple[str, ...] = ()


def micrograph(image: Image, pixel_size_um: float, alt: str) -> Panel:
    """Show a view between the grey values that hold most of it."""
    low, high = grey_range(image)
    grey = _averaged(image.astype(np.float64), IMAGE_PX)
    shown = np.clip((grey - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    return _panel(shown, image.shape, pixel_size_um, alt)


def height_panel(z_um: Array, levels: tuple[float, float], pixel_size_um: float, alt: str) -> Panel:
    """Show heights between two levels; what is missing is grey."""
    shown = coloured(_averaged(z_um, MAP_PX), levels, HEIGHTS)
    return _panel(shown, z_um.shape, pixel_size_um, alt, levels, HEIGHTS)


def error_panel(error_um: Array, judged: Mask, limit_um: float, pixel_size_um: float, alt: str) -> Panel:
    """Show signed errors between -limit and +limit; what is missing and what is not judged are two greys."""
    levels = (-limit_um, limit_um)
    shown = coloured(_averaged(error_um, MAP_PX), levels, ERRORS)
    shown[_averaged(judged.astype(np.float64), MAP_PX) < 0.5] = UNJUDGED
    return _panel(shown, error_um.shape, pixel_size_um, alt, levels, ERRORS)


def limit_panel(sigma_um: Array, pixel_size_um: float, alt: str) -> Panel:
    """Show where the light says little of the height, red; what not all views see has no limit."""
    low, high = (float(each) for each in np.nanpercentile(sigma_um, [2, 95]))
    colours = ERRORS[len(ERRORS) // 2 :]
    averaged = _averaged(sigma_um, MAP_PX)
    shown = coloured(averaged, (low, high), colours)
    shown[~np.isfinite(averaged)] = UNJUDGED
    return _panel(shown, sigma_um.shape, pixel_size_um, alt, (low, high), colours)


def coloured(values: Array, levels: tuple[float, float], colours: Sequence[str]) -> NDArray[np.uint8]:
    """Give each value its colour, linearly between those named: (..., 3) uint8; NaN is `MISSING`."""
    low, high = levels
    anchors = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], dtype=np.float64)
    place = np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-12), 0, 1) * (len(colours) - 1)
    channels = [np.interp(place, np.arange(len(colours)), anchors[:, channel]) for channel in range(3)]
    answer = np.round(np.stack(channels, axis=-1)).astype(np.uint8)
    answer[~np.isfinite(values)] = MISSING
    return answer


def error_curves(
    errors_um: Mapping[str, Array], judged: int, places: Mapping[str, int], limit: SceneLimit | None = None
) -> Figure:
    """Draw the share of the judged surface whose error is within x: it ends at the completeness.

    Parameters
    ----------
    errors_um
        Errors by method, NaN where there is no height.
    judged
        Number of heights that could have been measured.
    places
        Number of each method, which gives its colour: the same in all scenes.
    limit
        The physical limit, drawn in grey where there is one.
    """
    data = [_limit_curve(limit)] if limit is not None and not limit.reason else []
    for name, errors in errors_um.items():
        colour, dash = style_of(places[name])
        known = np.abs(errors[np.isfinite(errors)])
        if not known.size:
            continue
        x, y = np.quantile(known, SHARES), SHARES * known.size / max(judged, 1)
        first = max(int(np.searchsorted(x, LEAST_UM)) - 1, 0)  # the last that is smaller stands for all of them
        line = {"color": colour, "dash": dash, "width": 2}
        x = np.maximum(x[first:], LEAST_UM)
        data.append({"x": numbers(x), "y": numbers(y[first:]), "name": name, "mode": "lines", "line": line})
    x_axis = {"title": {"text": "depth error at most (µm)"}, "type": "log", "exponentformat": "none"}
    return {"data": data, "layout": {"xaxis": x_axis, "yaxis": share_axis("share of the surface")}}


LEAST_RATIO = 0.01
"""Efficiencies below are rounding of the computer, and lie below the axis."""


def distance_plot(ratios: Mapping[str, Sequence[float]], scenes: Sequence[str], places: Mapping[str, int]) -> Figure:
    """Draw the efficiency of each method on each scene, with a line at 1: the limit.

    Parameters
    ----------
    ratios
        Efficiencies by method, in the order of the scenes; NaN where there is none.
    places
        Number of each method, which gives its colour.
    """
    line = {"color": "#8c8c8c", "dash": "dash", "width": 3}
    names = list(scenes)
    data: list[dict[str, Any]] = [{"x": names, "y": [1.0] * len(names), "name": BOUND, "mode": "lines", "line": line}]
    for name, values in ratios.items():
        colour, dash = style_of(places[name])
        marker = {"color": colour, "size": 9, "symbol": SYMBOLS[DASHES.index(dash)]}
        y = numbers(np.asarray(values, dtype=np.float64))
        data.append({"x": names, "y": y, "name": name, "mode": "markers", "marker": marker})
    y_axis = {"title": {"text": "error over limit"}, "type": "log", "exponentformat": "none", "dtick": 1}
    known = [value for values in ratios.values() for value in values if np.isfinite(value) and value > LEAST_RATIO]
    ends = [float(np.log10(min([1.0, *known]) / 1.5)), float(np.log10(max([1.0, *known]) * 1.5))]
    y_axis["range"] = ends  # an oracle that errs by rounding alone would take all of a logarithmic axis
    return {"data": data, "layout": {"xaxis": {"type": "category", "dtick": 1}, "yaxis": y_axis}}


def _limit_curve(limit: SceneLimit) -> dict[str, Any]:
    sigmas = limit.sigma_um[np.isfinite(limit.sigma_um)]
    ends = np.quantile(sigmas, [0.05, 0.95])
    x = np.geomspace(max(LEAST_UM, 0.05 * ends[0]), max(10 * LEAST_UM, 3 * ends[1]), 60)
    curve = theory_curve(BOUND, "dash", x, limit.shares_within(x))
    return {**curve, "line": {**curve["line"], "width": 3}}


def share_axis(title: str) -> dict[str, Any]:
    """Axis of what runs from nothing to all."""
    return {"title": {"text": title}, "range": [0, 1.02], "tickformat": ".0%"}


def curve_with_band(name: str, number: int, x: Array, y: Array, low: Array, high: Array) -> list[dict[str, Any]]:
    """Draw a curve, marked at its points, with its interval as bars where there is one."""
    colour, dash = style_of(number)
    up, down = (np.nan_to_num(np.abs(end - y)) for end in (high, low))
    bars = {"type": "data", "symmetric": False, "array": numbers(up), "arrayminus": numbers(down), "thickness": 1.2}
    style = {"color": colour, "dash": dash, "width": 2}
    curve = {"x": numbers(x), "y": numbers(y), "name": name, "mode": "lines+markers", "line": style}
    return [{**curve, "marker": {"color": colour, "size": 7}, "error_y": bars}]


def theory_curve(name: str, dash: str, x: Array, y: Array) -> dict[str, Any]:
    """Draw what is expected, in grey."""
    line = {"color": "#8c8c8c", "dash": dash, "width": 2}
    return {"x": numbers(x), "y": numbers(y), "name": name, "mode": "lines", "line": line}


def numbers(values: Array) -> list[float | None]:
    """Four digits of each; what is no number becomes None, as JSON has no NaN."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]


def said(value: float) -> str:
    """Three digits; a dash for what is no number."""
    return f"{value:.3g}".replace("-", "\N{MINUS SIGN}") if np.isfinite(value) else "–"


@cache
def plotly_packed() -> str:
    """Give plotly's script as gzip in base64: a third of its size, unpacked by the browser."""
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode("ascii")


def style_of(number: int) -> tuple[str, str]:
    """Colour and dash of a method by its number, the same in all figures."""
    return CURVES[number % len(CURVES)], DASHES[number // len(CURVES) % len(DASHES)]


def _averaged(values: Array, most_px: int) -> Array:
    return block_means(values, -(-values.shape[1] // most_px))


def _panel(
    shown: NDArray[np.uint8],
    shape: tuple[int, ...],
    pixel_size_um: float,
    alt: str,
    levels: tuple[float, float] | None = None,
    colours: tuple[str, ...] = (),
) -> Panel:
    width_um = shape[1] * pixel_size_um
    bar_um = round_length(width_um / 3.5)
    low, high = ("", "") if levels is None else map(said, levels)
    height, width = shown.shape[:2]
    return Panel(data_uri(shown), alt, width, height, 100 * bar_um / width_um, f"{bar_um:g} µm", low, high, colours)


def data_uri(shown: NDArray[np.uint8]) -> str:
    """Pack a picture into the page."""
    from PIL import Image as Picture

    buffer = io.BytesIO()
    Picture.fromarray(shown).save(buffer, "WEBP", quality=82, method=4)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
