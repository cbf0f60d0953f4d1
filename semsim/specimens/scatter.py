"""Points strewn over a sphere or a disc, evenly but not regularly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def jittered_sphere(radius_um: float, spacing_um: float, jitter: float, rng: np.random.Generator) -> Array:
    """Return unit directions about `spacing_um` apart on a sphere: a Fibonacci spiral, each point moved at random.

    Parameters
    ----------
    jitter
        Standard deviation of the move in spacings; 0.3 hides the spiral.

    Returns
    -------
    (points, 3) unit vectors.
    """
    count = max(int(4 * np.pi * (radius_um / spacing_um) ** 2), 12)
    n = np.arange(count) + 0.5
    z = 1.0 - 2.0 * n / count
    angle = n * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    points = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    points += rng.normal(scale=jitter * spacing_um / radius_um, size=points.shape)
    return unit(points)


def spaced_sphere(exclusion: tuple[float, float], tries: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Throw darts of unequal size at the unit sphere and keep those that touch none before them.

    Parameters
    ----------
    exclusion
        Smallest and largest radius of a dart in radians; each draws its own between them.
    tries
        Darts thrown.

    Returns
    -------
    directions, radius
        (darts, 3) unit vectors and (darts,) radians.
    """
    points = unit(rng.normal(size=(tries, 3)))
    radius = rng.uniform(*exclusion, size=tries)
    kept = np.empty(tries, dtype=np.intp)
    count = 0
    for n in range(tries):
        others = kept[:count]
        nearest = np.sum((points[others] - points[n]) ** 2, axis=1) >= (radius[others] + radius[n]) ** 2
        if nearest.all():
            kept[count] = n
            count += 1
    return points[kept[:count]], radius[kept[:count]]


def jittered_disc(radius_um: float, spacing_um: float, jitter: float, rng: np.random.Generator) -> Array:
    """Return points of a hexagonal lattice inside a disc about the origin, each moved at random, (points, 2) in um."""
    rows = int(np.ceil(radius_um / (spacing_um * np.sqrt(0.75)))) + 1
    i, j = np.meshgrid(np.arange(-2 * rows, 2 * rows + 1), np.arange(-rows, rows + 1))
    lattice = np.column_stack([(i + 0.5 * (j % 2)).ravel(), (np.sqrt(0.75) * j).ravel()]) * spacing_um
    lattice = lattice + rng.normal(scale=jitter * spacing_um, size=lattice.shape)
    return np.asarray(lattice[np.hypot(lattice[:, 0], lattice[:, 1]) < radius_um])


def unit(vectors: Array) -> Array:
    """Return vectors divided by their length, (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
