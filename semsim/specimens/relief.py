"""Fine relief laid over a finished mesh: its vertices move along their normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.noise import seed_of, solid_noise

Array = NDArray[np.float64]


def roughened(
    vertices_um: Array, faces: NDArray[np.int32], roughness_um: float, width_um: float, rng: np.random.Generator
) -> Array:
    """Return the vertices (n, 3) moved in and out at random, by two layers of solid noise.

    Parameters
    ----------
    roughness_um
        Standard deviation of the finer layer; well below its width, or the surface could cut itself. 0 moves nothing.
    width_um
        Of the finer layer. The coarser is 3.5 times as wide and as strong.
    """
    fine, coarse = seed_of(rng), seed_of(rng)
    if roughness_um == 0:
        return vertices_um
    relief = solid_noise(vertices_um, width_um, fine) + 3.5 * solid_noise(vertices_um, 3.5 * width_um, coarse)
    return np.asarray(vertices_um + roughness_um * relief[:, None] * Mesh(vertices_um, faces).vertex_normals)
