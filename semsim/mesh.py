"""The triangle mesh that is photographed: the truth itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A specimen at zero tilt, in the world frame (z up toward the gun).

    Parameters
    ----------
    vertices_um
        (vertices, 3).
    faces
        (faces, 3) vertex indices, counter-clockwise seen from outside.
    vertex_yield
        Relative electron yield of the material at each vertex, (vertices,); None is 1 everywhere.
    """

    vertices_um: Array
    faces: NDArray[np.int32]
    vertex_yield: Array | None = None

    def __post_init__(self) -> None:
        if len(self.faces) == 0:
            raise InputError("a mesh needs at least one triangle; this one has none")
        if not np.isfinite(self.vertices_um).all():
            raise InputError("mesh vertices must be finite numbers of micrometres; some are NaN or infinite")

    @cached_property
    def face_normals(self) -> Array:
        """Unit outward normals, (faces, 3)."""
        a, b, c = (self.vertices_um[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))

    @cached_property
    def vertex_normals(self) -> Array:
        """Unit normals averaged over the faces round a vertex by area, (vertices, 3)."""
        a, b, c = (self.vertices_um[self.faces[:, i]] for i in range(3))
        weighted = np.cross(b - a, c - a)
        total = np.zeros_like(self.vertices_um)
        for corner in range(3):
            for axis in range(3):
                total[:, axis] += np.bincount(self.faces[:, corner], weighted[:, axis], len(total))
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))
