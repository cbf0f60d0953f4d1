"""What the summary page shows, as numbers and sentences: no drawing here."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.data import Array, Image, Poses
from semrecon.reconstruction import Reconstruction, finite_median
from semrecon.surface.texture import surface_texture

POINTS_A_REGION = 8
REGIONS_ACROSS = 60
"""A median wants some points a region; more regions than these nobody can tell apart."""


@dataclass(frozen=True)
class ViewTilts:
    """Tilts of all views, degrees.

    Parameters
    ----------
    stated_deg
        By the stage, (views,).
    found_deg
        Of the poses that the method answered, about the axis found, (views,); NaN where it answered none.
    sigma_deg
        One standard deviation of the same, (views,); NaN where the method states none.
    axis_stated_deg, axis_found_deg, axis_sigma_deg
        Direction of the tilt axis; what was found is NaN where it was not sought.
    reference
        Index of the reference view.
    """

    stated_deg: Array
    found_deg: Array
    sigma_deg: Array
    axis_stated_deg: float
    axis_found_deg: float
    axis_sigma_deg: float
    reference: int

    @property
    def refined(self) -> bool:
        """Whether the method changed any tilt."""
        return bool(np.nanmax(np.abs(self.found_deg - self.stated_deg), initial=0.0) > 1e-6)

    @property
    def best_deg(self) -> Array:
        """What was found, or else stated."""
        return np.where(np.isfinite(self.found_deg), self.found_deg, self.stated_deg)

    @property
    def axis_deg(self) -> float:
        """Direction of the axis that was found, or else stated."""
        return self.axis_found_deg if math.isfinite(self.axis_found_deg) else self.axis_stated_deg


def view_tilts(result: Reconstruction) -> ViewTilts:
    """Gather stated and found tilts of a reconstruction."""
    series, views = result.series, len(result.series)
    refinement = stated(result, "refinement") or result.estimate.diagnostics.get("alignment")
    refinement = refinement if isinstance(refinement, Mapping) else {}
    axis = _number(refinement.get("tilt_axis_deg"))
    best_axis = axis if math.isfinite(axis) else series.tilt_axis_deg
    poses = result.estimate.poses
    return ViewTilts(
        series.tilts_deg,
        _fitted(None if poses is None else tilts_of(poses, best_axis)[:views], views),
        _fitted(refinement.get("tilt_sigma_deg"), views),
        series.tilt_axis_deg,
        axis,
        _number(refinement.get("tilt_axis_sigma_deg")),
        series.reference,
    )


def tilts_of(poses: Poses, tilt_axis_deg: float) -> Array:
    """Tilt of every pose about an axis, degrees, (views,): where the gun stands, seen along the axis.

    The gun stands at ``-sin(t) p + cos(t) z``, with ``p = (cos phi, -sin phi, 0)`` right of the axis.
    """
    phi = np.deg2rad(tilt_axis_deg)
    gun = -poses.rotations[:, 2]
    aside = gun @ np.array([np.cos(phi), -np.sin(phi), 0.0])
    return np.asarray(np.rad2deg(np.arctan2(-aside, gun[:, 2])))


def _fitted(values: Any, views: int) -> Array:
    """Values one a view, all NaN where they are none or not as many."""
    given = np.asarray([] if values is None else values, dtype=np.float64).ravel()
    return given if len(given) == views else np.full(views, np.nan)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float | np.number) else math.nan


def facts(result: Reconstruction) -> list[tuple[str, str]]:
    """Name and value of what a user asks first."""
    optics, tilts = result.series.optics, view_tilts(result)
    sigma_um = result.median_sigma_um
    width_um, height_um = (pixels * optics.pixel_size_um for pixels in (optics.width_px, optics.height_px))
    stated_deg = tilts.stated_deg
    return [
        ("method", result.method),
        ("views", f"{len(stated_deg)}, tilts {plain(stated_deg.min())}° to {plain(stated_deg.max())}°"),
        ("image", f"{optics.width_px} × {optics.height_px} px, {width_um:.4g} × {height_um:.4g} µm"),
        ("pixel size", f"{1000 * optics.pixel_size_um:.4g} nm"),
        ("points", f"{len(result.points):,}".replace(",", " ")),
        ("heights on", f"{result.completeness:.0%} of the image"),
        ("relief", _um(result.relief_um) + (" between 1 % and 99 %" if math.isfinite(result.relief_um) else "")),
        ("sigma", _um(sigma_um) + (" (median of the points)" if math.isfinite(sigma_um) else "")),
        ("roughness", _roughness(result)),
        ("residuals", _residuals(result)),
        ("tilts", "refined from the images" if tilts.refined else "as stated, not refined"),
        ("tilt axis", _axis(tilts)),
    ]


def _um(value: float) -> str:
    return f"{value:.3g} µm" if math.isfinite(value) else "not known"


def _roughness(result: Reconstruction) -> str:
    texture = surface_texture(result.heights).levelled
    if not math.isfinite(texture.Sa_um):
        return "not known"
    return f"Sa {texture.Sa_um:.3g}, Sq {texture.Sq_um:.3g}, Sz {texture.Sz_um:.3g} µm, levelled"


def _residuals(result: Reconstruction) -> str:
    median, noise = finite_median(result.fitted.residual_px), noise_px(result)
    said = [f"median {median:.2g} px"] if math.isfinite(median) else []
    said += [f"matching noise {noise:.2g} px"] if math.isfinite(noise) else []
    return ", ".join(said) or "not stated"


def _axis(tilts: ViewTilts) -> str:
    stated = f"{plain(tilts.axis_stated_deg)}° from image up, as stated"
    if not math.isfinite(tilts.axis_found_deg):
        return stated
    sigma = f" ± {tilts.axis_sigma_deg:.1g}" if math.isfinite(tilts.axis_sigma_deg) else ""
    return f"{in_words(tilts.axis_found_deg)}{sigma}° from image up (stated: {plain(tilts.axis_stated_deg)}°)"


def in_words(angle_deg: float) -> str:
    """Round an angle to a hundredth of a degree, and never to minus zero."""
    return f"{round(angle_deg, 2) + 0.0:.2f}"


def plain(angle_deg: float) -> str:
    """Write an angle without more decimals than it needs, two at most."""
    return f"{round(angle_deg, 2) + 0.0:g}"


def stated(result: Reconstruction, name: str) -> Any:
    """Return what the method, or the alignment that it began with, states under a name; None where neither does."""
    own = result.estimate.diagnostics
    alignment = own.get("alignment")
    return own.get(name, alignment.get(name) if isinstance(alignment, Mapping) else None)


def noise_px(result: Reconstruction) -> float:
    """Noise of a coordinate of a sighting as the method estimated it, px; NaN where it did not."""
    return _number(stated(result, "sigma_px"))


def expected_density(residual_px: Array, noise_px: float, tracks_by_views: Mapping[Any, Any]) -> Array:
    """Density of residuals if matching noise were all there is, per px.

    The sum of squares over v views has 2 v coordinates less the 3 of the point, so ``v r^2 / noise^2`` is chi-squared
    with 2 v - 3 degrees of freedom.

    Parameters
    ----------
    residual_px
        Root-mean-square lengths at which to answer, (n,).
    noise_px
        Standard deviation of a coordinate.
    tracks_by_views
        How many points are seen in so many views.
    """
    from scipy.stats import chi2

    counts = {int(views): float(count) for views, count in tracks_by_views.items() if int(views) >= 2}
    density = np.zeros_like(residual_px)
    for views, count in counts.items():
        inner = chi2.pdf(views * residual_px**2 / noise_px**2, 2 * views - 3) * 2 * views * residual_px / noise_px**2
        density += count / sum(counts.values()) * inner
    return density


def region_medians(xy_px: Array, values: Array, shape: tuple[int, int]) -> tuple[Array, float]:
    """Median of scattered values in square regions of an image.

    Parameters
    ----------
    xy_px, values
        Positions (n, 2) and values (n,); what is not finite takes no part.
    shape
        Rows and columns of the image.

    Returns
    -------
    Medians (rows, columns) from the upper left, NaN where nothing lies, and the edge of a region in px.
    """
    from scipy.stats import binned_statistic_2d

    known = np.isfinite(values) & np.isfinite(xy_px).all(axis=1)
    rows, columns = shape
    edge = math.sqrt(POINTS_A_REGION * rows * columns / max(int(known.sum()), 1))
    edge = float(max(math.ceil(edge), math.ceil(max(shape) / REGIONS_ACROSS), 1))
    edges = [np.arange(math.ceil(n / edge) + 1) * edge - 0.5 for n in shape]
    if not known.any():
        return np.full((len(edges[0]) - 1, len(edges[1]) - 1), np.nan), edge
    found = binned_statistic_2d(xy_px[known, 1], xy_px[known, 0], values[known], statistic="median", bins=edges)
    return np.asarray(found.statistic, dtype=np.float64), edge


def block_means(values: Array, factor: int) -> Array:
    """Mean of what is finite in blocks of `factor` pixels; blocks at the far edges may be smaller, NaN stays NaN."""
    if factor <= 1:
        return values
    down, right = (-n % factor for n in values.shape)
    padded = np.pad(values, ((0, down), (0, right)), constant_values=np.nan)
    blocks = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def grey_range(image: Image) -> tuple[float, float]:
    """Grey values to show as black and as white."""
    low, high = (float(level) for level in np.nan_to_num(np.percentile(image, [0.5, 99.5])))
    return low, max(high, low + 1)


def pair_matrices(result: Reconstruction) -> tuple[Array, Array] | None:
    """Return the matches of each pair of views, and their scatter across the epipolar lines (px).

    Both are (views, views), NaN where a pair was not matched; None where the method states no such thing.
    """
    pairs = stated(result, "pairs")
    views = len(result.series)
    matches, noise = np.full((views, views), np.nan), np.full((views, views), np.nan)
    for pair in pairs if isinstance(pairs, Sequence) else ():
        if not (isinstance(pair, Mapping) and {"views", "matches", "sigma_across_px"} <= pair.keys()):
            return None
        first, second = pair["views"]
        if max(first, second) < views:
            matches[first, second], noise[first, second] = pair["matches"], pair["sigma_across_px"]
    return (matches, noise) if np.isfinite(matches).any() else None


def plain_numbers(diagnostics: Mapping[str, Any], most: int) -> list[tuple[str, str]]:
    """Return up to `most` of the single numbers that a method states of its work, by name."""
    numbers = [(name, value) for name, value in diagnostics.items() if isinstance(value, int | float | np.number)]
    return [
        (name.replace("_", " "), f"{value:.4g}" if isinstance(value, float) else f"{value}")
        for name, value in numbers[:most]
    ]


def warning_lines(warnings: Sequence[str], letters: int, most_lines: int) -> list[str]:
    """Wrap warnings, each whole or not at all; the last line says how many more there are and where.

    Parameters
    ----------
    letters
        Of a line.
    most_lines
        That there is room for; the first warning is shown whatever its length.
    """
    lines: list[str] = []
    for number, warning in enumerate(warnings):
        wrapped = textwrap.wrap(warning, letters, initial_indent="!  ", subsequent_indent="    ") or ["!"]
        if lines and len(lines) + len(wrapped) > most_lines:
            more = len(warnings) - number
            return [*lines, f'    … and {more} more, under "warnings" in report.json']
        lines += wrapped
    return lines
