"""The carrier under a specimen, and the specimen placed on it with the origin where the conventions want it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.noise import seed_of, solid_noise
from semsim.specimens.sheet import Faces, slab

Array = NDArray[np.float64]
Part = tuple[Array, Faces]


@dataclass(frozen=True)
class Substrate:
    """The carrier under a specimen: flat, finely rough, with drops and crumbs of 1 to 3 um.

    Parameters
    ----------
    width_um, height_um
        Extent along x and y, about the origin.
    edge_um
        Grid spacing.
    coarseness
        Factor on the size of drops, crumbs and relief, for specimens much smaller or larger than a pollen grain.
    """

    width_um: float = 190.0
    height_um: float = 160.0
    edge_um: float = 0.6
    coarseness: float = 1.0

    def __call__(self, level_um: float, rng: np.random.Generator) -> tuple[Array, Faces]:
        """Return a closed slab whose upper face lies about `level_um`: (vertices, 3) and (faces, 3)."""
        x_um = np.linspace(-self.width_um / 2, self.width_um / 2, max(int(self.width_um / self.edge_um), 2))
        y_um = np.linspace(-self.height_um / 2, self.height_um / 2, max(int(self.height_um / self.edge_um), 2))
        x, y = np.meshgrid(x_um, y_um, indexing="ij")
        points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) / self.coarseness
        rough = 0.5 * solid_noise(points, 25.0, seed_of(rng)) + 0.06 * solid_noise(points, 2.0, seed_of(rng), octaves=2)
        relief = rough.reshape(x.shape) + self._drops(x_um / self.coarseness, y_um / self.coarseness, rng)
        z_um = level_um + self.coarseness * relief
        return slab(x_um, y_um, z_um, thickness_um=5.0)

    def _drops(self, x_um: Array, y_um: Array, rng: np.random.Generator) -> Array:
        """Return the heights of round drops over a carrier of coarseness 1, many small and few large, (nx, ny)."""
        z_um = np.zeros((len(x_um), len(y_um)))
        width, height = self.width_um / self.coarseness, self.height_um / self.coarseness
        count = int(width * height / 30.0)
        places = rng.uniform(-0.5, 0.5, size=(count, 2)) * (width, height)
        radii = np.minimum(0.7 * rng.pareto(2.5, size=count) + 0.6, 3.0)
        for (cx, cy), radius in zip(places, radii, strict=True):
            i = slice(*np.searchsorted(x_um, (cx - radius, cx + radius)))
            j = slice(*np.searchsorted(y_um, (cy - radius, cy + radius)))
            inside = 1.0 - ((x_um[i, None] - cx) ** 2 + (y_um[None, j] - cy) ** 2) / radius**2
            z_um[i, j] = np.maximum(z_um[i, j], 0.8 * radius * np.sqrt(np.maximum(inside, 0.0)))
        return z_um


def visible_median_um(vertices_um: Array, faces: Faces, width_um: float, height_um: float) -> float:
    """Return the median height of what is seen from above in a frame about the origin.

    Sampled at 256 columns and as many rows as make square cells; where nothing is seen nothing counts. A frame that
    shows nothing at all has the mesh's own median.
    """
    step_um = width_um / 256
    rows = max(round(height_um / step_um), 1)
    # half a thousandth off the middle: sample points should not fall on the edges of a regular mesh
    origin = np.array([-0.5 * width_um, -0.5 * rows * step_um]) + 0.5005 * step_um
    top = np.full((256, rows), -np.inf)
    _raise_to(top, vertices_um, faces, origin, step_um)
    seen = top[np.isfinite(top)]
    return float(np.median(seen if len(seen) else vertices_um[:, 2]))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _raise_to(top: Array, vertices: Array, faces: Faces, origin: Array, step: float) -> None:
    """Raise each sample point to the highest face over it, in place: a depth buffer seen from above."""
    for n in range(len(faces)):
        a, b, c = vertices[faces[n, 0]], vertices[faces[n, 1]], vertices[faces[n, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        first_i = max(int(np.ceil((min(a[0], b[0], c[0]) - origin[0]) / step)), 0)
        first_j = max(int(np.ceil((min(a[1], b[1], c[1]) - origin[1]) / step)), 0)
        last_i = min(int(np.floor((max(a[0], b[0], c[0]) - origin[0]) / step)), top.shape[0] - 1)
        last_j = min(int(np.floor((max(a[1], b[1], c[1]) - origin[1]) / step)), top.shape[1] - 1)
        for i in range(first_i, last_i + 1):
            for j in range(first_j, last_j + 1):
                x, y = origin[0] + step * i, origin[1] + step * j
                u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
                v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
                if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
                    top[i, j] = max(top[i, j], a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]))


def joined(parts: Sequence[Part]) -> Part:
    """Put closed bodies into one list of vertices and one of faces, unwelded."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices_um = np.vstack([vertices for vertices, _ in parts])
    return vertices_um, np.vstack([faces + start for (_, faces), start in zip(parts, first[:-1], strict=True)]).astype(
        np.int32
    )


def mounted(specimen: Part, carrier: Part, width_um: float, height_um: float) -> Mesh:
    """Put two closed bodies into one mesh, unwelded, and bring the median visible height of the frame to 0."""
    vertices_um, faces = joined([specimen, carrier])
    vertices_um[:, 2] -= visible_median_um(vertices_um, faces, width_um, height_um)
    return Mesh(vertices_um, faces)
