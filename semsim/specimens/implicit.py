"""Implicit solids on a grid of samples, and the closed mesh of their surface.

A solid is a signed distance, negative inside, sampled at the corners of cubic cells. Only its zero matters, so that far
from the surface any number of the right sign and of at least a cell or two will do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semsim.specimens.noise import seed_of, solid_noise

Array = NDArray[np.float64]
Volume = NDArray[np.float32]

FAR_UM = 3.0  # stands for "outside, not near" wherever the distance is not worked out


@dataclass(frozen=True)
class Grid:
    """Corners of cubic cells: axes x, y, z in order, from `origin_um` on.

    Parameters
    ----------
    origin_um
        The first corner.
    shape
        Number of corners along each axis.
    edge_um
        Side of a cell, which is also about the edge length of the triangles.
    """

    origin_um: tuple[float, float, float]
    shape: tuple[int, int, int]
    edge_um: float

    @classmethod
    def around(cls, low_um: tuple[float, float, float], high_um: tuple[float, float, float], edge_um: float) -> Grid:
        """Return the smallest grid that starts at the low corner and reaches the high one."""
        cells = [int(np.ceil((high - low) / edge_um)) for low, high in zip(low_um, high_um, strict=True)]
        return cls(low_um, (cells[0] + 1, cells[1] + 1, cells[2] + 1), edge_um)

    def axis(self, which: int) -> Array:
        """Return the coordinates of the corners along one axis in um."""
        return np.asarray(self.origin_um[which] + self.edge_um * np.arange(self.shape[which], dtype=np.float64))

    def plane(self) -> tuple[Array, Array]:
        """Return x and y of the corners of one layer, each of the shape (nx, ny)."""
        x, y = np.meshgrid(self.axis(0), self.axis(1), indexing="ij")
        return x, y


def sample(grid: Grid, layer: Callable[[float], NDArray[np.floating]]) -> Volume:
    """Stack the layers of a solid: `layer(z_um)` gives (nx, ny) signed distances in um."""
    volume = np.empty(grid.shape, dtype=np.float32)
    for k, z_um in enumerate(grid.axis(2)):
        volume[:, :, k] = layer(float(z_um))
    return volume


def smooth_min(a: Array, b: Array, blend_um: float) -> Array:
    """Return the union of two solids, filleted where their distances differ by less than `blend_um`."""
    overlap = np.maximum(blend_um - np.abs(a - b), 0.0)
    return np.asarray(np.minimum(a, b) - overlap**2 / (4.0 * blend_um))


def smooth_max(a: Array, b: Array, blend_um: float) -> Array:
    """Return the common part of two solids with a rounded edge."""
    return -smooth_min(-a, -b, blend_um)


def smooth_step(low: float, high: float, x: Array) -> Array:
    """Rise from 0 at `low` to 1 at `high` without a kink."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def add_rods(volume: Volume, grid: Grid, start_um: Array, end_um: Array, radius_um: Array, blend_um: float) -> None:
    """Weld round-ended rods onto a solid, in place; a rod whose ends coincide is a ball.

    Parameters
    ----------
    start_um, end_um
        (rods, 3) ends of the axes.
    radius_um
        (rods, 2) at the two ends; it changes evenly between them.
    blend_um
        Width of the fillet where a rod meets the solid.
    """
    _add_rods(
        volume,
        np.array(grid.origin_um),
        grid.edge_um,
        np.ascontiguousarray(start_um, dtype=np.float64),
        np.ascontiguousarray(end_um, dtype=np.float64),
        np.ascontiguousarray(radius_um, dtype=np.float64),
        blend_um,
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _add_rods(
    volume: Volume, origin: Array, edge: float, start: Array, end: Array, radius: Array, blend: float
) -> None:
    """Visit, rod by rod, the corners of its bounding box (the distance to a capsule, then `smooth_min`)."""
    for n in range(len(start)):
        a, axis = start[n], end[n] - start[n]
        length2 = max((axis * axis).sum(), 1e-12)
        reach = max(radius[n, 0], radius[n, 1]) + blend + edge  # one cell more: the zero is found between corners
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for c in range(3):
            low[c] = max(int(np.ceil((min(a[c], end[n, c]) - reach - origin[c]) / edge)), 0)
            high[c] = min(int(np.floor((max(a[c], end[n, c]) + reach - origin[c]) / edge)) + 1, volume.shape[c])
        for i in range(low[0], high[0]):
            px = origin[0] + edge * i - a[0]
            for j in range(low[1], high[1]):
                py = origin[1] + edge * j - a[1]
                for k in range(low[2], high[2]):
                    pz = origin[2] + edge * k - a[2]
                    t = min(max((px * axis[0] + py * axis[1] + pz * axis[2]) / length2, 0.0), 1.0)
                    dx, dy, dz = px - t * axis[0], py - t * axis[1], pz - t * axis[2]
                    away = np.sqrt(dx * dx + dy * dy + dz * dz)
                    rod = away - (radius[n, 0] + t * (radius[n, 1] - radius[n, 0]))
                    old = volume[i, j, k]
                    overlap = max(blend - abs(rod - old), 0.0)
                    volume[i, j, k] = min(rod, old) - overlap * overlap / (4.0 * blend)


def roughen(volume: Volume, grid: Grid, roughness_um: float, rng: np.random.Generator) -> None:
    """Move the surface in and out at random, in place: two layers of solid noise, 1.0 and 3.5 um wide.

    Parameters
    ----------
    roughness_um
        Standard deviation of the finer layer; the coarser has twice as much.
    """
    fine, coarse = seed_of(rng), seed_of(rng)
    for k, z_um in enumerate(grid.axis(2)):
        i, j = np.nonzero(np.abs(volume[:, :, k]) < 0.8)  # farther off the noise could not reach the surface
        points = np.column_stack([grid.axis(0)[i], grid.axis(1)[j], np.full(len(i), z_um)])
        relief = solid_noise(points, 1.0, fine) + 2.0 * solid_noise(points, 3.5, coarse)
        volume[i, j, k] += (roughness_um * relief).astype(np.float32)


def polygonise(volume: Volume, grid: Grid) -> tuple[Array, NDArray[np.int32]]:
    """Return the surface where a solid's distance is zero, closed where the grid cuts the solid from below.

    Marching cubes (T. Lewiner and others, 2003). A solid may leave the grid through its lowest layer only; each outline
    there is closed by a fan of triangles, so that the mesh is watertight.

    Returns
    -------
    vertices_um, faces
        (vertices, 3) and (faces, 3), counter-clockwise seen from outside.
    """
    from skimage.measure import marching_cubes

    exact = np.abs(volume) < 1e-4 * grid.edge_um  # a zero at a corner would make triangles without area
    volume = np.where(exact, np.float32(1e-4 * grid.edge_um), volume)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, gradient_direction="descent")
    vertices_um = vertices.astype(np.float64) * grid.edge_um + np.array(grid.origin_um)
    return close_bottom(vertices_um, faces.astype(np.int32))


