"""Panels of the summary page that are drawn on axes of their own: residuals, beams, tilts, pairs of views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from semrecon.data import Array
from semrecon.output.glance import (
    ViewTilts,
    expected_density,
    in_words,
    noise_px,
    pair_matrices,
    plain,
    plain_numbers,
    stated,
    view_tilts,
)
from semrecon.output.maps import DOUBTS, colour_range, say
from semrecon.reconstruction import Reconstruction, finite_median

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorizer import ColorizingArtist

STATED, FOUND, REFERENCE = "#666666", "#0072b2", "#d55e00"
"""Grey, blue and vermilion: apart in lightness, also to the colour-blind."""
WIDEST_DEG = 60.0
"""Fans of beams are opened up to this half angle, for small tilts are hard to see."""
APART_DEG = 11.0
"""Labels of beams nearer than this would overlap."""
LEAST_HALF_WIDTH = 0.95
"""Of the drawing of beams, by which it fills its panel."""
MOST_COUNTS = 8
"""With more views the counts of a pair no longer fit into its square."""


def draw_histogram(axes: Axes, result: Reconstruction) -> None:
    """Draw residuals against what matching noise alone would give; without residuals what else the method states."""
    residual = result.fitted.residual_px[np.isfinite(result.fitted.residual_px)]
    if residual.size == 0:
        _draw_numbers(axes, result)
        return
    median, noise = finite_median(residual), noise_px(result)
    last = max(float(np.percentile(residual, 99.5)), 1e-6)
    axes.hist(residual, bins=60, range=(0, last), density=True, color=FOUND, alpha=0.55, label="points")
    axes.axvline(median, color="black", lw=1, label=f"median {median:.2g} px")
    counts = stated(result, "tracks_by_views")
    if noise > 0 and isinstance(counts, Mapping):
        r = np.linspace(0, last, 300)[1:]
        curve = expected_density(r, noise, counts)
        axes.plot(r, curve, color=REFERENCE, lw=1.8, label=f"expected of noise of {noise:.2g} px")
    axes.set(xlim=(0, last), ylim=(0, 1.35 * axes.get_ylim()[1]), yticks=[])  # room for the legend
    axes.set_xlabel("rms reprojection error of a point, px", fontsize=9)
    _head(axes, "Residuals of the points")
    axes.legend(fontsize=9, frameon=False, loc="upper right")


def draw_beams(axes: Axes, result: Reconstruction) -> None:
    """Draw the beam of every view as the specimen sees it, looking along the tilt axis."""
    from matplotlib.patches import Ellipse, Wedge

    tilts = view_tilts(result)
    best = tilts.best_deg
    times = opening(best)
    sigma = np.nan_to_num(tilts.sigma_deg) * times
    for i, tilt in enumerate(best * times):
        colour = REFERENCE if i == tilts.reference else FOUND if tilts.refined else STATED
        axes.add_patch(Wedge((0, 0), 1, 90 + tilt - sigma[i], 90 + tilt + sigma[i], color=colour, alpha=0.25, lw=0))
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.6 if i == tilts.reference else 1.1, "shrinkB": 0}
        axes.annotate("", _toward(tilt, 0.3), xytext=_toward(tilt), arrowprops=arrow)
        if tilts.refined:
            ends = np.array([_toward(tilts.stated_deg[i] * times, radius) for radius in (0.3, 1.0)])
            axes.plot(ends[:, 0], ends[:, 1], ":", color=STATED)
    for i in labelled(best * times, tilts.reference):
        colour = REFERENCE if i == tilts.reference else "black"
        words = f"{in_words(best[i])}°" if tilts.refined else f"{plain(tilts.stated_deg[i])}°"
        x, y = _toward(best[i] * times, 1.1)
        axes.text(x, y, words, color=colour, fontsize=9, ha="center", va="center")
    axes.add_patch(Ellipse((0, 0), 0.54, 0.34, facecolor="#bbbbbb", edgecolor="#777777"))
    half = max(LEAST_HALF_WIDTH, 1.22 * math.sin(math.radians(min(float(np.abs(best).max()) * times, 90.0))))
    axes.set(xlim=(-half, half), ylim=(-0.2, 1.22), aspect="equal")
    axes.set_axis_off()
    drawn = f", angles drawn {times:g} times" if times > 1 else ""
    _head(axes, f"Beams seen along the tilt axis{drawn}")
    _beam_legend(axes, tilts)


def opening(tilts_deg: Array) -> float:
    """By how much to open a fan of beams: the largest of a few factors that keeps it inside `WIDEST_DEG`."""
    widest = float(np.abs(tilts_deg).max(initial=0.0))
    return max((times for times in (1.0, 2.0, 3.0, 5.0, 10.0) if times * widest <= WIDEST_DEG), default=1.0)


def labelled(angles_deg: Array, reference: int) -> list[int]:
    """Choose views whose labels do not overlap: the reference, the outermost, then whatever has room."""
    first = [reference, int(np.argmin(angles_deg)), int(np.argmax(angles_deg))]
    chosen: list[int] = []
    for i in [*first, *range(len(angles_deg))]:
        if all(abs(angles_deg[i] - angles_deg[j]) >= APART_DEG for j in chosen):
            chosen.append(i)
    return chosen


def draw_tilts(axes: Axes, result: Reconstruction) -> None:
    """Draw by how much the images move each tilt, with its sigma."""
    tilts = view_tilts(result)
    if not tilts.refined:
        say(
            axes,
            "Tilts are as stated, not refined.\nA wrong tilt step scales the depth;\nsigma does not hold that.",
        )
        _head(axes, "Tilts: found less stated")
        return
    change = tilts.found_deg - tilts.stated_deg
    axes.axhline(0, color=STATED, ls=":")
    for views, colour, name in (
        (np.arange(len(change)) != tilts.reference, FOUND, "view"),
        (np.arange(len(change)) == tilts.reference, REFERENCE, "reference"),
    ):
        sigma = np.nan_to_num(tilts.sigma_deg[views])
        axes.errorbar(tilts.stated_deg[views], change[views], sigma, fmt="o", color=colour, capsize=3, label=name)
    axes.set_xlabel("stated tilt, degrees", fontsize=9)
    axes.set_ylabel("found less stated, degrees", fontsize=9)
    axes.margins(0.08, 0.1)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    _head(axes, "Tilts that the images ask for, with 1 sigma")
    axes.legend(fontsize=9, frameon=False, loc="upper right", ncols=2)


def draw_pairs(axes: Axes, result: Reconstruction) -> ColorizingArtist | None:
    """Draw by how much the matches of every pair of views disagree across the epipolar lines, and their number."""
    found = pair_matrices(result)
    if found is None:
        say(axes, "this method states nothing of pairs of views")
        _head(axes, "Pairs of views")
        return None
    matches, noise = found
    views = len(matches)
    low, high = colour_range(noise, 0.0) if np.isfinite(noise).any() else (0.0, 1.0)
    shown = axes.imshow(noise, cmap=DOUBTS, vmin=low, vmax=high)
    for i, j in np.argwhere(np.isfinite(matches)) if views <= MOST_COUNTS else ():
        bright = noise[i, j] > (low + high) / 2
        axes.text(
            j, i, f"{matches[i, j]:.0f}", ha="center", va="center", fontsize=9, color="black" if bright else "white"
        )
    ticks = np.arange(0, views, max(1, math.ceil(views / 10)))
    axes.set(xticks=ticks, yticks=ticks, xticklabels=ticks + 1, yticklabels=ticks + 1, facecolor="#f4f4f4")
    axes.set_xlabel("image", fontsize=9)
    counts = ", and number" if views <= MOST_COUNTS else ""
    _head(axes, f"Pairs: scatter of matches{counts}")
    return shown


def _draw_numbers(axes: Axes, result: Reconstruction) -> None:
    say(axes, "")
    numbers = plain_numbers(result.estimate.diagnostics, 10)
    lines = [f"{name}: {value}" for name, value in numbers] or ["this method states no residuals of points"]
    axes.text(0.05, 0.95, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=9, linespacing=1.5)
    _head(axes, "What the method states of its fit" if numbers else "Residuals of the points")


def _toward(angle_deg: float, radius: float = 1.0) -> tuple[float, float]:
    """Where the gun stands, seen along the tilt axis: a positive tilt moves it to the left."""
    return -radius * math.sin(math.radians(angle_deg)), radius * math.cos(math.radians(angle_deg))


def _beam_legend(axes: Axes, tilts: ViewTilts) -> None:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=REFERENCE, lw=1.6, label="reference")]
    if tilts.refined:
        lines += [Line2D([], [], color=FOUND, label="found"), Line2D([], [], color=STATED, ls=":", label="stated")]
    else:
        lines += [Line2D([], [], color=STATED, label="as stated")]
    axes.legend(handles=lines, fontsize=9, frameon=False, loc="lower left")


def _head(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.tick_params(labelsize=9)
