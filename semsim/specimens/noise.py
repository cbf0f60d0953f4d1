"""Solid noise: a random field of space, the same for the same seed wherever and in whatever order it is asked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The rms of the gradient noise below over space, measured on 4 M points; dividing by it makes `solid_noise` unit rms.
_LATTICE_RMS = 0.1909


def seed_of(rng: np.random.Generator) -> int:
    """Draw one seed for a solid noise, so that a field costs the generator a single number."""
    return int(rng.integers(1, 2**62))


def solid_noise(points_um: Array, grain_um: float, seed: int, octaves: int = 1) -> Array:
    """Return smooth random numbers of mean 0 and rms about 1 at points in space.

    Gradient noise on a cubic lattice (K. Perlin, "Improving noise", 2002), with the lattice gradients from a hash of
    the corner and the seed, so that the field needs no table and has no period that a specimen could show.

    Parameters
    ----------
    points_um
        (points, 3).
    grain_um
        Lattice spacing: features are about this wide.
    octaves
        Each further octave is half as wide and 0.6 as strong.

    Returns
    -------
    (points,), dimensionless.
    """
    points = np.ascontiguousarray(points_um, dtype=np.float64)
    total = np.zeros(len(points))
    weights = 0.6 ** np.arange(octaves)
    for octave, weight in enumerate(weights):
        total += weight * _gradient_noise(points * (2.0**octave / grain_um), np.uint64(seed + octave))
    return np.asarray(total / (_LATTICE_RMS * np.sqrt(np.sum(weights**2))))


def speckle(points_um: Array, contrast: float, grain_um: float, rng: np.random.Generator) -> Array | None:
    """Return the relative electron yield of a speckled material, or None where the contrast is 0.

    Parameters
    ----------
    points_um
        (vertices, 3).
    contrast
        Standard deviation of the yield about 1, as a fraction; the yield is kept within 3 of them and above 0.05.
    grain_um
        Width of the coarser of two octaves of speckle.

    Returns
    -------
    (vertices,), dimensionless, or None.
    """
    seed = seed_of(rng)  # drawn in any case: switching the texture off must not change the shape
    if contrast == 0:
        return None
    deviation = np.clip(solid_noise(points_um, grain_um, seed, octaves=2), -3.0, 3.0)
    return np.maximum(1.0 + contrast * deviation, 0.05)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _hash(i: int, j: int, k: int, seed: int) -> Any:
    """Mix a lattice corner and a seed into 64 bits (the finaliser of SplitMix64, once per coordinate)."""
    h = uint64(seed)
    for value in (i, j, k):
        h = (h ^ uint64(value)) * uint64(0xBF58476D1CE4E5B9) + uint64(0x9E3779B97F4A7C15)
        h = (h ^ (h >> uint64(30))) * uint64(0x94D049BB133111EB)
        h ^= h >> uint64(31)
    return h


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _corner(i: int, j: int, k: int, x: float, y: float, z: float, seed: int) -> Any:
    """Return the ramp of one lattice corner: a hashed gradient in the cube [-1, 1]^3 times the offset."""
    h = _hash(i, j, k, seed)
    scale = 2.0 / 2097151.0
    gx = (h & uint64(0x1FFFFF)) * scale - 1.0
    gy = ((h >> uint64(21)) & uint64(0x1FFFFF)) * scale - 1.0
    gz = ((h >> uint64(42)) & uint64(0x1FFFFF)) * scale - 1.0
    return gx * x + gy * y + gz * z


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _gradient_noise(points: Array, seed: int) -> Array:
    """Blend the ramps of the eight corners round each point by the quintic fade."""
    out = np.empty(len(points))
    for n in range(len(points)):
        base = np.floor(points[n])
        fx, fy, fz = points[n] - base
        i, j, k = int(base[0]), int(base[1]), int(base[2])
        total = 0.0
        for corner in range(8):
            di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
            weight = 1.0
            for offset, d in ((fx, di), (fy, dj), (fz, dk)):
                fade = offset * offset * offset * (offset * (offset * 6.0 - 15.0) + 10.0)
                weight *= fade if d else 1.0 - fade
            total += weight * _corner(i + di, j + dj, k + dk, fx - di, fy - dj, fz - dk, seed)
        out[n] = total
    return out
