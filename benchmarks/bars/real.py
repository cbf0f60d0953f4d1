"""Real micrographs, where there is no truth: two halves of a series that share no picture must agree."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.bars.entrants import DENSE, SEED
from benchmarks.bars.line import TOLD, Asked, Line
from benchmarks.bars.plan import Found
from benchmarks.judging.paired import Interval
from benchmarks.running.ledger import Row
from benchmarks.running.runner import Job, code_version, digest
from benchmarks.scenes import RealSource
from benchmarks.suite import REAL_DATA
from semrecon.agreement.comparison import Comparison, compare
from semrecon.agreement.saved import surface_of
from semrecon.data import Array, PointCloud, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import CAM_FROM_VIEW, project
from semrecon.input.intake import take_in
from semrecon.methods import method_named
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import Reconstruction

BAR = "real"
SERIES = "potamogeton"
GAUGE = "rigid"
"""What is taken away before halves are compared: a tilt that they state differently is no fault of the surface."""
REACH_PX = 1.0
"""Points of both halves that are each other's nearest within so much are taken for the same place."""
QUICK = 0.25
"""Share of width and height that is kept of the pictures for a quick try."""
THRICE = Asked(least=3.0)
LEAST_PAIRS = 30
MOST_POINTS = 300_000
"""Of a cloud whose points are compared one by one: a denser one is its map."""


def real_files() -> tuple[Path, ...]:
    """Find the pictures; none where `SEM_REAL_DATA` does not name a folder that has them."""
    folder = os.environ.get(REAL_DATA)
    return tuple(sorted((Path(folder) / SERIES).glob("*.tif"))) if folder else ()


def real_jobs(*, quick: bool) -> list[Job]:
    """One job a method; none where there are no pictures."""
    files = real_files()
    if not files:
        return []
    share = QUICK if quick else 1.0
    identity = RealSource(SERIES, read_series(files, share)).identity
    version = code_version("semrecon", "benchmarks/bars/real.py")
    keys = [(digest(BAR, identity, repr(method_named(name)), version), name) for name in (DENSE, SEED)]
    return [Job((key,), measured, (files, name, share, key)) for key, name in keys]


def measured(files: tuple[Path, ...], name: str, share: float, key: str) -> list[Row]:
    """Reconstruct even and odd views with a method and compare; a refusal is a row with its sentence."""
    series = read_series(files, share)
    try:
        even, odd = (reconstruct(half, name) for half in halves(series))
        metrics = disagreement(even, odd)
    except (InputError, MethodError) as error:
        return [Row(key, BAR, SERIES, name, 0, {}, " ".join(str(error).split()))]
    return [Row(key, BAR, SERIES, name, 0, metrics)]


def halves(series: TiltSeries) -> tuple[TiltSeries, TiltSeries]:
    """Part a series into its even and its odd views."""
    return replace(series, views=series.views[::2]), replace(series, views=series.views[1::2])


def disagreement(one: Reconstruction, other: Reconstruction) -> dict[str, float]:
    """Median absolute difference of two reconstructions: of their maps, and of their points where these meet."""
    comparison = compare(surface_of(one, "even"), surface_of(other, "odd"), gauge=GAUGE)
    metrics = {"map_um": comparison.quantile_um(0.5), "pixels": float(comparison.compared)}
    metrics |= {"share": comparison.share_of_first}
    if max(len(one.points), len(other.points)) > MOST_POINTS:
        return metrics
    metrics |= {"at_points_um": float(np.nanmedian(np.abs(map_differences_um(one, comparison))))}
    differences = point_differences_um(one, other, comparison)
    if len(differences) < LEAST_PAIRS:
        return metrics | {"pairs": float(len(differences))}
    return metrics | {"points_um": float(np.median(np.abs(differences))), "pairs": float(len(differences))}


def point_differences_um(one: Reconstruction, other: Reconstruction, comparison: Comparison) -> Array:
    """Height differences of points at the same place, their median taken away, (n,).

    Neither surface is filled between its points for this, so that sparse clouds are not blamed for what lies between.
    """
    fixed = in_reference_view(one.points, one)
    moving = comparison.alignment.apply(in_reference_view(other.points, one))
    places = [project(each, CAM_FROM_VIEW, np.zeros(3), one.series.optics) for each in (fixed, moving)]
    first, second = mutual_nearest(places[0], places[1], REACH_PX)
    differences = moving[second, 2] - fixed[first, 2]
    return np.asarray(differences - np.median(differences)) if len(differences) else differences


