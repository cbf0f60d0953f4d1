"""The valve of a centric diatom, after *Coscinodiscus*: a domed disc of areolae with sieve floors, and a rim."""

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
    smooth_max,
    smooth_min,
)
from semsim.specimens.noise import seed_of, solid_noise, speckle
from semsim.specimens.options import require_positive, require_within
from semsim.specimens.scatter import jittered_disc
from semsim.specimens.substrate import Substrate, mounted

Array = NDArray[np.float64]
Rods = tuple[Array, Array, Array]

_ABOVE_UM, _CARRIER_RELIEF_UM = 2.2, 1.5


@dataclass(frozen=True)
class Diatom:
    """A valve lying on its carrier, as photographed at 2560 x 1920 pixels of 5/60 um.

    The shape is an implicit solid in flattened coordinates (height above the undulating valve face), bent into place
    after it is polygonised. Each areola is a chamber wider than its mouth, so its lip overhangs, and its floor is a
    sieve of pits. The world origin is the frame's centre at the median visible height.

    Parameters
    ----------
    radius_um
        Of the valve at the rim.
    dome_um
        Height of the middle over the rim.
    undulation_um
        Standard deviation of the valve face about the dome.
    mantle_um
        Height of the upright rim over the carrier.
    pitch_um
        Distance between neighbouring areolae.
    mouth_um, chamber_um
        Radius of an areola at its mouth and of the chamber below it.
    areola_depth_um
        Valve face to sieve floor.
    sieve_um
        Radius of the pits in the floor.
    roughness_um
        Standard deviation of the fine relief over everything.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Cell of the grid, about the edge length of the triangles; 2 makes a quick, crude valve.
    frame_width_um, frame_height_um
        The frame over which the median height is taken; the carrier is larger.
    """

    name: ClassVar[str] = "diatom"
    radius_um: float = 78.0
    dome_um: float = 9.0
    undulation_um: float = 1.2
    mantle_um: float = 9.0
    pitch_um: float = 4.2
    mouth_um: float = 1.15
    chamber_um: float = 1.6
    areola_depth_um: float = 2.4
    sieve_um: float = 0.3
    roughness_um: float = 0.07
    contrast: float = 0.04
    grain_um: float = 0.7
    edge_um: float = 0.33
    frame_width_um: float = 213.4
    frame_height_um: float = 160.1

    def __post_init__(self) -> None:
        require_positive(self, "radius_um", "mantle_um", "pitch_um", "mouth_um", "chamber_um", "areola_depth_um")
        require_positive(self, "sieve_um", "grain_um", "frame_width_um", "frame_height_um")
        require_within(self, "edge_um", self.radius_um / 700, self.radius_um / 8)
        require_within(self, "pitch_um", self.radius_um / 200, self.radius_um / 3)
        require_within(self, "areola_depth_um", 0.0, self.mantle_um)
        require_within(self, "contrast", 0.0, 1.0)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the valve and its carrier, two watertight bodies."""
        face_rng, areola_rng, rod_rng, rough_rng, carrier_rng, yield_rng = rng.spawn(6)
        grid = self._grid()
        volume = self._solid(grid, Areolae.arranged(self, grid, areola_rng))
        for rods in (self._spines(rod_rng), self._granules(rod_rng)):
            add_rods(volume, grid, *rods, blend_um=0.2)
        roughen(volume, grid, self.roughness_um, rough_rng)
        bent_um, faces = polygonise(volume, grid)
        bent_um[:, 2] += self._face(bent_um, seed_of(face_rng))
        carrier = Substrate(1.5 * self.frame_width_um, 1.4 * self.frame_height_um, max(self.edge_um, 0.7))
        mesh = mounted(
            (bent_um, faces), carrier(-self.mantle_um, carrier_rng), self.frame_width_um, self.frame_height_um
        )
        return Mesh(mesh.vertices_um, mesh.faces, speckle(mesh.vertices_um, self.contrast, self.grain_um, yield_rng))

    def _grid(self) -> Grid:
        """Return the flattened grid: the valve face is its plane 0."""
        reach = self.radius_um + 2.0
        return Grid.around(
            (-reach, -reach, -self.mantle_um - _CARRIER_RELIEF_UM), (reach, reach, _ABOVE_UM), self.edge_um
        )

    def _face(self, points_um: Array, seed: int) -> Array:
        """Return the height of the valve face over the flat plane at (n, 3) points, (n,) um; 0 at the rim."""
        inward = np.maximum(1.0 - (points_um[:, 0] ** 2 + points_um[:, 1] ** 2) / self.radius_um**2, 0.0)
        level = np.column_stack([points_um[:, :2], np.zeros(len(points_um))])
        return np.asarray(inward * (self.dome_um + self.undulation_um * solid_noise(level, 30.0, seed)))

    def _solid(self, grid: Grid, areolae: Areolae) -> Volume:
        """Return the sampled valve: a disc with a rounded, ribbed rim, less its areolae."""
        x, y = grid.plane()
        r, angle = np.hypot(x, y), np.arctan2(y, x)
        ribs = int(2.0 * np.pi * self.radius_um / 1.6)
        ribbed = 0.18 * np.cos(ribs * angle)
        lip = 0.8 * np.exp(-(((r - self.radius_um + 1.6) / 0.9) ** 2))

        def layer(z_um: float) -> NDArray[np.floating]:
            mantle = r - self.radius_um - ribbed * min(max(-z_um - 0.8, 0.0), 1.0)
            body = smooth_max(mantle, z_um - lip - areolae.relief_um, 1.2)
            return np.clip(smooth_max(body, -areolae.hollow(z_um), 0.4), -FAR_UM, FAR_UM)

        return sample(grid, layer)

    def _spines(self, rng: np.random.Generator) -> Rods:
        """Return a ring of short, tube-like processes inside the rim, some broken off."""
        count = int(2.0 * np.pi * self.radius_um / 5.5)
        angle = (np.arange(count) + rng.normal(scale=0.12, size=count)) * 2.0 * np.pi / count
        angle = angle[rng.random(count) < 0.85]
        ring = self.radius_um - 1.6
        foot = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), np.zeros(len(angle))])
        radius = rng.uniform(0.35, 0.5, size=(len(angle), 1)) * np.array([1.3, 0.8])
        rise = rng.normal((0.0, 0.0, 1.4), (0.15, 0.15, 0.1), size=foot.shape)
        return foot, foot + rise, radius

    def _granules(self, rng: np.random.Generator) -> Rods:
        """Return small balls on the valve face, dense in some places and rare in others."""
        places = jittered_disc(self.radius_um - 3.0, 1.7, 0.3, rng)
        at = np.column_stack([places, np.zeros(len(places))])
        dense = 0.25 + 0.2 * solid_noise(at, 18.0, seed_of(rng))
        at = at[rng.random(len(at)) < dense]
        radius = np.minimum(0.3 + rng.exponential(0.14, size=len(at)), 1.2)
        at[:, 2] = 0.3 * radius
        return at, at, np.column_stack([radius, radius])


@dataclass(frozen=True)
class Areolae:
    """The hollows of a valve, as maps over the flattened grid.

    Parameters
    ----------
    away_um
        (nx, ny) distance to the middle of the nearest areola.
    mouth_um, chamber_um, floor_um
        (nx, ny) radius of its mouth and chamber, and height of its floor.
    sieve_um
        (nx, ny) distance to the nearest pit of the sieve, negative inside.
    relief_um
        (nx, ny) height of the valve face over its plane: ridges between the areolae and a low collar round each mouth.
    """

    away_um: Array
    mouth_um: Array
    chamber_um: Array
    floor_um: Array
    sieve_um: Array
    relief_um: Array

    @classmethod
    def arranged(cls, valve: Diatom, grid: Grid, rng: np.random.Generator) -> Areolae:
        """Set the areolae on a lattice that wanders a little, smaller toward the rim, none in the middle."""
        from scipy.spatial import cKDTree

        middles = cls._middles(valve, rng)
        count = len(middles)
        rim = np.hypot(*middles.T) / valve.radius_um
        size = (1.1 - 0.35 * rim**2) * rng.normal(1.0, 0.08, size=count)
        floor = -valve.areola_depth_um * np.where(rng.random(count) < 0.07, 0.35, rng.uniform(0.8, 1.1, size=count))
        pits = jittered_disc(valve.radius_um, 2.9 * valve.sieve_um, 0.08, rng)
        x, y = grid.plane()
        plane = np.column_stack([x.ravel(), y.ravel()])
        (away, second), near = (values.T for values in cKDTree(middles).query(plane, k=2))
        pit = cKDTree(pits).query(plane)[0] - valve.sieve_um
        mouth = valve.mouth_um * size[near[0]]
        collar = 0.2 * np.exp(-(((away - mouth - 0.4) / 0.3) ** 2))
        ridge = 0.45 * np.exp(-(((second - away) / 0.9) ** 2))
        maps = (away, mouth, valve.chamber_um * size[near[0]], floor[near[0]], pit, collar + ridge)
        return cls(*(values.reshape(x.shape) for values in maps))

    @staticmethod
    def _middles(valve: Diatom, rng: np.random.Generator) -> Array:
        """Return a hexagonal lattice with rows that wander, (areolae, 2) um; none in the middle and near the rim."""
        middles = jittered_disc(valve.radius_um + 5.0, valve.pitch_um, 0.07, rng)
        level = np.column_stack([middles, np.zeros(len(middles))])
        wander = np.column_stack([solid_noise(level, 28.0, seed_of(rng)) for _ in range(2)])
        middles = middles + 0.25 * valve.pitch_um * wander
        r = np.hypot(*middles.T)
        return np.asarray(middles[(r > 0.8 * valve.pitch_um) & (r < valve.radius_um - 3.5)])

    def hollow(self, z_um: float) -> Array:
        """Return the signed distance to mouths, chambers and sieve pits at one height, (nx, ny); negative inside."""
        neck = -0.55
        chamber = np.maximum(self.away_um - self.chamber_um, np.maximum(z_um - neck, self.floor_um - z_um))
        mouth = np.maximum(self.away_um - self.mouth_um, neck - 0.3 - z_um)
        pits = np.maximum(self.sieve_um, np.maximum(z_um - self.floor_um - 0.2, self.floor_um - 0.9 - z_um))
        pits = np.maximum(pits, self.away_um - self.chamber_um + 0.15)
        return np.minimum(smooth_min(chamber, mouth, 0.3), pits)
