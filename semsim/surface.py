"""What the beam meets at each pixel of a view, before any electron is counted.

Three ways lead to depth and triangle; position and normal are then worked out alike, in float64, for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world, pixel_grid, pixel_rays
from semsim.raycast import RayCaster, linear_beam

Backend = Literal["auto", "zbuffer", "raycast", "pyrender"]
BACKENDS: tuple[str, ...] = get_args(Backend)
ON_THE_GRID = np.empty((0, 0, 2))
"""Beam positions of nowhere: every beam is where its pixel is."""


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
        NaN for a miss. Outward is the side of the triangle that the beam meets, however its corners are ordered.
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
    backend: Backend = "auto",
    *,
    beam_px: Array | None = None,
) -> SurfaceBuffer:
    """Find the surface under every pixel of a view.

    Parameters
    ----------
    backend
        "raycast": the reference; any projection, any beam positions. "zbuffer": our own rasteriser, many times faster
        and as exact; parallel projection on the pixel grid only. "pyrender": OpenGL, with the same bounds, depth to
        about 1e-6 of the mesh's extent. "auto": zbuffer where it can, raycast elsewhere.
    beam_px
        Where the beam is for each pixel, (rows, columns, 2); None is the undisturbed `pixel_grid`.

    Raises
    ------
    InputError
        The mesh reaches the pivot of a perspective scan, or a rasteriser is asked for what it cannot do.
    """
    if microscope.working_distance_um is not None:
        _require_below_pivot(mesh, microscope.working_distance_um, pose)
    if backend == "auto":
        backend = "zbuffer" if beam_px is None and microscope.working_distance_um is None else "raycast"
    if backend not in BACKENDS:
        raise InputError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    if backend != "raycast" and beam_px is not None:
        raise InputError(f"backend {backend} draws the regular pixel grid only; use raycast for displaced beams")
    depth, face = _search(mesh, microscope, pose, backend, beam_px)
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
    beams = ON_THE_GRID if beam_px is None else np.ascontiguousarray(beam_px, dtype=np.float64)
    origin, direction = linear_beam(microscope, pose)
    shape = (mesh.vertices_um, mesh.faces, mesh.vertex_normals, mesh.face_normals)
    position, normal = (np.empty((*face.shape, 3)) for _ in range(2))
    in_bands(
        len(face),
        lambda top, bottom: _complete(top, bottom, depth_um, face, beams, origin, direction, *shape, position, normal),
    )
    return SurfaceBuffer(depth_um, position, normal, face)


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


def _search(
    mesh: Mesh, microscope: Microscope, pose: Pose, backend: Backend, beam_px: Array | None
) -> tuple[Array, NDArray[np.int32]]:
    """Depth and triangle, (rows, columns) each, in the way asked for."""
    if backend == "zbuffer":
        from semsim.zbuffer import rasterise

        return rasterise(mesh, microscope, pose)
    if backend == "pyrender":
        from semsim.raster import rasterise as draw

        return draw(mesh, microscope, pose)
    hits = RayCaster(mesh).cast(*pixel_rays(microscope, pose, pixel_grid(microscope) if beam_px is None else beam_px))
    return hits.distance, hits.face


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _complete(
    top: int,
    bottom: int,
    depth: Array,
    face: NDArray[np.int32],
    beams: Array,
    origin: Array,
    direction: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    vertex_normals: Array,
    face_normals: Array,
    position: Array,
    normal: Array,
) -> None:  # pragma: no cover - compiled
    at, to_b, to_c = np.empty(3), np.empty(3), np.empty(3)
    a = b = c = last = -1
    for row in range(top, bottom):
        for column in range(depth.shape[1]):
            f = face[row, column]
            if f < 0:
                position[row, column] = np.nan
                normal[row, column] = np.nan
                continue
            if f != last:
                a, b, c, last = faces[f, 0], faces[f, 1], faces[f, 2], f
                _barycentric_gradients(vertices[a], vertices[b], vertices[c], to_b, to_c)
            x, y = float(column), float(row)
            if beams.size > 0:
                x, y = beams[row, column, 0], beams[row, column, 1]
            weight_b = weight_c = along = 0.0
            for k in range(3):
                way = direction[0, k] + x * direction[1, k] + y * direction[2, k]
                along += way * face_normals[f, k]
                at[k] = origin[0, k] + x * origin[1, k] + y * origin[2, k] + depth[row, column] * way
                weight_b += (at[k] - vertices[a, k]) * to_b[k]
                weight_c += (at[k] - vertices[a, k]) * to_c[k]
            weight_a = max(0.0, 1.0 - weight_b - weight_c)
            weight_b, weight_c = max(0.0, weight_b), max(0.0, weight_c)
            squared = 0.0
            for k in range(3):
                position[row, column, k] = at[k]
                at[k] = (
                    weight_a * vertex_normals[a, k] + weight_b * vertex_normals[b, k] + weight_c * vertex_normals[c, k]
                )
                squared += at[k] * at[k]
            # Opposite corner normals can cancel on a folded mesh; the triangle's own normal is then the honest answer.
            # A mesh that is inside out is met from behind: its normals are turned round.
            length, side = np.sqrt(squared), -1.0 if along > 0 else 1.0
            for k in range(3):
                normal[row, column, k] = side * (at[k] / length if length > 1e-6 else face_normals[f, k])


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _barycentric_gradients(
    a: Array, b: Array, c: Array, to_b: Array, to_c: Array
) -> None:  # pragma: no cover - compiled
    """Vectors whose products with ``point - a`` are the weights of b and c, by Cramer's rule as in `barycentric`."""
    bb = bc = cc = 0.0
    for k in range(3):
        bb += (b[k] - a[k]) * (b[k] - a[k])
        bc += (b[k] - a[k]) * (c[k] - a[k])
        cc += (c[k] - a[k]) * (c[k] - a[k])
    area = max(bb * cc - bc * bc, 1e-300)
    for k in range(3):
        to_b[k] = (cc * (b[k] - a[k]) - bc * (c[k] - a[k])) / area
        to_c[k] = (bb * (c[k] - a[k]) - bc * (b[k] - a[k])) / area


def _require_below_pivot(mesh: Mesh, working_distance_um: float, pose: Pose) -> None:
    top = camera_from_world(pose, mesh.vertices_um)[:, 2].min()
    if top <= -working_distance_um:
        raise InputError(
            f"working_distance_um = {working_distance_um} is too short: the specimen rises {-top:.4g} um to the gun"
        )
