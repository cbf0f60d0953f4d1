"""Nearest neighbours in point clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semrecon.data import Array


def distances_um(from_um: Array, to_um: Array) -> Array:
    """Distance of every point of one cloud to the nearest point of another, (points,)."""
    distance, _ = cKDTree(to_um).query(from_um)
    return np.asarray(distance)


class NearestNeighbours:
    """Exact nearest neighbours of points that move a little from call to call.

    A point that moved by m since the tree was asked keeps its neighbour while 2 m is less than the gap between its
    nearest and second nearest: no other can have overtaken. Near convergence almost nothing needs asking again.
    """

    def __init__(self, fixed_um: Array) -> None:
        self._tree = cKDTree(fixed_um)
        self._asked_at: Array | None = None

    def __call__(self, xyz_um: Array) -> NDArray[np.int64]:
        """Index of the nearest fixed point of each point, (points,); every call must bring the same points, moved."""
        if self._asked_at is None:
            self._asked_at = np.full_like(xyz_um, np.inf)
            self._index = np.zeros(len(xyz_um), dtype=np.int64)
            self._gap = np.zeros(len(xyz_um))
        moved = np.linalg.norm(xyz_um - self._asked_at, axis=1)
        stale = np.flatnonzero(2 * moved >= self._gap)
        distance, index = self._tree.query(xyz_um[stale], k=2)
        self._asked_at[stale], self._index[stale] = xyz_um[stale], index[:, 0]
        self._gap[stale] = distance[:, 1] - distance[:, 0]
        return self._index
