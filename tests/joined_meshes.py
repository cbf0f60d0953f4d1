"""Meshes put together from parts, for tests of what lies over, under and inside them."""

import numpy as np

from semsim.mesh import Mesh


def together(*meshes: Mesh) -> Mesh:
    """All parts as one mesh, their triangles one after the other."""
    first = np.cumsum([0, *(len(mesh.vertices_um) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first, strict=False)])
    return Mesh(np.concatenate([mesh.vertices_um for mesh in meshes]), faces.astype(np.int32))


def sheet(z: float = 0.0, width: float = 60.0) -> Mesh:
    """An open level sheet at a height, from -width to width, um, along both sides."""
    corners = [(-width, -width, z), (width, -width, z), (width, width, z), (-width, width, z)]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def inside_out(mesh: Mesh) -> Mesh:
    """The same mesh with its triangles turned."""
    return Mesh(mesh.vertices_um, np.ascontiguousarray(mesh.faces[:, ::-1]))
