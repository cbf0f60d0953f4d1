"""Ray casting: the reference way from a beam position to the specimen, exact in float64.

Embree (in Open3D) works in float32. It only chooses the triangle; where on it the ray lands is worked out again in
float64, so that the truth carries no rounding of the search.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, pixel_rays

RAYS_AT_ONCE = 1 << 18
"""Bounds the working memory to some tens of megabytes."""


@dataclass(frozen=True, eq=False)
class Hits:
    """First hit of each ray.

    Parameters
    ----------
    face
        (...,) index of the triangle, -1 for a miss.
    distance
        (...,) in lengths of the ray's direction, measured from its origin; NaN for a miss.
    position_um
        (..., 3) world; NaN for a miss.
    """

    face: NDArray[np.int32]
    distance: Array
    position_um: Array


@dataclass(frozen=True, eq=False)
class RayCaster:
    """Cast rays at one mesh.

    Rays are whole lines, entering from outside the mesh: what lies "behind" an origin is hit too.
    """

    mesh: Mesh

    def cast(self, origins_um: Array, directions: Array) -> Hits:
        """Find the first hit of each ray.

        Parameters
        ----------
        origins_um, directions
            (..., 3) each, world frame; a NaN ray misses. Directions need not have unit length.
        """
        shape = origins_um.shape[:-1]
        origins, directions = origins_um.reshape(-1, 3), np.broadcast_to(directions, origins_um.shape).reshape(-1, 3)
        face = np.full(len(origins), -1, dtype=np.int32)
        distance = np.full(len(origins), np.nan)
        for start in range(0, len(origins), RAYS_AT_ONCE):
            band = slice(start, start + RAYS_AT_ONCE)
            face[band], distance[band] = self._cast_band(origins[band], directions[band])
        position = origins + distance[:, None] * directions
        return Hits(face.reshape(shape), distance.reshape(shape), position.reshape(*shape, 3))

    def _cast_band(self, origins: Array, directions: Array) -> tuple[NDArray[np.int32], Array]:
        centre, radius = bounding_sphere(self.mesh)
        rays, distance = np.empty((len(origins), 6), dtype=np.float32), np.empty(len(origins))
        in_bands(len(rays), lambda i, j: _enter(i, j, origins, directions, centre, radius, rays, distance))
        answer = search_tree(self.mesh).cast_rays(tensor(rays, np.float32))
        face = answer["primitive_ids"].numpy().astype(np.int32)  # the "none" of Open3D, 2**32 - 1, becomes -1
        face[np.isnan(distance)] = -1
        distance += answer["t_hit"].numpy()
        mesh = self.mesh.vertices_um, self.mesh.faces
        in_bands(len(rays), lambda i, j: _refine(i, j, face, origins, directions, *mesh, distance))
        return face, distance


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _enter(
    begin: int,
    end: int,
    origins: Array,
    directions: Array,
    centre: Array,
    radius: float,
    rays: NDArray[np.float32],
    start: Array,
) -> None:  # pragma: no cover - compiled
    """Let rays start just outside the bounding sphere, where float32 is finest; those with NaN come to nothing."""
    for i in range(begin, end):
        squared = along = 0.0
        for k in range(3):
            squared += directions[i, k] * directions[i, k]
            along += (centre[k] - origins[i, k]) * directions[i, k]
        start[i] = along / squared - 1.01 * radius / np.sqrt(squared)
        if not np.isfinite(start[i]):
            start[i] = np.nan
        for k in range(3):
            usable = start[i] == start[i]
            rays[i, k] = origins[i, k] + start[i] * directions[i, k] - centre[k] if usable else 0.0
            rays[i, 3 + k] = directions[i, k] if usable else 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _refine(
    begin: int,
    end: int,
    face: NDArray[np.int32],
    origins: Array,
    directions: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    distance: Array,
) -> None:  # pragma: no cover - compiled
    """Turn float32 distances into those to the plane of the triangle, in float64, kept inside its own range.

    A point inside a triangle is a convex sum of its corners, so its distance along the ray lies between those of the
    corners' feet on the ray. Only rays that graze or meet an edge need that bound.
    """
    a, b, c, u, v = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(begin, end):
        f = face[i]
        if f < 0:
            distance[i] = np.nan
            continue
        squared = foot_a = foot_b = foot_c = above = towards = 0.0
        for k in range(3):
            way = directions[i, k]
            a[k] = vertices[faces[f, 0], k] - origins[i, k]
            b[k] = vertices[faces[f, 1], k] - origins[i, k]
            c[k] = vertices[faces[f, 2], k] - origins[i, k]
            u[k], v[k] = b[k] - a[k], c[k] - a[k]
            squared += way * way
            foot_a += a[k] * way
            foot_b += b[k] * way
            foot_c += c[k] * way
        for k in range(3):
            normal = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3]
            above += normal * a[k]
            towards += normal * directions[i, k]
        plane = above / towards
        if not np.isfinite(plane):
            plane = distance[i]
        distance[i] = max(min(foot_a, foot_b, foot_c) / squared, min(plane, max(foot_a, foot_b, foot_c) / squared))


def linear_beam(microscope: Microscope, pose: Pose) -> tuple[Array, Array]:
    """Coefficients of `pixel_rays`, whose origins and directions are linear functions of the position in the image.

    Returns
    -------
    origin_um, direction
        (3, 3) each, world frame; the ray of (x, y) has ``origin[0] + x origin[1] + y origin[2]``, and so its direction.
    """
    far = 4096.0  # a power of two, which divides without rounding
    at = np.array([[0.0, 0.0], [far, 0.0], [0.0, far]])
    return tuple(  # type: ignore[return-value]
        np.stack([ray[0], (ray[1] - ray[0]) / far, (ray[2] - ray[0]) / far]) for ray in pixel_rays(microscope, pose, at)
    )


def bounding_sphere(mesh: Mesh) -> tuple[Array, float]:
    """Centre (3,) and radius, um, of a sphere round the mesh's box."""
    low, high = mesh.vertices_um.min(axis=0), mesh.vertices_um.max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


@lru_cache(maxsize=2)
def search_tree(mesh: Mesh) -> Any:
    """Build Open3D's ray-casting scene of a mesh, its `bounding_sphere` moved to 0 to keep float32 coordinates small.

    The last two are kept: a million triangles take seconds, and every caster of the same mesh shares one.
    """
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    centred = mesh.vertices_um - bounding_sphere(mesh)[0]
    scene.add_triangles(tensor(centred, np.float32), tensor(mesh.faces, np.uint32))
    return scene


def tensor(values: NDArray[Any], kind: type[np.generic]) -> Any:
    """Hand an array to Open3D as numbers of one kind."""
    import open3d

    contiguous = np.ascontiguousarray(values, dtype=kind)
    return open3d.core.Tensor.from_numpy(contiguous)
