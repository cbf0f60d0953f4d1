"""How near an estimated surface lies to the true one in space: F-score, normals."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from semrecon.data import Array, Mask, Optics
from semsim.mesh import Mesh
from semsim.truth import GroundTruth

MOST_ASKED = 8_000
"""Points whose distance is asked for, evenly among all: a share is then known to half a percent."""


def world_points(z_um: Array, truth: GroundTruth, view: int, optics: Optics) -> Array:
    """Lift heights on the grid of a view into the world by its true pose: (points, 3) um, finite ones only."""
    rows, columns = np.nonzero(np.isfinite(z_um))
    depth = -z_um[rows, columns]
    scale = optics.pixel_size_um * (1 + optics.inverse_working_distance * depth)
    offsets = np.stack([columns, rows], axis=-1) - optics.centre_px
    return cloud_in_world(np.column_stack([offsets * scale[:, None] * [1.0, -1.0], -depth]), truth, view)


def cloud_in_world(in_view_um: Array, truth: GroundTruth, view: int) -> Array:
    """Take points from the view frame to the world by the true pose, (points, 3) um."""
    pose = truth.poses[view]
    return np.asarray((in_view_um * [1.0, -1.0, -1.0] - pose.translation_um) @ pose.rotation)


def f_scores(
    estimated_um: Array, truth: GroundTruth, judged_um: Array, tolerances_um: Sequence[float]
) -> list[tuple[float, float, float]]:
    """F-score, precision and recall at each tolerance.

    Precision is the share of the estimated points that lies within the tolerance of the true mesh; recall the share
    of `judged_um`, true points, that has an estimated point within it; the F-score is their harmonic mean. Of no points
    at all everything is 0.

    Parameters
    ----------
    estimated_um
        (points, 3), world.
    judged_um
        True points that could have been measured, (points, 3).
    """
    if not len(estimated_um) or not len(judged_um):
        return [(0.0, 0.0, 0.0) for _ in tolerances_um]
    to_truth = distances_to_mesh(_some(estimated_um), truth.mesh)
    reach = 1.01 * max(tolerances_um)
    to_estimate = cKDTree(estimated_um).query(_some(judged_um), distance_upper_bound=reach)[0]
    answer = []
    for tolerance in tolerances_um:
        precision, recall = float(np.mean(to_truth <= tolerance)), float(np.mean(to_estimate <= tolerance))
        total = precision + recall
        answer.append((2 * precision * recall / total if total else 0.0, precision, recall))
    return answer


def _some(points_um: Array) -> Array:
    return points_um[:: -(-len(points_um) // MOST_ASKED)]


def distances_to_mesh(points_um: Array, mesh: Mesh) -> Array:
    """Distance of each point to the nearest place of the mesh, (points,) um."""
    found = _searchable(mesh).compute_distance(points_um.astype(np.float32))
    return np.asarray(found.numpy(), dtype=np.float64)


@lru_cache(maxsize=1)
def _searchable(mesh: Mesh) -> Any:
    """Search tree of a mesh, kept for the next answer on the same scene: to build it costs more than to ask it."""
    import open3d

    scene: Any = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices_um.astype(np.float32), mesh.faces.astype(np.uint32))
    scene.compute_distance(np.zeros((1, 3), dtype=np.float32))  # the tree is built by the first question
    return scene


def normal_error_deg(estimated_um: Array, true_um: Array, judged: Mask, step_um: float) -> float:
    """Median angle between the normals of two height maps, both by central differences; NaN where none can be told."""
    one, other = _normals(estimated_um, step_um), _normals(true_um, step_um)
    both = judged & np.isfinite(one).all(axis=-1) & np.isfinite(other).all(axis=-1)
    if not both.any():
        return float("nan")
    sine = np.linalg.norm(np.cross(one[both], other[both]), axis=-1)
    cosine = np.sum(one[both] * other[both], axis=-1)
    return float(np.median(np.rad2deg(np.arctan2(sine, cosine))))


def _normals(z_um: Array, step_um: float) -> Array:
    down, right = np.gradient(z_um, step_um)
    normals = np.stack([-right, down, np.ones_like(z_um)], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
