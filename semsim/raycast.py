"""Ray casting: the reference way from a beam position to the specimen, exact in float64.

Embree (in Open3D) works in float32. It only chooses the triangle; where on it the ray lands is worked out again in
float64, so that the truth carries no rounding of the search.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Array, Mesh

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
        face, coarse = self._search(origins, directions)
        hit = face >= 0
        distance = np.full(len(face), np.nan)
        distance[hit] = self._refine(face[hit], origins[hit], directions[hit], coarse[hit])
        return face, distance

    def _search(self, origins: Array, directions: Array) -> tuple[NDArray[np.int32], Array]:
        """Triangle and float32 distance. Rays start just outside the bounding sphere, where float32 is finest."""
        centre, radius = bounding_sphere(self.mesh)
        squared = np.einsum("ij,ij->i", directions, directions)
        start = np.einsum("ij,ij->i", centre - origins, directions) / squared - 1.01 * radius / np.sqrt(squared)
        rays = np.concatenate([origins + start[:, None] * directions - centre, directions], axis=1)
        usable = np.isfinite(rays).all(axis=1)
        answer = search_tree(self.mesh).cast_rays(tensor(np.where(usable[:, None], rays, 0.0), np.float32))
        face = answer["primitive_ids"].numpy().astype(np.int32)  # the "none" of Open3D, 2**32 - 1, becomes -1
        face[~usable] = -1
        return face, start + answer["t_hit"].numpy()

    def _refine(self, face: NDArray[np.int32], origins: Array, directions: Array, coarse: Array) -> Array:
        """Distance to the plane of the triangle, in float64, kept inside the triangle's own range.

        A point inside a triangle is a convex sum of its corners, so its distance along the ray lies between those
        of the corners' feet on the ray. Only rays that graze or meet an edge need that bound.
        """
        corners = [self.mesh.vertices_um[self.mesh.faces[face, k]] - origins for k in range(3)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = np.einsum("ij,ij->i", normal, corners[0]) / np.einsum("ij,ij->i", normal, directions)
        plane = np.where(np.isfinite(plane), plane, coarse)
        squared = np.einsum("ij,ij->i", directions, directions)
        feet = np.stack([np.einsum("ij,ij->i", corner, directions) / squared for corner in corners])
        return np.asarray(np.clip(plane, feet.min(axis=0), feet.max(axis=0)))


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
