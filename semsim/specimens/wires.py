"""Fibres: round wires that lie over one another on a carrier, at random or woven."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.noise import seed_of, solid_noise, speckle
from semsim.specimens.options import require_not_negative, require_positive, require_within
from semsim.specimens.relief import roughened
from semsim.specimens.sheet import Faces
from semsim.specimens.substrate import Part, Substrate, joined, mounted

Array = NDArray[np.float64]

_MARGIN = 1.25  # the carrier over the frame: room for tilt


@dataclass(frozen=True)
class Wires:
    """Round-ended wires, a watertight body each, over a carrier that is one more.

    Parameters
    ----------
    radius_um
        Of the wires.
    count
        Wires strewn at random; not used where they are woven.
    length_um
        Of a wire; a woven one runs right across.
    bend_um
        How far a strewn wire strays from straight, as a standard deviation.
    woven
        Weave them over and under at right angles instead of strewing them.
    pitch_um
        Distance between woven neighbours.
    clearance_um
        Gap between the carrier and the lowest wires.
    roughness_um
        Standard deviation of the fine relief of the wires, about half their radius wide and above.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Length of the triangles' edges; 1.5 makes quick, crude wires.
    frame_width_um, frame_height_um
        The frame over which the median height is taken; the carrier is larger.
    """

    name: ClassVar[str] = "wires"
    radius_um: float = 1.6
    count: int = 55
    length_um: float = 120.0
    bend_um: float = 3.0
    woven: bool = False
    pitch_um: float = 9.0
    clearance_um: float = 4.0
    roughness_um: float = 0.02
    contrast: float = 0.05
    grain_um: float = 0.8
    edge_um: float = 0.36
    frame_width_um: float = 125.6
    frame_height_um: float = 94.1

    def __post_init__(self) -> None:
        require_positive(self, "radius_um", "length_um", "grain_um", "frame_width_um", "frame_height_um")
        require_not_negative(self, "bend_um", "clearance_um", "roughness_um")
        require_within(self, "count", 1, 500)
        require_within(self, "contrast", 0.0, 1.0)
        require_within(self, "edge_um", self.radius_um / 20, self.radius_um)
        require_within(self, "pitch_um", 3.0 * self.radius_um, self.frame_height_um)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the wires and their carrier."""
        lay_rng, rough_rng, carrier_rng, yield_rng = rng.spawn(4)
        lines = self._woven() if self.woven else self._strewn(lay_rng)
        vertices_um, faces = joined([tube(line, self.radius_um, self.edge_um) for line in lines])
        vertices_um = roughened(vertices_um, faces, self.roughness_um, 0.5 * self.radius_um, rough_rng)
        low_um = float(min(line[:, 2].min() for line in lines)) - self.radius_um - self.clearance_um
        carrier = Substrate(*self._carrier_um, 1.5 * self.edge_um, self.radius_um / 1.6)(low_um, carrier_rng)
        mesh = mounted((vertices_um, faces), carrier, self.frame_width_um, self.frame_height_um)
        return Mesh(mesh.vertices_um, mesh.faces, speckle(mesh.vertices_um, self.contrast, self.grain_um, yield_rng))

    @property
    def _carrier_um(self) -> tuple[float, float]:
        """Extent of the carrier along x and y."""
        return _MARGIN * self.frame_width_um, _MARGIN * self.frame_height_um

    def _woven(self) -> list[Array]:
        """Return the axes of a plain weave: each wire passes over one and under the next, (points, 3) each."""
        lines = []
        lift = 1.02 * self.radius_um
        for across, (long_um, wide_um) in enumerate((self._carrier_um, self._carrier_um[::-1])):
            half = int(0.5 * wide_um / self.pitch_um)
            along = np.linspace(-0.5, 0.5, max(int(long_um / self.edge_um), 8)) * long_um
            for n in range(-half, half + 1):
                wave = lift * np.cos(np.pi * (along / self.pitch_um + n + across))
                place = np.full(len(along), n * self.pitch_um)
                lines.append(np.column_stack([place, along, wave] if across else [along, place, wave]))
        return lines

    def _strewn(self, rng: np.random.Generator) -> list[Array]:
        """Return the axes of wires dropped one after another, (points, 3) each; none cuts one below it."""
        lines: list[Array] = []
        for _ in range(self.count):
            path = self._path(rng)
            below = np.vstack(lines) if lines else np.empty((0, 3))
            lines.append(np.column_stack([path, self._drape(path, below)]))
        return lines

    def _path(self, rng: np.random.Generator) -> Array:
        """Return a gently winding line seen from above, (points, 2), points `edge_um` apart or so."""
        along = np.linspace(-0.5, 0.5, max(int(self.length_um / self.edge_um), 8)) * self.length_um
        level = np.column_stack([along, np.zeros(len(along)), np.zeros(len(along))])
        aside = self.bend_um * solid_noise(level, 0.4 * self.length_um, seed_of(rng))
        direction = rng.uniform(0.0, 2.0 * np.pi)
        turn = np.array([[np.cos(direction), np.sin(direction)], [-np.sin(direction), np.cos(direction)]])
        return np.asarray(np.column_stack([along, aside]) @ turn + rng.uniform(-0.5, 0.5, 2) * self._carrier_um)

    def _drape(self, path: Array, below: Array) -> Array:
        """Return the height of a wire's axis over the ones below it, (points,): it rests on them and sags between.

        Over each touch the wire bends with a radius of 40 wire radii at most, so that its height is the highest of
        parabolas; `below` holds the points of all axes under it, (n, 3).
        """
        from scipy.spatial import cKDTree

        rest = np.zeros(len(path))
        reach = 2.06 * self.radius_um  # a little air, for the polygons and for the relief
        if len(below):
            for n, near in enumerate(cKDTree(below[:, :2]).query_ball_point(path, reach)):
                apart2 = np.sum((below[near, :2] - path[n]) ** 2, axis=1)
                rest[n] = np.max(below[near, 2] + np.sqrt(np.maximum(reach**2 - apart2, 0.0)), initial=0.0)
        step = self.length_um / (len(path) - 1)
        apart = step * (np.arange(len(path))[:, None] - np.arange(len(path))[None, :])
        bent = np.max(rest[None, :] - apart**2 / (80.0 * self.radius_um), axis=1)
        return np.asarray(bent)


