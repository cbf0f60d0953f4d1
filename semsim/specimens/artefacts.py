"""Calibration artefacts whose true surface is a formula: a staircase or grating, and a stepped pyramid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.analytic import THICKNESS_UM, Flats
from semsim.specimens.noise import speckle
from semsim.specimens.options import require_positive, require_within
from semsim.specimens.sheet import slab, welded

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Terraces(Flats):
    """What steps and pyramid share: level treads, and walls of one slope between them.

    Parameters
    ----------
    rise_um
        Height of one wall.
    wall_deg
        Slope of the walls; 90 is upright.
    """

    edge_um: float = 0.35
    contrast: float = 0.05
    grain_um: float = 0.9
    rise_um: float = 2.0
    wall_deg: float = 90.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "rise_um")
        require_within(self, "wall_deg", 20.0, 90.0)

    @property
    def wall_um(self) -> float:
        """Width of a wall seen from above; 0 where it is upright."""
        return 0.0 if self.wall_deg == 90 else self.rise_um / float(np.tan(np.deg2rad(self.wall_deg)))

    def _climbed(self, past_um: Array) -> Array:
        """Return the share of a wall climbed at a distance past its middle, 0 to 1; its upright edge counts as up."""
        if self.wall_um == 0:
            return np.where(past_um >= 0, 1.0, 0.0)
        return np.clip(past_um / self.wall_um + 0.5, 0.0, 1.0)

    def _nodes(self, walls_um: Array, upward: Array, start: tuple[float, float], end_um: float) -> tuple[Array, Array]:
        """Return places and heights of vertices along a profile, `edge_um` apart or less on treads and walls alike.

        Parameters
        ----------
        walls_um
            (walls,) middles of the walls, rising.
        upward
            (walls,) 1 where a wall climbs, -1 where it falls.
        start
            Place and height at which the profile begins.
        end_um
            Place at which it ends.
        """
        feet = (walls_um[:, None] + self.wall_um * np.array([-0.5, 0.5])).ravel()
        treads = start[1] + self.rise_um * np.concatenate([[0.0], np.cumsum(upward)])
        corners = np.column_stack([[start[0], *feet, end_um], np.repeat(treads, 2)])
        lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        cuts = np.maximum(np.ceil(lengths / self.edge_um - 1e-9), 1).astype(int)
        pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(corners[:-1], corners[1:], cuts, strict=True)]
        x_um, z_um = np.vstack([*pieces, corners[-1:]]).astype(np.float64).T
        return x_um, z_um


@dataclass(frozen=True, kw_only=True)
class Steps(Terraces):
    """A staircase along x that climbs and falls in turn; with two levels, a grating. Level treads, straight edges.

    Parameters
    ----------
    pitch_um
        Distance from wall to wall. A grating's period is twice this, a staircase's 2 (levels - 1) times.
    levels
        Different heights; they lie evenly about 0.
    """

    name: ClassVar[str] = "steps"
    pitch_um: float = 10.0
    levels: int = 5
    wall_deg: float = 85.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "pitch_um")
        require_within(self, "pitch_um", max(2 * self.wall_um, self.extent_um / 2000), self.extent_um)
        require_within(self, "levels", 2, 1000)

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height over points of one shape; NaN off the specimen."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        before = np.floor(x / self.pitch_um)  # of the two treads whose middles lie about a point, the one at lower x
        low, high = self._level(before), self._level(before + 1)
        past = x - (before + 0.5) * self.pitch_um
        up = np.where(high > low, self._climbed(past), 1.0 - self._climbed(-past))
        return np.where(self._inside(x, y), low + (high - low) * up, np.nan)

    def _level(self, tread: Array) -> Array:
        """Return the height of treads by number; number 0 has its middle at x = 0 and is lowest."""
        turn = self.levels - 1
        return np.asarray(self.rise_um * (turn - np.abs(tread % (2 * turn) - turn) - turn / 2))

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the stairs as the upper face of a slab; walls carry vertices, and speckle, too."""
        half = self.extent_um / 2
        beyond = int(half / self.pitch_um) + 2
        tread = np.arange(-beyond, beyond + 1, dtype=np.float64)
        level = self._level(tread)
        x, z = self._nodes(
            (tread[:-1] + 0.5) * self.pitch_um,
            np.sign(np.diff(level)),
            (float(tread[0]) * self.pitch_um, float(level[0])),
            beyond * self.pitch_um,
        )
        ends = half * np.array([-1.0, 1.0])
        first, last = self.height_um((1.0 - 1e-12) * ends, np.zeros(2))  # a wall upright on the border is outside
        inside = np.abs(x) < half
        x, z = np.concatenate([ends[:1], x[inside], ends[1:]]), np.concatenate([[first], z[inside], [last]])
        return self._mesh(x, np.repeat(z[:, None], len(self._axis()), axis=1), rng)


