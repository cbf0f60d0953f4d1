"""A reticulate pollen grain, after *Brassica rapa*: a net of walls (muri) on columns over pits (lumina) with rods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.implicit import (
    FAR_UM,
    Grid,
    Volume,
    add_rods,
    polygonise,
    roughen,
    sample,
    smooth_min,
    smooth_step,
)
from semsim.specimens.noise import speckle
from semsim.specimens.options import require_positive, require_within
from semsim.specimens.reticulum import Reticulum
from semsim.specimens.scatter import jittered_sphere, unit
from semsim.specimens.substrate import Substrate, mounted

Array = NDArray[np.float64]
Rods = tuple[Array, Array, Array]

_FADE_UM = 2.0  # under the carrier the net gives way to a plain ball over this depth; deeper the grain is cut off


@dataclass(frozen=True)
class Pollen:
    """A grain sunk into its carrier, as photographed at 854 x 640 pixels of 5/34 um.

    The shape is an implicit solid. The distance to the borders of a power diagram on the sphere gives the net; rods are
    welded on for the columns under it (columellae), the free rods in the pits (bacula) and the balls on top
    (orbicules). Walls are narrower below than above and rods stand free, so the surface overhangs. The world origin is
    the frame's centre at the median visible height.

    Parameters
    ----------
    radius_um
        Centre to the top of the muri.
    exposed
        Height of the grain above the carrier in radii.
    lumen_um
        Mean distance between the middles of neighbouring pits.
    lumen_depth_um
        Top of the muri to the bottom of the pits.
    murus_width_um
        Width of the walls at the top.
    bacula_um
        Mean distance between rods.
    roughness_um
        Standard deviation of the fine relief over everything.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Cell of the grid, about the edge length of the triangles; 2 makes a quick, crude grain.
    frame_width_um, frame_height_um
        The frame over which the median height is taken; the carrier is larger.
    """

    name: ClassVar[str] = "pollen"
    radius_um: float = 56.0
    exposed: float = 1.2
    lumen_um: float = 9.5
    lumen_depth_um: float = 5.5
    murus_width_um: float = 2.9
    bacula_um: float = 1.5
    roughness_um: float = 0.12
    contrast: float = 0.05
    grain_um: float = 0.8
    edge_um: float = 0.42
    frame_width_um: float = 125.6
    frame_height_um: float = 94.1

    def __post_init__(self) -> None:
        require_positive(self, "radius_um", "lumen_depth_um", "murus_width_um", "grain_um")
        require_positive(self, "frame_width_um", "frame_height_um")
        require_within(self, "exposed", 0.3, 1.9)
        require_within(self, "edge_um", self.radius_um / 300, self.radius_um / 8)
        require_within(self, "lumen_um", self.radius_um / 50, self.radius_um)
        require_within(self, "lumen_depth_um", 0.0, self.radius_um / 3)
        require_within(self, "bacula_um", self.radius_um / 200, self.radius_um)
        require_within(self, "contrast", 0.0, 1.0)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the grain and its carrier, two watertight bodies."""
        net_rng, rod_rng, rough_rng, carrier_rng, yield_rng = rng.spawn(5)
        grid = self._grid()
        lowest = max(grid.origin_um[2] / (self.radius_um - self.lumen_depth_um), -0.95)
        net = Reticulum.grown(self.radius_um, self.lumen_um, lowest, max(self.edge_um, 0.3), net_rng)
        volume = self._solid(grid, net, rod_rng)
        roughen(volume, grid, self.roughness_um, rough_rng)
        carrier = Substrate(1.5 * self.frame_width_um, 1.6 * self.frame_height_um, max(self.edge_um, 0.6))
        mesh = mounted(
            polygonise(volume, grid), carrier(self._carrier_um, carrier_rng), self.frame_width_um, self.frame_height_um
        )
        return Mesh(mesh.vertices_um, mesh.faces, speckle(mesh.vertices_um, self.contrast, self.grain_um, yield_rng))

    @property
    def _carrier_um(self) -> float:
        """Height of the carrier above the grain's centre."""
        return self.radius_um * (1.0 - self.exposed)

    def _grid(self) -> Grid:
        """Return the grid from a little under the carrier to above the highest ball."""
        reach = self.radius_um + 3.5
        bottom = max(self._carrier_um - 2.5 * _FADE_UM, -reach)
        return Grid.around((-reach, -reach, bottom), (reach, reach, reach), self.edge_um)

    def _solid(self, grid: Grid, net: Reticulum, rng: np.random.Generator) -> Volume:
        """Return the sampled grain: floor and walls, then the rods."""
        volume = sample(grid, lambda z_um: self._layer(grid, net, z_um))
        for rods in self._rods(net, rng):
            add_rods(volume, grid, *rods, blend_um=0.3)
        return volume

    def _layer(self, grid: Grid, net: Reticulum, z_um: float) -> NDArray[np.float32]:
        """Return the distance to floor and walls for one layer of the grid, (nx, ny)."""
        x, y = grid.plane()
        r = np.sqrt(x * x + y * y + z_um * z_um)
        low, high = self.radius_um - self.lumen_depth_um - 3.0, self.radius_um + 3.0
        out = np.where(r < high, -FAR_UM, FAR_UM).astype(np.float32)
        near = (r > low) & (r < high)
        if near.any():
            directions = np.column_stack([x[near], y[near], np.full(int(near.sum()), z_um)]) / r[near, None]
            net_here = self._profile(net.wall(directions), r[near] - net.top(directions))
            plain = r[near] - (self.radius_um - self.lumen_depth_um)
            ornate = smooth_step(-2.0 * _FADE_UM, -_FADE_UM, np.array(z_um - self._carrier_um))
            out[near] = ornate * net_here + (1.0 - ornate) * plain
        return out

    def _profile(self, wall_um: Array, up_um: Array) -> Array:
        """Return the distance to the cross-section of wall and floor: a round-edged beam on a thin web.

        Parameters
        ----------
        wall_um
            (n,) distance from the middle of the wall.
        up_um
            (n,) height above the wall's top.
        """
        half, thick = self.murus_width_um / 2.0, 0.36 * self.murus_width_um
        crown_um = up_um + 0.6 * np.minimum(np.abs(wall_um) / half, 1.5) ** 2
        beam = np.hypot(np.maximum(wall_um - (half - thick), 0.0), crown_um + thick) - thick
        web = np.maximum(wall_um - 0.4 * half, up_um + thick)
        return smooth_min(smooth_min(beam, web, 0.6), up_um + self.lumen_depth_um, 0.8)

    def _rods(self, net: Reticulum, rng: np.random.Generator) -> list[Rods]:
        """Return columns under the walls, free rods and granules in the pits, and balls on the walls."""
        feet = self._places(self.bacula_um, rng)
        wall = net.wall(feet) / (self.murus_width_um / 2.0)
        free = rng.random(len(feet)) < 0.6
        inside = wall > 1.15
        return [
            self._columns(net, feet[wall < 1.0], rng),
            self._bacula(net, feet[inside & free], rng),
            self._granules(net, feet[inside & ~free], rng),
            self._orbicules(net, rng),
        ]

    def _places(self, spacing_um: float, rng: np.random.Generator) -> Array:
        """Return directions about `spacing_um` apart above the carrier, (n, 3)."""
        places = jittered_sphere(self.radius_um, spacing_um, 0.3, rng)
        return places[places[:, 2] * self.radius_um > self._carrier_um - _FADE_UM]

    def _columns(self, net: Reticulum, feet: Array, rng: np.random.Generator) -> Rods:
        """Return columns from the floor into the walls, a little out of plumb."""
        top = net.top(feet)
        radius = rng.uniform(0.32, 0.5, size=(len(feet), 1)) * [[1.1, 1.0]]
        lean = self._leaning(feet, 0.25, rng)
        return feet * (top - self.lumen_depth_um)[:, None], lean * (top - 0.4 * self.murus_width_um)[:, None], radius

    def _bacula(self, net: Reticulum, feet: Array, rng: np.random.Generator) -> Rods:
        """Return rods that end free in the pits, thicker at the head."""
        floor = net.top(feet) - self.lumen_depth_um
        rise = self.lumen_depth_um * rng.uniform(0.15, 0.75, size=len(feet))
        radius = rng.uniform(0.26, 0.4, size=(len(feet), 1)) * [[1.0, 1.4]]
        return feet * floor[:, None], self._leaning(feet, 0.4, rng) * (floor + rise)[:, None], radius

    def _granules(self, net: Reticulum, feet: Array, rng: np.random.Generator) -> Rods:
        """Return balls half sunk into the floor."""
        at = feet * (net.top(feet) - self.lumen_depth_um + 0.2)[:, None]
        return at, at, np.repeat(rng.uniform(0.3, 0.7, size=(len(feet), 1)), 2, axis=1)

    def _orbicules(self, net: Reticulum, rng: np.random.Generator) -> Rods:
        """Return balls that stick to the tops of the walls."""
        places = self._places(2.2, rng)
        places = places[(net.wall(places) < 0.5 * self.murus_width_um) & (rng.random(len(places)) < 0.35)]
        radius = np.minimum(0.35 + rng.exponential(0.18, size=len(places)), 1.1)
        at = places * (net.top(places) - 0.15 + 0.45 * radius)[:, None]
        return at, at, np.column_stack([radius, radius])

    def _leaning(self, feet: Array, lean_um: float, rng: np.random.Generator) -> Array:
        """Return directions moved at random by about `lean_um` on the sphere, (n, 3)."""
        return unit(feet + rng.normal(scale=lean_um / self.radius_um, size=feet.shape))