def tube(axis_um: Array, radius_um: float, edge_um: float) -> Part:
    """Return a closed tube with hemispherical ends about an axis that never runs upright: vertices and faces.

    Parameters
    ----------
    axis_um
        (points, 3), evenly spaced.
    """
    sides = max(round(2 * np.pi * radius_um / edge_um), 8)
    tangent = np.gradient(axis_um, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    lean = np.linspace(0.0, 0.5 * np.pi, max(round(0.5 * np.pi * radius_um / edge_um), 3) + 2)[1:-1, None]
    caps, one = len(lean), np.ones((len(axis_um), 1))
    way = np.vstack([np.repeat(tangent[:1], caps, axis=0), tangent, np.repeat(tangent[-1:], caps, axis=0)])
    back, front = axis_um[0] - radius_um * np.cos(lean) * way[0], axis_um[-1] + radius_um * np.sin(lean) * way[-1]
    width = radius_um * np.vstack([np.sin(lean), one, np.cos(lean)])
    wall = np.vstack([back, axis_um, front])[:, None] + width[:, None] * _circles(way, sides)
    tips = axis_um[[0, -1]] + radius_um * np.array([[-1.0], [1.0]]) * tangent[[0, -1]]
    return np.vstack([wall.reshape(-1, 3), tips]), _tube_faces(len(wall), sides)


def _circles(way: Array, sides: int) -> Array:
    """Return unit circles round directions (n, 3), none of them upright: (n, sides, 3)."""
    aside = np.cross([0.0, 0.0, 1.0], way)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    up = np.cross(way, aside)
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    return np.asarray(np.cos(angle) * aside[:, None] + np.sin(angle) * up[:, None])


def _tube_faces(rings: int, sides: int) -> Faces:
    """Return the faces of rings of `sides` vertices in a row, and of fans to the two vertices after them."""
    corner = np.arange(rings * sides, dtype=np.int32).reshape(rings, sides)
    after = np.roll(corner, -1, axis=1)
    a, b, c, d = corner[:-1].ravel(), after[:-1].ravel(), after[1:].ravel(), corner[1:].ravel()
    start, end = np.full(sides, rings * sides, np.int32), np.full(sides, rings * sides + 1, np.int32)
    return np.vstack([
        np.column_stack([a, b, c]),
        np.column_stack([a, c, d]),
        np.column_stack([start, after[0], corner[0]]),
        np.column_stack([end, corner[-1], after[-1]]),
    ])  # fmt: skip
