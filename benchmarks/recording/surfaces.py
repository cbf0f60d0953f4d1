"""Answers on record as surfaces in space: in the world frame, without their gauge, with the error of every point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.judging.evaluate import true_heights
from benchmarks.judging.surface_score import cloud_in_world, world_points
from benchmarks.reporting.report_figures import ERRORS, UNJUDGED, coloured
from benchmarks.reporting.report_scenes import Truth, drawn_answer
from benchmarks.running.stored import unpacked
from semrecon.data import Array, Estimate, Poses
from semrecon.geometry import nominal_poses, project, view_from_world
from semrecon.judging.gauge import gauge_fit, gauge_residual
from semsim.truth import GroundTruth

SURFACE_BYTES, POINT_BYTES = 52, 16
"""Of a vertex of a mesh with its normal, colour and two triangles, and of a point."""
FEW = 0.05
"""Points a pixel, below which points are shown beside the heights: the surface between them is filled."""
MOST_VERTICES = 20_000
"""Of one surface: a viewer shows it some 600 pixels wide."""


@dataclass(frozen=True)
class Placed:
    """A surface or a cloud in space.

    Parameters
    ----------
    xyz_um
        World frame, declared gauge removed, (n, 3).
    error_um
        Estimated minus true height, um, (n,); NaN where errors are not judged.
    faces
        Triangles (m, 3); none of a cloud.
    thinned
        Only one row and column of so many is shown, or one point of so many.
    """

    xyz_um: Array
    error_um: Array
    faces: NDArray[np.int64]
    thinned: int


@dataclass(frozen=True)
class Answered:
    """An answer in space: the surface of its heights, its points where they are few, and the poses that it found."""

    surface: Placed | None
    cloud: Placed | None
    poses: Poses | None

    @property
    def thinned(self) -> int:
        """How much is left out at most."""
        return max(each.thinned for each in (self.surface, self.cloud) if each is not None)


def answered(blob: bytes, truth: Truth, ground: GroundTruth, gauge: Sequence[str], most_bytes: int) -> Answered | None:
    """Put an answer into space.

    Parameters
    ----------
    blob
        The answer in its stored form.
    truth, ground
        What it is held against, and where that is in the world.
    gauge
        What the method declares unobservable: the judge's fit of it is removed.
    most_bytes
        That it may take in a recording; it is thinned to that.

    Returns
    -------
    None where the answer has too little to be brought near the truth.
    """
    estimate = unpacked(blob)
    surface = _surface(blob, truth, ground, gauge, max(1, most_bytes // SURFACE_BYTES))
    few = estimate.points is not None and len(estimate.points) < FEW * truth.z_um.size
    dots = _cloud(estimate, truth, ground, gauge, max(1, most_bytes // POINT_BYTES)) if few or not surface else None
    return Answered(surface, dots, estimate.poses) if surface or dots else None


def _surface(blob: bytes, truth: Truth, ground: GroundTruth, gauge: Sequence[str], most: int) -> Placed | None:
    drawn = drawn_answer(blob, truth, gauge)
    if drawn is None:
        return None
    every = thinning(drawn.heights_um.size, most)
    xyz_um, faces = lifted(drawn.heights_um, truth, ground, every)
    shown = np.isfinite(drawn.heights_um[::every, ::every])
    return Placed(xyz_um, drawn.errors_um[::every, ::every][shown], faces, every) if len(faces) else None


def thinning(pixels: int, most: int) -> int:
    """Of how many rows and columns one is kept, so that no more than about `most` pixels are."""
    return max(1, math.ceil(math.sqrt(pixels / most)))


def lifted(z_um: Array, truth: Truth, ground: GroundTruth, every: int) -> tuple[Array, NDArray[np.int64]]:
    """Lift every so-many-th row and column of heights of the reference view into the world as a mesh."""
    kept = np.full(z_um.shape, np.nan)
    kept[::every, ::every] = z_um[::every, ::every]
    xyz_um = world_points(kept, ground, truth.series.reference, truth.series.optics)
    return xyz_um, grid_faces(np.isfinite(z_um[::every, ::every]))


def grid_faces(known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Two triangles for each square of a grid whose corners are all known, (m, 3): numbers count what is known."""
    number = np.cumsum(known).reshape(known.shape) - 1
    whole = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    a, b, c, d = (each[whole] for each in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]).astype(np.int64)


def net(z_um: Array, truth: Truth, ground: GroundTruth, lines: int = 32) -> list[Array]:
    """Profiles of the true surface along and across the reference view, as broken lines, (n, 3) um each."""
    every = max(1, max(z_um.shape) // lines)
    fine = max(1, every // 6)
    rows = [(slice(each, each + 1), slice(0, None, fine)) for each in range(every // 2, z_um.shape[0], every)]
    columns = [(slice(0, None, fine), slice(each, each + 1)) for each in range(every // 2, z_um.shape[1], every)]
    strips = []
    for place in (*rows, *columns):
        kept = np.full(z_um.shape, np.nan)
        kept[place] = z_um[place]
        strips.append(world_points(kept, ground, truth.series.reference, truth.series.optics))
    return [strip for strip in strips if len(strip) > 1]


def error_colours(error_um: Array, limit_um: float) -> NDArray[np.uint8]:
    """Blue is too low, white right, red too high, as in the report; dark grey is what is not judged: (..., 3)."""
    colours = coloured(error_um, (-limit_um, limit_um), ERRORS)
    colours[~np.isfinite(error_um)] = UNJUDGED
    return colours


def _cloud(estimate: Estimate, truth: Truth, ground: GroundTruth, gauge: Sequence[str], most: int) -> Placed | None:
    """Place points as the judge does: at what the reference view sees where it shows them."""
    points, series = estimate.points, truth.series
    if points is None or not len(points):
        return None
    pose, view = estimate.poses or nominal_poses(series), series.reference
    rotation, shift = pose.rotations[view], pose.translations_um[view]
    seen_at = np.where(np.isfinite(points.xy_px), points.xy_px, project(points.xyz_um, rotation, shift, series.optics))
    in_view = points.xyz_um @ view_from_world(rotation).T + shift * [1.0, -1.0, -1.0]
    inside = np.isfinite(seen_at).all(axis=1) & np.isfinite(in_view).all(axis=1)
    in_view, seen_at = in_view[inside], seen_at[inside]
    true, declared = true_heights(ground, view, seen_at), tuple(gauge)
    fit = gauge_fit(in_view[:, 2], true, declared, in_view[:, :2], "absolute", narrower=False)  # type: ignore[arg-type]
    if fit is None:
        return None
    errors = gauge_residual(in_view[:, 2], true, declared, in_view[:, :2], "absolute")  # type: ignore[arg-type]
    z_um = fit.error(in_view[:, 2], np.zeros(len(in_view)), in_view[:, :2])
    xyz_um = cloud_in_world(np.column_stack([in_view[:, :2], z_um]), ground, view)
    every = -(-len(xyz_um) // most)
    return Placed(xyz_um[::every], errors[::every], np.empty((0, 3), dtype=np.int64), every)