def map_differences_um(one: Reconstruction, comparison: Comparison) -> Array:
    """Height differences of the maps at the pixels on which the points of the first lie, (n,); NaN where there is none.

    There the first map is measured, while the second may be filled between its own points.
    """
    difference = comparison.difference_um
    xy_px = project(in_reference_view(one.points, one), CAM_FROM_VIEW, np.zeros(3), one.series.optics)
    column, row = np.rint(xy_px[np.isfinite(xy_px).all(axis=1)]).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < difference.shape[1]) & (row < difference.shape[0])
    return np.asarray(difference[row[inside], column[inside]])


def in_reference_view(cloud: PointCloud, of: Reconstruction) -> Array:
    """World points in the view frame of the reference view of a reconstruction, (n, 3) um."""
    surface = surface_of(of)
    return np.asarray((cloud.xyz_um @ surface.rotation.T + surface.translation_um) @ CAM_FROM_VIEW)


def mutual_nearest(first_px: Array, second_px: Array, reach_px: float) -> tuple[Array, Array]:
    """Pair places that are each other's nearest within a reach: their indices, (n,) of both."""
    apart, there = cKDTree(second_px).query(first_px, distance_upper_bound=reach_px)
    _, back = cKDTree(first_px).query(second_px)
    near = np.flatnonzero(np.isfinite(apart))
    both = near[back[there[near]] == near]
    return both, there[both]


def real_lines(found: Found) -> list[Line]:
    """Say how much the halves disagree, and how much more the seed's method does."""
    if not real_files():
        return [Line(BAR, SERIES, THRICE, Interval(), f"{REAL_DATA} names no folder with {SERIES}")]
    rows = [found.rows[BAR, SERIES, name] for name in (DENSE, SEED)]
    failed = "; ".join(f"{row.contender}: {row.failure}" for row in rows if row.failure)
    if failed:
        return [Line(BAR, f"{SERIES}, even against odd views", THRICE, Interval(), failed)]
    dense, seed = (row.metrics for row in rows)
    ours, points, pairs = dense["map_um"], seed.get("points_um", float("nan")), seed.get("pairs", 0)
    own = seed.get("at_points_um", float("nan"))
    note = f"{points:.3g} um at {pairs:.0f} places, each of a point of either half within 1 px, against {ours:.3g} um"
    drawn = f"{own:.3g} um at the points of the even half, the odd half filled between its own, against {ours:.3g} um"
    told = f"at {dense['pixels']:.0f} pixels, {100 * dense['share']:.3g} % of the even half's"
    over = "known_rotation over dense_multiview, even against odd views"
    return [
        Line(BAR, f"{SERIES}: {DENSE}, even against odd views, um", TOLD, Interval(ours), told),
        Line(BAR, f"{SERIES}: {over}, at its points", THRICE, Interval(own / ours), drawn),
        Line(BAR, f"{SERIES}: {over}, where its halves both have a point", THRICE, Interval(points / ours), note),
        Line(BAR, f"{SERIES}: {over}, its surface filled", TOLD, Interval(seed["map_um"] / ours), "", detail=True),
    ]


def read_series(files: tuple[Path, ...], share: float) -> TiltSeries:
    """Read the pictures, or of each the middle: that share of its width and height."""
    series = take_in(list(files)).series
    return middle(series, share) if share < 1 else series


def middle(series: TiltSeries, share: float) -> TiltSeries:
    """Cut the middle out of every view."""
    height, width = (max(2, round(size * share)) for size in series.optics.shape)
    top, left = ((size - kept) // 2 for size, kept in zip(series.optics.shape, (height, width), strict=True))
    window = slice(top, top + height), slice(left, left + width)
    views = tuple(
        replace(view, image=view.image[window], mask=None if view.mask is None else view.mask[window], channels={})
        for view in series.views
    )
    return replace(series, views=views, optics=replace(series.optics, width_px=width, height_px=height))
