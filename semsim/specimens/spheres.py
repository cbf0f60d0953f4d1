"""Calibration spheres: balls of a few known radii on a carrier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.analytic import ball, subdivisions_for
from semsim.specimens.noise import speckle
from semsim.specimens.options import require_positive, require_within
from semsim.specimens.substrate import Substrate, joined, mounted

Array = NDArray[np.float64]

_MARGIN = 1.25  # the carrier over the frame: room for tilt


@dataclass(frozen=True)
class Spheres:
    """Balls, watertight each, that rest on a carrier, many in touch: all vertices lie on their spheres.

    The radii are a geometric series, so that any two sizes can be told apart; small balls outnumber large ones as
    their radii do.

    Parameters
    ----------
    smallest_um, largest_um
        Radii at the ends of the series.
    sizes
        Different radii.
    count
        Balls thrown; one that finds no room is left out.
    touching
        Share of the balls that lie against another.
    sagitta_um
        No face is deeper under its sphere than this.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Grid spacing of the carrier.
    frame_width_um, frame_height_um
        The frame over which the median height is taken; the carrier is larger.
    """

    name: ClassVar[str] = "spheres"
    smallest_um: float = 2.0
    largest_um: float = 12.0
    sizes: int = 5
    count: int = 70
    touching: float = 0.4
    sagitta_um: float = 0.003
    contrast: float = 0.05
    grain_um: float = 0.8
    edge_um: float = 0.5
    frame_width_um: float = 125.6
    frame_height_um: float = 94.1

    def __post_init__(self) -> None:
        require_positive(self, "smallest_um", "grain_um", "frame_width_um", "frame_height_um")
        require_within(self, "largest_um", self.smallest_um, 0.4 * min(self.frame_width_um, self.frame_height_um))
        require_within(self, "sizes", 1, 50)
        require_within(self, "count", 1, 2000)
        require_within(self, "touching", 0.0, 1.0)
        require_within(self, "sagitta_um", 5e-6 * self.largest_um, 0.2 * self.largest_um)
        require_within(self, "contrast", 0.0, 1.0)
        require_within(self, "edge_um", self.frame_width_um / 2000, self.frame_width_um / 8)

    @property
    def radii_um(self) -> tuple[float, ...]:
        """The radii there are, rising."""
        return tuple(float(r) for r in np.geomspace(self.smallest_um, self.largest_um, self.sizes))

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the balls and their carrier."""
        place_rng, carrier_rng, yield_rng = rng.spawn(3)
        middles, radii = self._placed(place_rng)
        balls = [ball(radius, subdivisions_for(radius, self.sagitta_um)) for radius in radii]
        bodies = joined([(vertices + middle, faces) for (vertices, faces), middle in zip(balls, middles, strict=True)])
        carrier = Substrate(*self._carrier_um, self.edge_um, self.largest_um / 12.0)(0.0, carrier_rng)
        mesh = mounted(bodies, carrier, self.frame_width_um, self.frame_height_um)
        return Mesh(mesh.vertices_um, mesh.faces, speckle(mesh.vertices_um, self.contrast, self.grain_um, yield_rng))

    @property
    def _carrier_um(self) -> tuple[float, float]:
        """Extent of the carrier along x and y."""
        return _MARGIN * self.frame_width_um, _MARGIN * self.frame_height_um

    def _placed(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the balls from the largest down: middles (balls, 3) and radii (balls,); none cuts another."""
        sizes = np.array(self.radii_um)
        wanted = -np.sort(-rng.choice(sizes, self.count, p=(1 / sizes) / np.sum(1 / sizes)))
        at, radii = np.empty((0, 2)), np.empty(0)
        for radius in wanted:
            tries = self._tries(radius, at, radii, rng)
            room = np.linalg.norm(tries[:, None] - at[None], axis=2) - _touch(radius, radii)
            free = tries[(room >= -1e-9).all(axis=1)]
            if len(free):
                at, radii = np.vstack([at, free[:1]]), np.append(radii, radius)
        return np.column_stack([at, radii]), radii

    def _tries(self, radius: float, at: Array, radii: Array, rng: np.random.Generator) -> Array:
        """Return places for one more ball in the order of choice: against those there are, or anywhere, (60, 2)."""
        half = np.array(self._carrier_um) / 2 - radius
        anywhere = rng.uniform(-1.0, 1.0, (60, 2)) * half
        which, angle = rng.random(60), rng.uniform(0.0, 2.0 * np.pi, 60)
        if rng.random() >= self.touching or len(at) == 0:
            return anywhere
        other = (which * len(at)).astype(np.intp)
        against = at[other] + _touch(radius, radii[other])[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.asarray(against[(np.abs(against) <= half).all(axis=1)])


def _touch(radius: float, radii: Array) -> Array:
    """Return how far apart the feet of balls on one plane are when they touch, (n,)."""
    return np.asarray(2.0 * np.sqrt(radius * radii))
