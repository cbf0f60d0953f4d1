"""The net on a pollen grain: how far each direction is from the nearest wall, and how high the walls stand there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semsim.specimens.noise import seed_of, solid_noise
from semsim.specimens.scatter import spaced_sphere, unit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reticulum:
    """Maps over the upper part of a sphere, in Lambert's azimuthal equal-area projection about the pole.

    Parameters
    ----------
    radius_um
        Radius of the sphere.
    step_um
        Pixel of the maps.
    wall_um
        (n, n) distance along the sphere to the middle of the nearest wall.
    swell_um
        (n, n) height of the wall tops above `radius_um`.
    """

    radius_um: float
    step_um: float
    wall_um: Array
    swell_um: Array

    @classmethod
    def grown(
        cls, radius_um: float, lumen_um: float, lowest: float, step_um: float, rng: np.random.Generator
    ) -> Reticulum:
        """Grow a net of pits about `lumen_um` apart over all directions whose z is above `lowest` (a cosine)."""
        reach = radius_um * np.sqrt(2.0 * (1.0 - lowest)) + 2.0 * step_um
        half = int(np.ceil(reach / step_um))
        axis = np.linspace(-half * step_um, half * step_um, 2 * half + 1)
        directions = _direction(axis[:, None], axis[None, :], radius_um)
        points = radius_um * directions.reshape(-1, 3)
        swell = 0.7 * np.clip(solid_noise(points, 22.0, seed_of(rng)), -2.0, 2.0)
        walls = _wall_distance(points + _warp(points, rng), radius_um, lumen_um, rng)
        shape = directions.shape[:2]
        return cls(radius_um, step_um, walls.reshape(shape), swell.reshape(shape))

    def wall(self, directions: Array) -> Array:
        """Return the distance to the middle of the nearest wall for unit vectors (n, 3), (n,) um."""
        return self._look_up(self.wall_um, directions)

    def top(self, directions: Array) -> Array:
        """Return the distance from the centre to the wall tops for unit vectors (n, 3), (n,) um."""
        return self.radius_um + self._look_up(self.swell_um, directions)

    def _look_up(self, values: Array, directions: Array) -> Array:
        from scipy.ndimage import map_coordinates

        stretch = np.sqrt(2.0 / np.maximum(1.0 + directions[:, 2], 1e-9)) * self.radius_um / self.step_um
        place = stretch * directions[:, :2].T + (len(values) - 1) / 2.0
        return np.asarray(map_coordinates(values, place, order=1, mode="nearest"))


def _direction(x_um: Array, y_um: Array, radius_um: float) -> Array:
    """Return the unit vectors that the projection sends to map points; beyond the far pole, the far pole."""
    x, y = np.broadcast_arrays(x_um / radius_um, y_um / radius_um)
    q = np.minimum(x * x + y * y, 4.0)
    shrink = np.sqrt(1.0 - q / 4.0)
    return np.stack([shrink * x, shrink * y, 1.0 - q / 2.0], axis=-1)


def _warp(points_um: Array, rng: np.random.Generator) -> Array:
    """Return displacements that make straight borders wander, (n, 3) um."""
    return np.column_stack([0.8 * solid_noise(points_um, 9.0, seed_of(rng)) for _ in range(3)])


def _wall_distance(points_um: Array, radius_um: float, lumen_um: float, rng: np.random.Generator) -> Array:
    """Return the distance to the nearest border of a power diagram of unequal darts, corners rounded, (n,) um."""
    from scipy.spatial import cKDTree

    size = lumen_um / radius_um
    directions, dart = spaced_sphere((0.28 * size, 0.58 * size), tries=int(60 / size**2), rng=rng)
    middles, weight = radius_um * directions, (radius_um * dart) ** 2
    points_um = radius_um * unit(points_um)
    away, near = cKDTree(middles).query(points_um, k=9)
    power = away**2 - weight[near]
    order = np.argsort(power, axis=1)
    power, near = (np.take_along_axis(values, order, axis=1) for values in (power, near))
    between = np.linalg.norm(middles[near[:, 1:]] - middles[near[:, :1]], axis=2)
    border = (power[:, 1:] - power[:, :1]) / (2.0 * between)
    rounding = 0.9  # um; a soft minimum: pits become ovals, junctions broad
    return np.asarray(-rounding * np.log(np.sum(np.exp(-border / rounding), axis=1)))
