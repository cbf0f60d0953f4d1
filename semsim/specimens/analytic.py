"""Specimens whose true surface is a formula: plane, step, wedge and sphere, speckled so that matching can see them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.noise import speckle
from semsim.specimens.options import require_positive, require_within
from semsim.specimens.sheet import Faces, slab

Array = NDArray[np.float64]

THICKNESS_UM = 5.0
_SAGITTA = 0.292  # depth of the deepest face of an icosphere in radii, times 4^subdivisions: an upper bound


@dataclass(frozen=True, kw_only=True)
class Flats:
    """What plane, step and wedge share: a square slab about the origin, made of flat faces.

    Parameters
    ----------
    extent_um
        Side of the square.
    edge_um
        Grid spacing. The flat faces are exact at any; the speckle is only as fine as this.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    """

    name: ClassVar[str]
    extent_um: float = 160.0
    edge_um: float = 0.4
    contrast: float = 0.12
    grain_um: float = 1.6

    def __post_init__(self) -> None:
        require_positive(self, "extent_um", "edge_um", "grain_um")
        require_within(self, "edge_um", self.extent_um / 5000, self.extent_um / 2)
        require_within(self, "contrast", 0.0, 1.0)

    def _axis(self) -> Array:
        """Return grid coordinates over the extent, 0 among them, so that an edge at 0 is met exactly."""
        return self.extent_um / 2 * np.linspace(-1.0, 1.0, 2 * round(self.extent_um / self.edge_um / 2) + 1)

    def _inside(self, x_um: Array, y_um: Array) -> NDArray[np.bool_]:
        """Tell where the specimen is, seen from above."""
        half = self.extent_um / 2
        return np.asarray((np.abs(x_um) <= half) & (np.abs(y_um) <= half))

    def _mesh(self, x_um: Array, z_um: Array, rng: np.random.Generator) -> Mesh:
        """Return the closed, speckled slab under heights (nx, ny) over the axis x and the standard axis y."""
        vertices, faces = slab(x_um, self._axis(), z_um, THICKNESS_UM)
        return Mesh(vertices, faces, speckle(vertices, self.contrast, self.grain_um, rng))


@dataclass(frozen=True, kw_only=True)
class Plane(Flats):
    """An inclined plane through the origin.

    Parameters
    ----------
    slope_deg
        Inclination.
    slope_direction_deg
        Where uphill is: 0 is +x, 90 is +y.
    """

    name: ClassVar[str] = "plane"
    slope_deg: float = 8.0
    slope_direction_deg: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within(self, "slope_deg", -80.0, 80.0)

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height over points of one shape; NaN off the specimen."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        direction = np.deg2rad(self.slope_direction_deg)
        z = np.tan(np.deg2rad(self.slope_deg)) * (x * np.cos(direction) + y * np.sin(direction))
        return np.where(self._inside(x, y), z, np.nan)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the plane as the upper face of a slab."""
        x, y = np.meshgrid(self._axis(), self._axis(), indexing="ij")
        return self._mesh(self._axis(), self.height_um(x, y), rng)


@dataclass(frozen=True, kw_only=True)
class Step(Flats):
    """Two level terraces and the upright wall between them at x = 0; the higher one is at x >= 0.

    Parameters
    ----------
    rise_um
        Height of the wall; the terraces lie at plus and minus half of it.
    """

    name: ClassVar[str] = "step"
    rise_um: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "rise_um")

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height over points of one shape; NaN off the specimen."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        return np.where(self._inside(x, y), np.where(x >= 0, 0.5, -0.5) * self.rise_um, np.nan)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the step; its wall has vertices along its height so that it carries speckle too."""
        axis = self._axis()
        middle = len(axis) // 2
        rungs = np.linspace(-0.5, 0.5, max(round(self.rise_um / self.edge_um), 1) + 1) * self.rise_um
        x = np.concatenate([axis[:middle], np.zeros(len(rungs)), axis[middle + 1 :]])
        z = np.concatenate([np.full(middle, rungs[0]), rungs, np.full(middle, rungs[-1])])
        return self._mesh(x, np.repeat(z[:, None], len(axis), axis=1), rng)


@dataclass(frozen=True, kw_only=True)
class Wedge(Flats):
    """A roof: two planes that fall away on both sides of a ridge along y.

    Parameters
    ----------
    slope_deg
        Inclination of each side.
    ridge_um
        Height of the ridge.
    """

    name: ClassVar[str] = "wedge"
    slope_deg: float = 15.0
    ridge_um: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within(self, "slope_deg", -80.0, 80.0)

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height over points of one shape; NaN off the specimen."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        return np.where(self._inside(x, y), self.ridge_um - np.abs(x) * np.tan(np.deg2rad(self.slope_deg)), np.nan)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the roof as the upper face of a slab."""
        x, y = np.meshgrid(self._axis(), self._axis(), indexing="ij")
        return self._mesh(self._axis(), self.height_um(x, y), rng)


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A ball with nothing under it: all vertices lie on the sphere, and no face is deeper below it than `sagitta_um`.

    Parameters
    ----------
    radius_um, centre_z_um
        Of the ball; by default the median height of its upper half, seen from above, is about 0.
    subdivisions
        Each one quarters the faces of the icosahedron: 20 x 4^n in all.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    """

    name: ClassVar[str] = "sphere"
    radius_um: float = 44.0
    centre_z_um: float = -31.0
    subdivisions: int = 7
    contrast: float = 0.12
    grain_um: float = 1.6

    def __post_init__(self) -> None:
        require_positive(self, "radius_um", "grain_um")
        require_within(self, "subdivisions", 0, 9)
        require_within(self, "contrast", 0.0, 1.0)

    @property
    def sagitta_um(self) -> float:
        """Depth of the deepest face under the sphere, 0.292 R / 4^n at most for n subdivisions."""
        return _SAGITTA * self.radius_um / 4.0**self.subdivisions

    def height_um(self, x_um: Array, y_um: Array) -> Array:
        """Return the height of the upper half over points of one shape; NaN off the ball."""
        x, y = np.asarray(x_um, dtype=float), np.asarray(y_um, dtype=float)
        under = self.radius_um**2 - x * x - y * y
        return self.centre_z_um + np.sqrt(np.where(under >= 0, under, np.nan))

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the ball."""
        vertices, faces = ball(self.radius_um, self.subdivisions)
        vertices[:, 2] += self.centre_z_um
        return Mesh(vertices, faces, speckle(vertices, self.contrast, self.grain_um, rng))


def ball(radius_um: float, subdivisions: int) -> tuple[Array, Faces]:
    """Return a sphere about the origin, an icosahedron subdivided: vertices on the sphere, and 20 x 4^n faces."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions = np.asarray(sphere.vertices, dtype=np.float64)
    vertices = radius_um * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return vertices, np.asarray(sphere.faces, dtype=np.int32)


def subdivisions_for(radius_um: float, sagitta_um: float) -> int:
    """Return the fewest subdivisions of a `ball` none of whose faces is deeper than `sagitta_um` under the sphere."""
    return max(int(np.ceil(np.log(_SAGITTA * radius_um / sagitta_um) / np.log(4.0))), 0)
