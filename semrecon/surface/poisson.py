"""Poisson surfaces of full clouds (Kazhdan and Hoppe, 2013): one smooth sheet through the middle of noisy points."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from semrecon.data import Array, PointCloud, SurfaceMesh
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, nominal_poses
from semrecon.reconstruction import Reconstruction
from semrecon.surface.meshing import compact, without_outliers

LEAST_POINTS, MOST_POINTS = 30, 1_000_000
"""A larger cloud is thinned by chance, always in the same way: a million points take half a minute."""
NEIGHBOURS = 16
"""Points from which a normal and the local spacing come."""
CELL_SPACINGS = 2.0
"""Finest cell in units of the spacing of the points: finer would follow the noise."""
DEPTHS = (5, 9)
"""Least and most halvings of the bounding cube: the solver goes astray below 5; each more takes four times as long."""

MESHES = ("triangles", "poisson")
"""Ways to make the mesh of a reconstruction; the first is the default."""


def check_meshing(name: str) -> None:
    """Refuse a way to make a mesh that is not known; raises `InputError`."""
    if name not in MESHES:
        raise InputError(f"--mesh is {' or '.join(MESHES)}, not {name!r}")


def with_mesh(result: Reconstruction, name: str) -> Reconstruction:
    """Exchange the mesh of a reconstruction for one made in another way.

    Raises
    ------
    InputError
        The way is not known, or the points do not suffice for it.
    """
    check_meshing(name)
    if name == result.meshing:
        return result
    pose = result.estimate.poses or nominal_poses(result.series)
    start = time.perf_counter()
    mesh = poisson_mesh(result.points, pose.rotations[result.series.reference])
    seconds = {**result.seconds, "mesh": time.perf_counter() - start}
    return replace(result, mesh=mesh, meshing=name, seconds=seconds)


def poisson_mesh(points: PointCloud, rotation: Array = CAM_FROM_VIEW, reach: float = 0.75) -> SurfaceMesh:
    """Fit one smooth surface to a cloud.

    Outliers go first. The Poisson surface closes itself where there are no points; what lies farther from the nearest
    point than the spacing there allows is cut off again.

    Parameters
    ----------
    points
        Cloud in the world frame; points that are not finite are left out.
    rotation
        R_cam_from_world of the reference view, (3, 3): normals point against its beam, to the gun.
    reach
        How far a vertex may lie from the nearest point, in distances of that point from its 16th neighbour.

    Returns
    -------
    Mesh in the frame of the points, counter-clockwise as the gun sees it. One thread makes it, so the same cloud gives
    the same bits.

    Raises
    ------
    InputError
        If fewer than 30 points are left, or all lie on a line.
    """
    cloud = points.keep(np.asarray(np.isfinite(points.xyz_um).all(axis=1)))
    xyz = _thinned(without_outliers(cloud, rotation).xyz_um)
    _check(xyz)
    tree = cKDTree(xyz)
    spread = tree.query(xyz, k=NEIGHBOURS + 1)[0][:, -1]
    vertices, faces = _solve(xyz, -rotation[2], _depth(xyz, spread))
    distance, nearest = tree.query(vertices)
    near = distance <= reach * spread[nearest]
    return compact(vertices, faces[near[faces].all(axis=1)])


def _thinned(xyz_um: Array) -> Array:
    """At most MOST_POINTS of the points, in their order."""
    if len(xyz_um) <= MOST_POINTS:
        return xyz_um
    chosen = np.random.default_rng(0).choice(len(xyz_um), MOST_POINTS, replace=False)
    return xyz_um[np.sort(chosen)]


def _check(xyz_um: Array) -> None:
    if len(xyz_um) < LEAST_POINTS:
        raise InputError(f"--mesh poisson needs {LEAST_POINTS} points or more, not {len(xyz_um)}; use --mesh triangles")
    widths = np.linalg.svd(xyz_um - xyz_um.mean(axis=0), compute_uv=False)
    if widths[1] <= 1e-9 * widths[0]:
        raise InputError("--mesh poisson needs points that do not all lie on one line; check the tilts and the matches")


def _depth(xyz_um: Array, spread_um: Array) -> int:
    """Halvings of the cube round the points that lead to the wanted cell."""
    spacing = float(np.median(spread_um)) * math.sqrt(math.pi / NEIGHBOURS)
    cells = float(np.ptp(xyz_um, axis=0).max()) / (CELL_SPACINGS * spacing)
    return int(np.clip(math.ceil(math.log2(max(cells, 1.0))), *DEPTHS))


def _solve(xyz_um: Array, to_gun: Array, depth: int) -> tuple[Array, Array]:
    """Vertices and faces of the Poisson surface, closed where the points end."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz_um))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    cloud.orient_normals_to_align_with_direction(to_gun)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
