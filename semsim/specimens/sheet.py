"""Surfaces z(x, y) on a grid of columns, and the slab that closes one from below."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semsim.specimens.implicit import close_bottom

Array = NDArray[np.float64]
Faces = NDArray[np.int32]


def sheet(
    x_um: Array, y_um: Array, z_um: Array, other_diagonal: NDArray[np.bool_] | None = None
) -> tuple[Array, Faces]:
    """Return the open mesh of heights over the crossings of two rising axes, seen from above.

    Parameters
    ----------
    x_um, y_um
        (nx,) and (ny,). A repeated value of x makes an upright wall between the two columns of heights.
    z_um
        (nx, ny).
    other_diagonal
        (nx - 1, ny - 1) cells that are cut from high x and low y to low x and high y; None cuts all the other way.

    Returns
    -------
    vertices_um, faces
        (nx ny, 3) and (2 (nx - 1) (ny - 1), 3).
    """
    x, y = np.meshgrid(x_um, y_um, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), z_um.ravel()])
    corner = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel(), corner[:-1, 1:].ravel()
    if other_diagonal is not None:
        turned = other_diagonal.ravel()
        a, b, c, d = (np.where(turned, p, q) for p, q in ((b, a), (c, b), (d, c), (a, d)))
    return vertices, np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def welded(vertices_um: Array, faces: Faces) -> tuple[Array, Faces]:
    """Return a mesh with vertices at one and the same place made one, and the faces that this collapses left out."""
    places, position = np.unique(vertices_um, axis=0, return_inverse=True)
    faces = position.ravel()[faces].astype(np.int32)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return places, faces[whole]


def slab(
    x_um: Array, y_um: Array, z_um: Array, thickness_um: float, other_diagonal: NDArray[np.bool_] | None = None
) -> tuple[Array, Faces]:
    """Return the closed mesh of a sheet: upright sides, and a flat bottom `thickness_um` below its lowest point."""
    vertices, faces = sheet(x_um, y_um, z_um, other_diagonal)
    corner = np.arange(z_um.size, dtype=np.int32).reshape(z_um.shape)
    # counter-clockwise seen from above, each corner once
    rim = np.concatenate([corner[:-1, 0], corner[-1, :-1], corner[:0:-1, -1], corner[0, :0:-1]])
    foot = vertices[rim].copy()
    foot[:, 2] = z_um.min() - thickness_um
    low = len(vertices) + np.arange(len(rim), dtype=np.int32)
    after, low_after = np.roll(rim, -1), np.roll(low, -1)
    sides = np.vstack([np.column_stack([rim, low, low_after]), np.column_stack([rim, low_after, after])])
    return close_bottom(np.vstack([vertices, foot]), np.vstack([faces, sides]))
