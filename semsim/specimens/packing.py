"""Grains under gravity: where balls come to rest on one another, and the rounded polyhedra that take their places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semsim.specimens.implicit import Grid, Volume
from semsim.specimens.scatter import unit

Array = NDArray[np.float64]

_PLANES = 16


def settled(radii_um: Array, width_um: float, height_um: float, tries: int, rng: np.random.Generator) -> Array:
    """Drop balls one by one into a box with floor z = 0, each at the lowest of some places, (balls, 3) middles.

    A ball falls straight and stops where it first touches a ball or the floor. Taking the lowest of `tries` random
    places stands for rolling: many tries pack densely.

    Parameters
    ----------
    radii_um
        (balls,).
    width_um, height_um
        The box along x and y, about the origin; every ball stays inside.
    """
    middles = np.empty((len(radii_um), 3))
    for n, radius in enumerate(radii_um):
        room = np.maximum(np.array([width_um, height_um]) / 2 - radius, 0.0)
        places = rng.uniform(-1.0, 1.0, (tries, 2)) * room
        z_um = _resting(places, radius, middles[:n], radii_um[:n])
        lowest = int(np.argmin(z_um))
        middles[n] = *places[lowest], z_um[lowest]
    return middles


def _resting(places: Array, radius: float, middles: Array, radii: Array) -> Array:
    """Return the height at which the middle of a falling ball stops over each place (n, 2), (n,)."""
    if len(middles) == 0:
        return np.full(len(places), radius)
    apart2 = np.sum((places[:, None] - middles[None, :, :2]) ** 2, axis=2)
    rise2 = (radius + radii) ** 2 - apart2
    touch = np.where(rise2 > 0, middles[:, 2] + np.sqrt(np.maximum(rise2, 0.0)), radius)
    return np.asarray(np.maximum(touch.max(axis=1), radius))


@dataclass(frozen=True)
class Polyhedra:
    """Convex grains, each cut out of space by planes, with rounded edges.

    Parameters
    ----------
    middle_um
        (grains, 3).
    reach_um
        (grains,) radius of a ball about the middle that holds the grain.
    normal
        (grains, planes, 3) outward.
    distance_um
        (grains, planes) from the middle to each plane.
    rounding_um
        (grains,) width over which neighbouring planes run into each other.
    """

    middle_um: Array
    reach_um: Array
    normal: Array
    distance_um: Array
    rounding_um: Array

    @classmethod
    def cut(cls, middle_um: Array, radius_um: Array, roundness: float, rng: np.random.Generator) -> Polyhedra:
        """Cut one grain out of each ball (grains, 3) and (grains,): a little flattened, corners kept in the ball.

        Parameters
        ----------
        roundness
            0 is sharp-edged, 1 a pebble.
        """
        count = len(middle_um)
        normal = unit(rng.normal(size=(count * _PLANES, 3))).reshape(count, _PLANES, 3)
        flat = unit(rng.normal(size=(count, 3)))
        along = np.abs(np.einsum("npc,nc->np", normal, flat))
        distance = radius_um[:, None] * rng.uniform(0.78, 1.0, (count, _PLANES)) * (1.0 - 0.22 * along)
        return cls(middle_um, 1.12 * radius_um, normal, distance, (0.04 + 0.5 * roundness) * radius_um)

    def weld(self, volume: Volume, grid: Grid, cement_um: float) -> None:
        """Weld the grains onto a solid, in place, with fillets `cement_um` wide where they touch it and each other."""
        origin = np.array(grid.origin_um)
        _weld(
            volume, origin, grid.edge_um, self.middle_um, self.reach_um, self.normal, self.distance_um,
            self.rounding_um, max(cement_um, 1e-6),
        )  # fmt: skip


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _weld(
    volume: Volume,
    origin: Array,
    edge: float,
    middle: Array,
    reach: Array,
    normal: Array,
    distance: Array,
    rounding: Array,
    cement: float,
) -> None:
    """Visit, grain by grain, the corners of its bounding box; far outside the ball that holds it nothing changes."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(middle)):
        wide = reach[n] + cement + 2.0 * edge
        for c in range(3):
            low[c] = max(int(np.ceil((middle[n, c] - wide - origin[c]) / edge)), 0)
            high[c] = min(int(np.floor((middle[n, c] + wide - origin[c]) / edge)) + 1, volume.shape[c])
        for i in range(low[0], high[0]):
            x = origin[0] + edge * i - middle[n, 0]
            for j in range(low[1], high[1]):
                y = origin[1] + edge * j - middle[n, 1]
                for k in range(low[2], high[2]):
                    z = origin[2] + edge * k - middle[n, 2]
                    ball = np.sqrt(x * x + y * y + z * z) - reach[n]
                    if ball > cement + 2.0 * edge:
                        continue
                    grain = _polyhedron(x, y, z, ball, normal[n], distance[n], rounding[n])
                    old = volume[i, j, k]
                    overlap = max(cement - abs(grain - old), 0.0)
                    volume[i, j, k] = min(grain, old) - overlap * overlap / (4.0 * cement)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _polyhedron(x: float, y: float, z: float, ball: float, normal: Array, distance: Array, rounding: float) -> float:
    """Return the distance to a rounded polyhedron inside a ball: a `smooth_max` over the planes."""
    far = ball
    for p in range(len(distance)):
        plane = normal[p, 0] * x + normal[p, 1] * y + normal[p, 2] * z - distance[p]
        overlap = max(rounding - abs(plane - far), 0.0)
        far = max(plane, far) + overlap * overlap / (4.0 * rounding)
    return far
