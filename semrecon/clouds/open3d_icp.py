"""Open3D's three kinds of ICP behind the answer of ours."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from semrecon.clouds.icp import Registration, answer, cloud_positions
from semrecon.data import Array, PointCloud
from semrecon.errors import InputError
from semrecon.numerics.motion import RigidMotion

Open3dKind = Literal["point_to_point", "point_to_plane", "generalized"]


def icp_open3d(
    moving: PointCloud | Array,
    fixed: PointCloud | Array,
    kind: Open3dKind = "point_to_point",
    max_distance_um: float | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-6,
    neighbours: int = 20,
    initial: RigidMotion | None = None,
) -> Registration:
    """Register by one of Open3D's ICPs.

    Parameters
    ----------
    moving, fixed
        Clouds, or (points, 3) arrays in um.
    kind
        ``point_to_point``; ``point_to_plane`` (Chen and Medioni, 1992); ``generalized`` (Segal, 2009: plane to plane).
    max_distance_um
        Pairs further apart are left out; None keeps them all.
    max_iterations, tolerance
        Stop when fitness and inlier RMSE both change by less than the tolerance, relatively.
    neighbours
        Points from which the normal at a fixed point is estimated.
    initial
        First guess of fixed_from_moving; the identity if None.

    Raises
    ------
    InputError
        If a cloud has fewer than three points or points that are not finite, the kind is unknown, or no pair is near.

    Notes
    -----
    The library sums in parallel: expect equal answers to about 1e-9, not equal bits.
    """
    if kind not in get_args(Open3dKind):
        raise InputError(f"kind must be one of {', '.join(get_args(Open3dKind))}, not {kind}")
    start, target = cloud_positions(moving, "moving"), cloud_positions(fixed, "fixed")
    matrix = _matrix(initial or RigidMotion.identity())
    reach = _reach(start, target, matrix) if max_distance_um is None else max_distance_um
    criteria = {"relative_fitness": tolerance, "relative_rmse": tolerance, "max_iteration": max_iterations}
    found = _run(start, target, kind, reach, matrix, neighbours, criteria)
    if not len(found.correspondence_set):
        raise InputError(f"no pair of points is closer than max_distance_um = {reach:g}; give a longer distance")
    motion = RigidMotion(found.transformation[:3, :3].copy(), found.transformation[:3, 3].copy())
    return answer(motion, start, target, None, None, f"open3d {kind}")


def _run(
    moving: Array,
    fixed: Array,
    kind: Open3dKind,
    reach: float,
    matrix: Array,
    neighbours: int,
    criteria: dict[str, Any],
) -> Any:
    """Call the library: its RegistrationResult."""
    import open3d

    library = open3d.pipelines.registration
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz)) for xyz in (moving, fixed)]
    if kind != "point_to_point":
        for cloud in clouds:
            cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbours))
    register, estimation = {
        "point_to_point": (library.registration_icp, library.TransformationEstimationPointToPoint()),
        "point_to_plane": (library.registration_icp, library.TransformationEstimationPointToPlane()),
        "generalized": (library.registration_generalized_icp, library.TransformationEstimationForGeneralizedICP()),
    }[kind]
    return register(*clouds, reach, matrix, estimation, library.ICPConvergenceCriteria(**criteria))


def _matrix(motion: RigidMotion) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.rotation, motion.translation_um
    return matrix


def _reach(moving: Array, fixed: Array, matrix: Array) -> float:
    """Diagonal of the box round both clouds as they start: no pair can be further apart."""
    both = np.concatenate([moving @ matrix[:3, :3].T + matrix[:3, 3], fixed])
    return float(np.linalg.norm(np.ptp(both, axis=0))) + 1e-9
