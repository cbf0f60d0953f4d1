"""A broken sandstone: rounded grains at rest on one another, cemented where they touch, with open pores between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.implicit import Grid, Volume, polygonise, sample
from semsim.specimens.noise import speckle
from semsim.specimens.options import require_not_negative, require_positive, require_within
from semsim.specimens.packing import Polyhedra, settled
from semsim.specimens.relief import roughened
from semsim.specimens.substrate import visible_median_um

Array = NDArray[np.float64]

_MARGIN = 1.22  # the bed over the frame: room for tilt
_FLOOR_UM = 0.4  # thickness of the floor in grain radii


@dataclass(frozen=True)
class Grains:
    """A bed of grains, one watertight body with overhangs and pores; nothing is seen through it.

    Parameters
    ----------
    diameter_um
        Median diameter of the grains; a medium sand has 250 to 500 um, a very fine one 60 to 125 um.
    sorting
        Standard deviation of the logarithm of the diameter: 0 makes all alike, 0.3 is well sorted.
    layers
        Thickness of the bed in median diameters.
    roundness
        0 is angular, 1 a pebble.
    cement_um
        Width of the fillets where grains touch.
    fines
        Share of the bed that crumbs a tenth the size of the grains would cover, seen from above.
    roughness_um
        Standard deviation of the fine relief of the grain faces, 0.06 of the median diameter wide and above.
    mineral_contrast
        Standard deviation of the electron yield from grain to grain, as a fraction.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Cell of the grid, about the edge length of the triangles; 20 makes a quick, crude bed.
    frame_width_um, frame_height_um
        The frame over which the median height is taken; the bed is larger.
    """

    name: ClassVar[str] = "grains"
    diameter_um: float = 150.0
    sorting: float = 0.25
    layers: float = 1.9
    roundness: float = 0.4
    cement_um: float = 9.0
    fines: float = 0.12
    roughness_um: float = 0.35
    mineral_contrast: float = 0.08
    contrast: float = 0.05
    grain_um: float = 6.0
    edge_um: float = 3.6
    frame_width_um: float = 1024.8
    frame_height_um: float = 768.0

    def __post_init__(self) -> None:
        require_positive(self, "diameter_um", "grain_um", "frame_width_um", "frame_height_um")
        require_not_negative(self, "cement_um", "roughness_um")
        require_within(self, "sorting", 0.0, 0.6)
        require_within(self, "layers", 1.0, 6.0)
        for share in ("roundness", "fines", "mineral_contrast", "contrast"):
            require_within(self, share, 0.0, 1.0)
        require_within(self, "edge_um", self.frame_width_um / 600, self.diameter_um / 5)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the bed, a watertight body."""
        pack_rng, cut_rng, crumb_rng, rough_rng, mineral_rng, yield_rng = rng.spawn(6)
        middles, radii = self._packed(pack_rng)
        grid = self._grid(float((middles[:, 2] + 1.2 * radii).max()))
        volume = self._floor(grid)
        Polyhedra.cut(middles, 1.14 * radii, self.roundness, cut_rng).weld(volume, grid, self.cement_um)
        self._crumbs(volume, grid, crumb_rng).weld(volume, grid, 0.3 * self.edge_um)
        vertices_um, faces = polygonise(volume, grid)
        vertices_um = roughened(vertices_um, faces, self.roughness_um, 0.06 * self.diameter_um, rough_rng)
        texture = _product(
            speckle(vertices_um, self.contrast, self.grain_um, yield_rng),
            self._minerals(vertices_um, middles, radii, mineral_rng),
        )
        vertices_um[:, 2] -= visible_median_um(vertices_um, faces, self.frame_width_um, self.frame_height_um)
        return Mesh(vertices_um, faces, texture)

    @property
    def _bed_um(self) -> tuple[float, float]:
        """Extent of the bed along x and y."""
        grow = 0.5 * self.diameter_um
        return _MARGIN * self.frame_width_um + grow, _MARGIN * self.frame_height_um + grow

    def _packed(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the balls that the grains are cut from: middles (grains, 3) and radii (grains,)."""
        width, height = self._bed_um
        median = self.diameter_um / 2
        mean_volume = 4 / 3 * np.pi * median**3 * np.exp(4.5 * self.sorting**2)  # of a lognormal radius
        count = max(int(0.56 * width * height * self.layers * self.diameter_um / mean_volume), 1)
        spread = np.clip(rng.normal(size=count), -2.5, 2.0)
        radii = np.minimum(median * np.exp(self.sorting * spread), 0.45 * min(width, height))
        return settled(radii, width, height, tries=1000, rng=rng), radii

    def _grid(self, top_um: float) -> Grid:
        """Return the grid round the bed; it cuts the floor from below."""
        width, height = self._bed_um
        aside = 0.15 * self.diameter_um + self.cement_um + 4 * self.edge_um
        bottom = -_FLOOR_UM * self.diameter_um / 2
        low = (-width / 2 - aside, -height / 2 - aside, bottom)
        return Grid.around(low, (-low[0], -low[1], top_um + self.cement_um + 4 * self.edge_um), self.edge_um)

    def _floor(self, grid: Grid) -> Volume:
        """Return the solid floor under the bed, a box with its top at z = 0."""
        width, height = self._bed_um
        x, y = grid.plane()
        side = np.maximum(np.abs(x) - width / 2, np.abs(y) - height / 2)
        return sample(grid, lambda z_um: np.maximum(side, z_um))

    def _crumbs(self, volume: Volume, grid: Grid, rng: np.random.Generator) -> Polyhedra:
        """Return small angular grains that lie on what the beam sees from above."""
        width, height = self._bed_um
        typical = 0.04 * self.diameter_um
        count = int(self.fines * width * height / (np.pi * typical**2 * np.exp(0.5)))
        radii = np.minimum(typical * np.exp(0.5 * rng.normal(size=count)), 4 * typical)
        places = rng.uniform(-0.5, 0.5, (count, 2)) * (width - 8 * typical, height - 8 * typical)
        i, j = np.rint((places.T - np.array(grid.origin_um[:2])[:, None]) / grid.edge_um).astype(np.intp)
        column = volume[i, j, ::-1] < 0
        top = grid.axis(2)[volume.shape[2] - 1 - column.argmax(axis=1)]
        rests = column.any(axis=1)
        middles = np.column_stack([places, top + 0.3 * radii])[rests]
        return Polyhedra.cut(middles, radii[rests], 0.3 * self.roundness, rng)

    def _minerals(self, vertices_um: Array, middles: Array, radii: Array, rng: np.random.Generator) -> Array | None:
        """Return the yield of the grain that each vertex belongs to, (vertices,); None where all are alike."""
        from scipy.spatial import cKDTree

        deviation = np.clip(rng.normal(size=len(radii)), -2.5, 2.5)
        if self.mineral_contrast == 0:
            return None
        away, near = cKDTree(middles).query(vertices_um, k=[1, 2, 3, 4][: len(radii)])
        nearest = np.argmin(away - radii[near], axis=1)
        own = np.take_along_axis(near, nearest[:, None], axis=1)[:, 0]
        return np.asarray(np.maximum(1.0 + self.mineral_contrast * deviation[own], 0.05))


def _product(first: Array | None, second: Array | None) -> Array | None:
    """Return the product of two textures; None is 1 everywhere."""
    if first is None or second is None:
        return second if first is None else first
    return first * second