def close_bottom(vertices_um: Array, faces: NDArray[np.int32]) -> tuple[Array, NDArray[np.int32]]:
    """Close each open outline at the lowest height of a mesh with a fan of triangles about its middle."""
    low = vertices_um[:, 2] <= vertices_um[:, 2].min()
    edges = np.concatenate([faces[low[faces[:, a]] & low[faces[:, b]]][:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    edges = edges[~_has_reverse(edges.astype(np.int64), len(vertices_um))]
    if len(edges) == 0:
        return vertices_um, faces
    outline, middles = _outline_of(edges, vertices_um)
    apex = (len(vertices_um) + outline).astype(np.int32)
    fan = np.column_stack([edges[:, 1], edges[:, 0], apex])
    return np.vstack([vertices_um, middles]), np.vstack([faces, fan]).astype(np.int32)


def _has_reverse(edges: NDArray[np.int64], vertex_count: int) -> NDArray[np.bool_]:
    """Tell for each directed edge whether it is there the other way round too, (edges,)."""
    forward = edges[:, 0] * vertex_count + edges[:, 1]
    return np.isin(forward, edges[:, 1] * vertex_count + edges[:, 0])


def _outline_of(edges: NDArray[np.int32], vertices_um: Array) -> tuple[NDArray[np.int64], Array]:
    """Return which outline each edge belongs to, (edges,), and the middle of each outline, (outlines, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corners, position = np.unique(edges, return_inverse=True)
    ends = position.reshape(edges.shape)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(corners), len(corners)))
    count, label = connected_components(graph, directed=False)
    loop = label[ends[:, 0]]
    sizes = np.bincount(loop, minlength=count)
    start = vertices_um[edges[:, 0]]
    middles = np.column_stack([np.bincount(loop, start[:, axis], count) / sizes for axis in range(3)])
    return loop, middles
