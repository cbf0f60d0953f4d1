"""What the beam meets at each pixel of a view, before any electron is counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world, pixel_grid, pixel_rays
from semsim.raycast import RayCaster

Backend = Literal["raycast", "pyrender"]
BACKENDS: tuple[str, ...] = get_args(Backend)


@dataclass(frozen=True, eq=False)
class SurfaceBuffer:
    """The surface under each pixel of one view.

    Parameters
    ----------
    depth_um
        (rows, columns) X_cam_z, growing along the beam; NaN where the beam misses the mesh.
    position_um
        (rows, columns, 3) world; NaN for a miss.
    normal
        (rows, columns, 3) unit outward normal, world, interpolated between the normals of the triangle's corners;
        NaN for a miss.
    face
        (rows, columns) triangle index, -1 for a miss.
    """

    depth_um: Array
    position_um: Array
    normal: Array
    face: NDArray[np.int32]

    @property
    def miss(self) -> NDArray[np.bool_]:
        """True where the beam meets nothing, (rows, columns)."""
        return np.asarray(self.face < 0)


def surface_buffer(
    mesh: Mesh,
    microscope: Microscope,
    pose: Pose,
    backend: Backend = "raycast",
    *,
    beam_px: Array | None = None,
) -> SurfaceBuffer:
    """Find the surface under every pixel of a view.

    Parameters
    ----------
    backend
        "raycast": exact, any projection, any beam positions. "pyrender": OpenGL, parallel projection on the pixel
        grid only, depth to about 1e-6 of the mesh's extent.
    beam_px
        Where the beam is for each pixel, (rows, columns, 2); None is the undisturbed `pixel_grid`.

    Raises
    ------
    InputError
        The mesh reaches the pivot of a perspective scan, or pyrender is asked for what it cannot do.
    """
    if microscope.working_distance_um is not None:
        _require_below_pivot(mesh, microscope.working_distance_um, pose)
    if backend == "pyrender":
        from semsim.raster import rasterise

        if beam_px is not None:
            raise InputError("backend pyrender draws the regular pixel grid only; use raycast for displaced beams")
        depth, face = rasterise(mesh, microscope, pose)
    elif backend == "raycast":
        rays = pixel_rays(microscope, pose, pixel_grid(microscope) if beam_px is None else beam_px)
        hits = RayCaster(mesh).cast(*rays)
        depth, face = hits.distance, hits.face
    else:
        raise InputError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    return buffer_from_depth(mesh, microscope, pose, depth, face, beam_px=beam_px)


def buffer_from_depth(
    mesh: Mesh,
    microscope: Microscope,
    pose: Pose,
    depth_um: Array,
    face: NDArray[np.int32],
    *,
    beam_px: Array | None = None,
) -> SurfaceBuffer:
    """Complete a buffer from depth and triangle, (rows, columns) each: position along the ray, then the normal."""
    origins, directions = pixel_rays(microscope, pose, pixel_grid(microscope) if beam_px is None else beam_px)
    position = origins + depth_um[..., None] * directions
    smooth = interpolate(mesh, mesh.vertex_normals, face, position)
    # Opposite corner normals can cancel on a folded mesh; the triangle's own normal is then the honest answer.
    length = np.linalg.norm(smooth, axis=-1, keepdims=True)
    smooth = np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), mesh.face_normals[face])
    smooth[face < 0] = np.nan
    return SurfaceBuffer(depth_um, position, smooth, face)


def interpolate(mesh: Mesh, vertex_values: Array, face: NDArray[np.int32], position_um: Array) -> Array:
    """Interpolate values given at vertices linearly over the triangles.

    Parameters
    ----------
    vertex_values
        (vertices,) or (vertices, channels).
    face, position_um
        (...,) triangle, -1 for none, and (..., 3) point on it.

    Returns
    -------
    (...,) or (..., channels); NaN where there is no triangle.
    """
    answer = np.full(face.shape + vertex_values.shape[1:], np.nan)
    hit = face >= 0
    corners = mesh.faces[face[hit]]
    weights = barycentric(mesh, face[hit], position_um[hit])
    answer[hit] = sum(
        (vertex_values[corners[:, k]].T * weights[:, k] for k in range(1, 3)),
        start=vertex_values[corners[:, 0]].T * weights[:, 0],
    ).T
    return answer


def barycentric(mesh: Mesh, face: NDArray[np.int32], position_um: Array) -> Array:
    """Weights (n, 3) of a triangle's corners at points (n, 3) on it, by Cramer's rule; within 0 and 1, sum 1."""
    a, b, c = (mesh.vertices_um[mesh.faces[face, k]] for k in range(3))
    ab, ac, ap = b - a, c - a, position_um - a
    bb, bc, cc = (np.einsum("ij,ij->i", u, v) for u, v in ((ab, ab), (ab, ac), (ac, ac)))
    pb, pc = (np.einsum("ij,ij->i", ap, v) for v in (ab, ac))
    area = np.maximum(bb * cc - bc * bc, 1e-300)
    weights = np.stack([np.zeros_like(area), (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area], axis=1)
    weights[:, 0] = 1 - weights[:, 1] - weights[:, 2]
    weights = np.clip(weights, 0.0, 1.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _require_below_pivot(mesh: Mesh, working_distance_um: float, pose: Pose) -> None:
    top = camera_from_world(pose, mesh.vertices_um)[:, 2].min()
    if top <= -working_distance_um:
        raise InputError(
            f"working_distance_um = {working_distance_um} is too short: the specimen rises {-top:.4g} um to the gun"
        )
