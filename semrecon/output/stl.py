"""Binary STL files: triangles alone, as printers, CAD and mesh programs take them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semrecon.data import Array, SurfaceMesh

TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
HEADER = b"Binary STL; lengths in um, z up"
"""STL has no field for the unit. The header must not begin with the word that marks the text form."""


def write_stl(path: Path, mesh: SurfaceMesh) -> None:
    """Write a mesh in um: 80 bytes of header, the number of triangles, 50 bytes a triangle, little endian.

    Parameters
    ----------
    mesh
        Counter-clockwise faces; a face without area gets the normal 0, as the format has it for unknown.
    """
    corners = mesh.vertices_um[mesh.faces]
    records = np.zeros(len(mesh.faces), dtype=TRIANGLE)
    records["normal"] = unit_normals(corners)
    records["corners"] = corners
    with path.open("wb") as file:
        file.write(HEADER.ljust(80))
        file.write(np.uint32(len(records)).astype("<u4").tobytes())
        file.write(records.tobytes())


def unit_normals(corners: Array) -> Array:
    """Compute unit normals of triangles with corners (faces, 3, 3), counter-clockwise; 0 where there is no area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(np.divide(normal, length, out=np.zeros_like(normal), where=length > 0))