@dataclass(frozen=True, kw_only=True)
class Pyramid(Terraces):
    """A square pyramid of level terraces on a level ground, its sides along x and y, its middle over the origin.

    Parameters
    ----------
    terraces
        Treads above the ground, the top among them.
    tread_um
        Distance from wall to wall.
    top_um
        Side of the top.
    frame_width_um, frame_height_um
        The frame over which the median height is 0.
    """

    name: ClassVar[str] = "pyramid"
    rise_um: float = 3.0
    wall_deg: float = 80.0
    terraces: int = 6
    tread_um: float = 7.0
    top_um: float = 14.0
    frame_width_um: float = 125.6
    frame_height_um: float = 94.1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "tread_um", "top_um", "frame_width_um", "frame_height_um")
        require_within(self, "terraces", 1, 200)
        require_within(self, "tread_um", 2 * self.wall_um, self.extent_um)
        widest = self.extent_um - 2 * (self.terraces - 1) * self.tread_um - 2 * self.wall_um
        require_within(self, "top_um", 2 * self.wall_um, widest)

    @property
    def _walls_um(self) -> Array:
        """Return the distances of the walls' middles from the pyramid's, from the top down, (terraces,)."""
        return self.top_um / 2 + self.tread_um * np.arange(self.terraces, dtype=np.float64)

    @cached_property
    def ground_um(self) -> float:
        """Height of the ground, such that the median height over the frame is 0."""
        u = (np.arange(512) + 0.5) / 512 - 0.5
        x, y = np.meshgrid(u * self.frame_width_um, u * self.frame_height_um)
        return -float(np.median(self._above_ground(np.maximum(np.abs(x), np.abs(y)))))

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height over points of one shape; NaN off the specimen."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        z = self.ground_um + self._above_ground(np.maximum(np.abs(x), np.abs(y)))
        return np.where(self._inside(x, y), z, np.nan)

    def _above_ground(self, out_um: Array) -> Array:
        """Return the height over the ground at distances from the middle, along x or y, whichever is longer."""
        return np.asarray(self.rise_um * sum(self._climbed(wall - out_um) for wall in self._walls_um))

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the pyramid as the upper face of a slab; walls carry vertices, and speckle, too.

        A grid of columns that crowd at the walls along x and y alike; where both crowd, columns fall together and are
        welded. Cells are cut along the ridges, so that faces are exact there too.
        """
        walls = self._walls_um
        top = self.ground_um + self.rise_um * self.terraces
        out, z = self._nodes(walls, np.full(len(walls), -1.0), (0.0, top), self.extent_um / 2)
        axis = np.concatenate([-out[:0:-1], out])
        rank = np.abs(np.arange(len(axis)) - (len(out) - 1))
        right = np.arange(len(axis) - 1) >= len(out) - 1
        heights = z[np.maximum(rank[:, None], rank[None, :])]
        ridges = right[:, None] != right[None, :]
        vertices, faces = welded(*slab(axis, axis, heights, THICKNESS_UM, other_diagonal=ridges))
        return Mesh(vertices, faces, speckle(vertices, self.contrast, self.grain_um, rng))
