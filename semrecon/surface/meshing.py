"""Surfaces from points and heights: meshes (Figs. 7C, 8C), and height maps of sparse clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semrecon.data import Array, HeightMap, Mask, Optics, PointCloud, SurfaceMesh
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, back_project, project, view_from_world
from semrecon.surface.triangles import DEFAULT_LIMITS, Faces, TriangleLimits, fill_triangles, triangulate


def mesh_from_points(
    points: PointCloud | Array, rotation: Array = CAM_FROM_VIEW, limits: TriangleLimits = DEFAULT_LIMITS
) -> SurfaceMesh:
    """Join points to a surface by Delaunay triangles in the image plane of a view.

    Parameters
    ----------
    points
        Cloud, or (points, 3) um; points that are not finite are left out.
    rotation
        R_cam_from_world of the view, (3, 3); a view without tilt by default, so the plane is x, y.
    limits
        Which triangles bridge a gap, measured in that plane.

    Returns
    -------
    Mesh in the frame of the points, counter-clockwise as the view sees it: normals toward the gun. Points that no
    triangle uses are left out.

    Raises
    ------
    InputError
        If there are fewer than three points or all lie on a line in the view.
    """
    xyz = points.xyz_um if isinstance(points, PointCloud) else points
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    faces = triangulate((xyz @ rotation.T)[:, :2] * [1.0, -1.0], limits)
    return compact(xyz, faces)


def mesh_from_heights(
    heights: HeightMap,
    rotation: Array = CAM_FROM_VIEW,
    translation_um: NDArray[np.float64] | None = None,
    inverse_working_distance: float = 0.0,
    step: int = 1,
) -> SurfaceMesh:
    """Join the pixels of a height map to a surface in the world frame.

    Parameters
    ----------
    heights
        Missing pixels leave holes; a cell of four pixels with one missing keeps the triangle of the other three.
    rotation, translation_um
        Pose of the reference view, R_cam_from_world (3, 3) and t (3,); no tilt and no shift by default.
    inverse_working_distance
        k of the projection, 1/um (`Optics`).
    step
        Take every step-th row and column: at 1 there are two triangles a pixel.

    Raises
    ------
    InputError
        If the step is less than 1.
    """
    if step < 1:
        raise InputError(f"step must be at least 1, not {step}")
    rows, columns = heights.z_um.shape
    optics = Optics(heights.pixel_size_um, columns, rows, inverse_working_distance)
    row, column = np.mgrid[0:rows:step, 0:columns:step]
    z_um = heights.z_um[::step, ::step]
    translation = np.zeros(3) if translation_um is None else translation_um
    xy_px = np.stack([column, row], axis=-1).astype(np.float64)
    xyz = back_project(xy_px, -z_um, rotation, translation, optics)
    return compact(xyz.reshape(-1, 3), _grid_faces(np.isfinite(z_um)))


def height_map_from_points(
    cloud: PointCloud,
    optics: Optics,
    rotation: Array = CAM_FROM_VIEW,
    translation_um: NDArray[np.float64] | None = None,
    limits: TriangleLimits = DEFAULT_LIMITS,
) -> HeightMap:
    """Interpolate a cloud linearly over its triangles onto the pixel grid of the reference view.

    Parameters
    ----------
    cloud
        In the frame that the pose refers to. Where the view sees each point follows from its position, so points of any
        pair take part.
    optics
        Pixel grid and projection.
    rotation, translation_um
        Pose of the reference view, R_cam_from_world (3, 3) and t (3,); no tilt and no shift by default.
    limits
        Which triangles bridge a gap and stay NaN.

    Returns
    -------
    Heights along the beam (-X_cam_z). `sigma_um` is interpolated between the points' own along the beam: it holds no
    share for what the surface does between them.

    Raises
    ------
    InputError
        If there are fewer than three finite points or all lie on a line in the view.
    """
    cloud = cloud.keep(np.asarray(np.isfinite(cloud.xyz_um).all(axis=1)))
    translation = np.zeros(3) if translation_um is None else translation_um
    xy_px = project(cloud.xyz_um, rotation, translation, optics)
    height = -(cloud.xyz_um @ rotation[2] + translation[2])
    sigma = np.sqrt(np.einsum("i,nij,j->n", rotation[2], cloud.covariance_um2, rotation[2]))
    z_um, sigma_um = fill_triangles(xy_px, triangulate(xy_px, limits), np.stack([height, sigma], axis=1), optics.shape)
    return HeightMap(z_um, sigma_um, optics.pixel_size_um)


def statistical_outliers(xyz_um: Array, neighbours: int = 12, threshold: float = 5.0) -> Mask:
    """Mark points whose height disagrees with that of their neighbours in the image plane.

    The universal outlier test of velocimetry (Westerweel and Scarano, 2005): the distance from the neighbours' median
    in units of their own median deviation. A slope or a rough place raises both and is not taken for an outlier.
    Distances in space would not do: mismatched points are wrong along the beam only and often close to another.

    Parameters
    ----------
    xyz_um
        (points, 3) in the frame of the view (z to the gun), finite.
    neighbours
        How many of the nearest in x, y are asked.
    threshold
        Ratio from which a point is out.

    Returns
    -------
    (points,), True where the point is an outlier; all False where there are no more points than neighbours.
    """
    if len(xyz_um) <= neighbours:
        return np.zeros(len(xyz_um), dtype=np.bool_)
    _, index = cKDTree(xyz_um[:, :2]).query(xyz_um[:, :2], k=neighbours + 1)
    others = _without_self(index)
    around = xyz_um[others, 2]
    median = np.median(around, axis=1)
    deviation = np.median(np.abs(around - median[:, None]), axis=1)
    floor = 0.1 * np.median(deviation)  # a chance agreement of the neighbours must not condemn a good point
    return np.asarray(np.abs(xyz_um[:, 2] - median) > threshold * np.maximum(deviation, floor))


def without_outliers(points: PointCloud, rotation: Array = CAM_FROM_VIEW) -> PointCloud:
    """Leave out the points that stand out against their neighbours, as a view sees them: one would bend all round it.

    Parameters
    ----------
    points
        Cloud; points that are not finite are left out.
    rotation
        R_cam_from_world of the view, (3, 3).
    """
    points = points.keep(np.asarray(np.isfinite(points.xyz_um).all(axis=1)))
    return points.keep(~statistical_outliers(points.xyz_um @ view_from_world(rotation).T))


def _without_self(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Drop each point from the list of its neighbours; of points at one place the tree may name another first."""
    own = index == np.arange(len(index))[:, None]
    own[~own.any(axis=1), -1] = True
    return np.asarray(index[~own].reshape(len(index), -1))


def _grid_faces(valid: Mask) -> Faces:
    """Two triangles a cell of four valid pixels, one a cell of three; counter-clockwise with rows going down."""
    index = np.arange(valid.size).reshape(valid.shape)
    corners = [slice(None, -1), slice(1, None)]
    tl, tr, bl, br = (index[r, c] for r in corners for c in corners)
    has_tl, has_tr, has_bl, has_br = (valid[r, c] for r in corners for c in corners)
    triangles = [
        (tl, bl, br, has_tl & has_bl & has_br),
        (tl, br, tr, has_tl & has_br & has_tr),
        (tl, bl, tr, has_tl & has_bl & has_tr & ~has_br),
        (tr, bl, br, has_tr & has_bl & has_br & ~has_tl),
    ]
    return np.concatenate([np.stack([a[ok], b[ok], c[ok]], axis=1) for a, b, c, ok in triangles])


def compact(xyz_um: Array, faces: Faces) -> SurfaceMesh:
    """Leave out vertices that no face uses."""
    used = np.zeros(len(xyz_um), dtype=np.bool_)
    used[faces] = True
    renumbered = np.cumsum(used) - 1
    return SurfaceMesh(xyz_um[used], renumbered[faces])
