"""Binary PLY files, written by NumPy: points with any properties, and triangles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array

FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])


def write_ply(path: Path, properties: Mapping[str, Array], faces: NDArray[np.int64] | None = None) -> None:
    """Write vertices as 32 bit floats, little endian, and triangles if there are any.

    Parameters
    ----------
    properties
        Columns by name in the order of the file, each (vertices,); x, y and z come first by custom.
    faces
        (faces, 3) vertex indices.
    """
    columns = {name: np.asarray(column, dtype="<f4") for name, column in properties.items()}
    vertices = np.empty(len(next(iter(columns.values()))), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    with path.open("wb") as file:
        file.write(_header(list(columns), len(vertices), faces).encode("ascii"))
        file.write(vertices.tobytes())
        if faces is not None:
            file.write(_triangles(faces).tobytes())


def _header(names: list[str], vertices: int, faces: NDArray[np.int64] | None) -> str:
    lines = ["ply", "format binary_little_endian 1.0", "comment lengths in um, z up", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name in names]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""])


def _triangles(faces: NDArray[np.int64]) -> NDArray[np.void]:
    records = np.empty(len(faces), dtype=FACE)
    records["count"] = 3
    records["vertices"] = faces
    return records
