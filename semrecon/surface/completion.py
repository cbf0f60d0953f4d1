"""Points, heights and mesh from whichever of them a method answered."""

from __future__ import annotations

import math

import numpy as np

from semrecon.data import Array, Estimate, HeightMap, PointCloud, SurfaceMesh, TiltSeries
from semrecon.errors import MethodError
from semrecon.geometry import back_project, nominal_poses

MOST_VERTICES = 1_000_000
"""Of a mesh that viewers still turn smoothly; larger height maps are thinned for the mesh only."""
SPARSE = 0.1
"""Points a height pixel below which the points are the measurement."""


def complete(estimate: Estimate, series: TiltSeries) -> tuple[PointCloud, HeightMap, SurfaceMesh]:
    """Fill what the method left open: sparse methods get a mesh and its height map, dense ones a point a pixel.

    Raises
    ------
    MethodError
        There is neither a point nor a height to start from.
    """
    from semrecon.surface.meshing import height_map_from_points, mesh_from_heights, mesh_from_points, without_outliers

    pose = estimate.poses or nominal_poses(series)
    rotation, translation = pose.rotations[series.reference], pose.translations_um[series.reference]
    points, heights = estimate.points, estimate.heights
    if heights is None:
        if points is None or len(points) == 0:
            raise MethodError("the method found no point of the surface; check tilts, tilt axis and overlap of images")
        heights = height_map_from_points(points, series.optics, rotation, translation)
    if points is None:
        points = points_from_heights(heights, series, rotation, translation)
    if is_sparse(points, heights):
        return points, heights, mesh_from_points(without_outliers(points, rotation), rotation)
    step = max(1, math.ceil(math.sqrt(heights.z_um.size / MOST_VERTICES)))
    k = series.optics.inverse_working_distance
    return points, heights, mesh_from_heights(heights, rotation, translation, k, step)


def is_sparse(points: PointCloud, heights: HeightMap) -> bool:
    """Whether the heights are filled in between the points, so that a triangle a pixel would say nothing more."""
    return len(points) < SPARSE * int(np.isfinite(heights.z_um).sum())


def points_from_heights(heights: HeightMap, series: TiltSeries, rotation: Array, translation_um: Array) -> PointCloud:
    """Lift every measured pixel into the world frame.

    Parameters
    ----------
    rotation, translation_um
        Pose of the reference view, R_cam_from_world (3, 3) and t (3,).
    """
    rows, columns = np.nonzero(np.isfinite(heights.z_um))
    xy_px = np.column_stack([columns, rows]).astype(np.float64)
    depth_um = -heights.z_um[rows, columns]
    xyz = back_project(xy_px, depth_um, rotation, translation_um, series.optics)
    beam = rotation[2]  # the height is measured along the beam, so all its uncertainty lies along it
    covariance = heights.sigma_um[rows, columns, None, None] ** 2 * np.outer(beam, beam)
    return PointCloud(xyz, covariance, np.full(len(xyz), np.nan), xy_px)
