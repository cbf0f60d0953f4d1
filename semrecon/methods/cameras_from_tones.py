"""Cameras of a dense reconstruction, refined on the grey values of all pixels.

Features alone know the tilts to a tenth of a degree, and shading misleads them: where the surface is steep, brightness
belongs to the slope rather than to the place, and foreshortening looks weaker than it is. All pixels together know
several times better, and steep ones can be left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semrecon.adjustment.camera_model import LOCAL, Cameras
from semrecon.adjustment.refined_geometry import Refinement
from semrecon.adjustment.tones import LEAST_VIEWS, Drawn, Stage, combined, tone_equations
from semrecon.data import Array, Poses, TiltSeries
from semrecon.dense.parallax import ParallaxOptions, alike, drawn, mean_of, refined, shared
from semrecon.dense.reflectance import slopes
from semrecon.dense.sightlines import Sightlines, sightlines
from semrecon.dense.spline import Float, Spline
from semrecon.points.triangulation import triangulate
from semrecon.pose.alignment import Alignment

ROUNDS = 3
HEIGHT_ROUNDS = 1
"""Steps of the heights after each of the cameras."""
SAMPLES = 4_000_000
"""Pixels times views that are looked at, most."""
MOST_EXCESS = 4.0
"""Variance of the tilts over that of the noise alone from which the tiles contradict one another too much: shapes that
many pixels have in common, as balls and stairs do, are then drawn wrong, and more pixels make it no better."""
STEEP_BLUR_PX = 2.0
"""Standard deviation of the blur under which steepness is judged ..."""
STEEP = 1.6, 3.2
"""... and the slopes along the parallax and across it at which a pixel counts half ..."""
SHARP = 8
"""... the power by which it then fades away."""
APART_BLUR_PX = 2.0
"""Standard deviation of the blur under which views are compared place by place ..."""
APART = 2.0
"""... and how far apart they are, in noise of a view, where a place counts half."""
MISLED_DEG = 0.2
"""By how much shading may mislead the features on each tilt: on specimens of development with a perfect stage they were
off by up to 0.4 degrees."""


def with_tones(
    series: TiltSeries,
    aligned: Alignment,
    splines: Sequence[Spline],
    heights: Array,
    options: ParallaxOptions,
    tilt_sigma_deg: float,
) -> tuple[Alignment, Array]:
    """Refine cameras that features gave, and the heights (rows, columns), px, with them.

    The cameras stay where there are too few views or features, or where the tilts are held. Where parts of the picture
    contradict one another, its grey values are not heard: features and stage share the say.

    Parameters
    ----------
    tilt_sigma_deg
        Standard deviation of each tilt as the stage states it.
    """
    found, reference = aligned.refinement, series.reference
    if found is None or not found.tilt_sigma_deg.any() or len(aligned.by_features) < LEAST_VIEWS:
        return aligned, heights
    known, covariance = _known(found, aligned, reference)
    cameras, stage = known, Stage(np.deg2rad(series.tilts_deg), np.deg2rad(tilt_sigma_deg))
    contradicted = False
    for turn in range(ROUNDS):
        before = _lines(cameras, series)
        if not contradicted:
            equations = tone_equations(_drawn(splines, before, heights, options), cameras, reference, series.optics)
            contradicted = turn == 0 and equations.excess > MOST_EXCESS
        heard = equations.silent() if contradicted else equations
        cameras, spread = combined(heard, stage, cameras, known, covariance)
        after = _lines(cameras, series)
        heights = moved_along(heights, before, after)
        heights = refined(splines, after, heights, 1.0, replace(options, rounds=HEIGHT_ROUNDS))
    settled = _alignment(series, aligned, found, cameras, spread)
    return _said(settled, {"tone_excess": equations.excess}), heights


def moved_along(heights: Array, old: Sightlines, new: Sightlines) -> Array:
    """Change heights (rows, columns), px, so that new cameras see the surface as nearly as can be as old ones did."""
    rows, columns = heights.shape
    x, y = np.arange(columns) - old.centre_px[0], np.arange(rows)[:, None] - old.centre_px[1]
    scale = 1 - old.k * heights
    along, moved = np.zeros(heights.shape), np.zeros(heights.shape)
    for view, parallax in enumerate(new.parallax()):
        before, after = (_places(lines, view, x * scale, y * scale, heights) for lines in (old, new))
        along += (parallax**2).sum()
        moved += parallax[0] * (after[0] - before[0]) + parallax[1] * (after[1] - before[1])
    return np.asarray(heights - moved / np.maximum(along, 1e-12))


def _places(lines: Sightlines, view: int, x: Array, y: Array, heights: Array) -> tuple[Array, Array]:
    """Where a view sees the surface, from the image centre, px."""
    p, q, r = (row[0] * x + row[1] * y - row[2] * heights + row[3] for row in lines.matrices[view])
    scale = 1 + lines.k * r
    return p / scale, q / scale


def _lines(cameras: Cameras, series: TiltSeries) -> Sightlines:
    return sightlines(cameras.poses, cameras.distortions, series.optics, series.reference)


def _drawn(splines: Sequence[Spline], lines: Sightlines, heights: Array, options: ParallaxOptions) -> Drawn:
    """Draw the views onto the surface, and weigh its pixels."""
    values, gradient = drawn(splines, lines, heights)
    alike(values, 1.0, options.likeness_px)
    weight = _gentle(heights, lines) * _agreed(values)
    return Drawn(values, gradient, weight, heights, math.ceil(math.sqrt(values.size / SAMPLES)))


def _agreed(values: Float) -> Float:
    """Leave out places where the views (views, rows, columns) show different things, (rows, columns), 0 to 1.

    There the surface is not where it is taken to be, or not seen by all, and what they differ by bends as it likes.
    """
    mean, counts = mean_of(values)
    apart = sum(shared(np.nan_to_num(one - mean) ** 2, APART_BLUR_PX) for one in values) / np.maximum(counts - 1, 1)
    return np.asarray(1 / (1 + (apart / APART**2) ** 2), dtype=np.float32)


def _gentle(heights: Array, lines: Sightlines) -> Float:
    """Leave out what is steep, above all along the parallax, (rows, columns), 0 to 1."""
    across, down = slopes(shared(heights, STEEP_BLUR_PX).astype(np.float64))
    parallax = lines.parallax()
    fastest = parallax[np.argmax(np.linalg.norm(parallax, axis=1))]
    x, y = fastest / max(float(np.linalg.norm(fastest)), 1e-12)
    along, aside = np.abs(x * across + y * down) / STEEP[0], np.abs(x * down - y * across) / STEEP[1]
    return np.asarray(1 / (1 + along**SHARP + aside**SHARP), dtype=np.float32)


def _said(aligned: Alignment, found: Mapping[str, float]) -> Alignment:
    return replace(aligned, diagnostics={**aligned.diagnostics, **found})


def _known(found: Refinement, aligned: Alignment, reference: int) -> tuple[Cameras, Array]:
    """Cameras of all views and their covariance; views without features are held.

    A tilt from that of the reference view is known less well than the features say, by `MISLED_DEG`.
    """
    views, group = len(aligned.tilts_deg), list(aligned.by_features)
    tilts, turns, logs = np.deg2rad(aligned.tilts_deg), np.zeros(views), np.zeros(views)
    turns[group], logs[group] = found.cameras.turns_rad, found.cameras.log_magnifications
    shifts = aligned.poses.translations_um[:, :2]
    known = Cameras(tilts, found.cameras.axis_rad, logs, turns, shifts)
    index = np.append((LOCAL * np.array(group)[:, None] + np.arange(LOCAL)).ravel(), LOCAL * views)
    covariance = np.zeros((LOCAL * views + 1, LOCAL * views + 1))
    covariance[np.ix_(index, index)] = found.covariance
    free = [LOCAL * view + 2 for n, view in enumerate(group) if found.tilt_sigma_deg[n] > 0 and view != reference]
    covariance[free, free] += np.deg2rad(MISLED_DEG) ** 2
    return known, covariance


def _alignment(
    series: TiltSeries, aligned: Alignment, found: Refinement, cameras: Cameras, covariance: Array
) -> Alignment:
    """Alignment with the cameras put in, and the points of the features where these see them."""
    group, tilts = list(aligned.by_features), np.rad2deg(cameras.tilts_rad)
    sigma = np.rad2deg(np.sqrt(np.diag(covariance)[2:-1:LOCAL]))
    reached = np.where(sigma > 0, sigma, np.asarray(aligned.diagnostics.get("tilt_sigma_deg", sigma)))
    said = {"tilts_deg": tilts, "tilt_sigma_deg": reached, "magnifications": cameras.magnifications}
    poses = cameras.poses
    of_group = Poses(poses.rotations[group], poses.translations_um[group])
    points = triangulate(
        found.tracks, of_group, series.optics, sigma_px=found.sigma_px, reference=group.index(series.reference)
    )
    return replace(
        aligned,
        poses=poses,
        distortions=cameras.distortions,
        tilts_deg=tilts,
        tilt_axis_deg=float(np.rad2deg(cameras.axis_rad)),
        points=points.keep(np.isfinite(points.residual_px)),
        diagnostics={**aligned.diagnostics, **said},
    )
