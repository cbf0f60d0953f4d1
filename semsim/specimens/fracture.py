"""A fractured rock: a self-affine surface, broken where wanted into cleavage facets with steps between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Mesh
from semsim.specimens.noise import seed_of, solid_noise, speckle
from semsim.specimens.options import require_not_negative, require_positive, require_within
from semsim.specimens.sheet import slab
from semsim.specimens.substrate import visible_median_um

Array = NDArray[np.float64]

_THICKNESS_UM = 5.0
_MARGIN = 1.35  # the surface over the frame: room for tilt


@dataclass(frozen=True)
class Fracture:
    """A fracture surface z(x, y) without overhangs, from rugged down to a mirror.

    Parameters
    ----------
    hurst
        Hurst exponent H of the self-affine part: heights a distance r apart differ by r^H on average (rms). Rock has
        0.7 to 0.85; less is more rugged at small scales.
    rms_um
        Root mean square of the heights about their mean over the frame, facets included; 0 is a flat.
    roll_off_um
        Longest wavelength of the self-affine part; above it the spectrum is level.
    faceting
        Share of the height variance that lies in facets and the steps between them, 0 (none) to 1.
    facet_um
        Typical width of a facet.
    roughness_um
        Standard deviation of the fine relief, as wide as the speckle, over everything; not counted in `rms_um`.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    edge_um
        Grid spacing; 2 makes a quick, crude surface.
    frame_width_um, frame_height_um
        The frame over which rms and median height are taken; the surface is larger.
    """

    name: ClassVar[str] = "fracture"
    hurst: float = 0.8
    rms_um: float = 5.0
    roll_off_um: float = 90.0
    faceting: float = 0.6
    facet_um: float = 22.0
    roughness_um: float = 0.03
    contrast: float = 0.04
    grain_um: float = 0.8
    edge_um: float = 0.17
    frame_width_um: float = 125.6
    frame_height_um: float = 94.1

    def __post_init__(self) -> None:
        require_positive(self, "roll_off_um", "facet_um", "grain_um", "frame_width_um", "frame_height_um")
        require_not_negative(self, "rms_um", "roughness_um")
        require_within(self, "hurst", 0.0, 1.0)
        require_within(self, "faceting", 0.0, 1.0)
        require_within(self, "contrast", 0.0, 1.0)
        require_within(self, "edge_um", self.frame_width_um / 3000, self.frame_width_um / 8)
        require_within(self, "roll_off_um", 4 * self.edge_um, 4 * self.frame_width_um)
        require_within(self, "facet_um", 4 * self.edge_um, 4 * self.frame_width_um)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the fracture as the upper face of a closed slab."""
        affine_rng, facet_rng, rough_rng, yield_rng = rng.spawn(4)
        x_um, y_um = self._axis(self.frame_width_um), self._axis(self.frame_height_um)
        z_um = self._normalised(self_affine((len(x_um), len(y_um)), self.edge_um, self, affine_rng), x_um, y_um)
        if self.faceting > 0:
            facets = self._normalised(_facets(x_um, y_um, self, facet_rng), x_um, y_um)
            z_um = self._normalised(np.sqrt(1 - self.faceting) * z_um + np.sqrt(self.faceting) * facets, x_um, y_um)
        z_um *= self.rms_um
        if self.roughness_um > 0:
            z_um += self.roughness_um * _fine_relief(x_um, y_um, self.grain_um, seed_of(rough_rng))
        vertices_um, faces = slab(x_um, y_um, z_um, _THICKNESS_UM)
        vertices_um[:, 2] -= visible_median_um(vertices_um, faces, self.frame_width_um, self.frame_height_um)
        return Mesh(vertices_um, faces, speckle(vertices_um, self.contrast, self.grain_um, yield_rng))

    def _axis(self, frame_um: float) -> Array:
        """Return grid coordinates over the frame and its margin, 0 among them."""
        half = int(np.ceil(_MARGIN * frame_um / 2 / self.edge_um))
        return self.edge_um * np.arange(-half, half + 1, dtype=np.float64)

    def _normalised(self, z_um: Array, x_um: Array, y_um: Array) -> Array:
        """Return heights (nx, ny) with mean 0 and root mean square 1 over the frame."""
        inside = np.ix_(np.abs(x_um) <= self.frame_width_um / 2, np.abs(y_um) <= self.frame_height_um / 2)
        frame = z_um[inside]
        return np.asarray((z_um - frame.mean()) / frame.std())


def self_affine(shape: tuple[int, int], step_um: float, options: Fracture, rng: np.random.Generator) -> Array:
    """Return Gaussian random heights with a self-affine spectrum, (nx, ny), of arbitrary scale.

    Spectral synthesis: white noise is filtered so that the power spectrum over wave vectors q falls as
    ``|q|^-2(1 + H)`` down from the roll-off, and is level above it (B. N. J. Persson and others, J. Phys.: Condens.
    Matter 17, 2005, R1, Eq. 12). The period is longer than the surface, so that opposite borders are strangers.

    Parameters
    ----------
    step_um
        Grid spacing.
    options
        Its `hurst` and `roll_off_um`.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    period = [next_fast_len(n + int(np.ceil(options.roll_off_um / step_um)), real=True) for n in shape]
    white = rng.standard_normal(period)
    qx = np.fft.fftfreq(period[0], step_um)[:, None]
    qy = np.fft.rfftfreq(period[1], step_um)[None, :]
    q = np.maximum(np.hypot(qx, qy), 1.0 / options.roll_off_um)
    heights = irfft2(rfft2(white) * q ** -(1.0 + options.hurst), s=period)
    return np.asarray(heights[: shape[0], : shape[1]])


def _facets(x_um: Array, y_um: Array, options: Fracture, rng: np.random.Generator) -> Array:
    """Return planes of random tilt over cells with wandering borders, every other one cleaved again, (nx, ny)."""
    x, y = np.meshgrid(x_um, y_um, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    wander = np.column_stack([_wander(points, options.facet_um, rng) for _ in range(2)])
    places = points[:, :2] + options.facet_um * wander
    large = Cleavage.strewn(places, options.facet_um, rng)
    small = Cleavage.strewn(places, 0.35 * options.facet_um, rng)
    again = 0.5 * (rng.random(len(large.middles_um)) < 0.5)
    z_um = large.heights(points, places, options.edge_um)
    z_um += again[large.cell(places)] * small.heights(points, places, options.edge_um)
    return z_um.reshape(x.shape)


def _wander(points: Array, facet_um: float, rng: np.random.Generator) -> Array:
    """Return how far borders stray from straight at points (n, 3), in facet widths, (n,)."""
    broad, fine = seed_of(rng), seed_of(rng)
    return 0.1 * solid_noise(points, 0.8 * facet_um, broad) + 0.014 * solid_noise(points, 0.1 * facet_um, fine)


@dataclass(frozen=True)
class Cleavage:
    """Planes over the cells nearest to scattered points; where two meet they rarely agree, and a step is left.

    Parameters
    ----------
    middles_um
        (cells, 2) where a cell is at its level.
    level_um
        (cells,).
    slope
        (cells, 2) along x and y.
    """

    middles_um: Array
    level_um: Array
    slope: Array

    @classmethod
    def strewn(cls, places_um: Array, width_um: float, rng: np.random.Generator) -> Cleavage:
        """Strew cells about `width_um` wide over everything that places (n, 2) cover."""
        low, high = places_um.min(axis=0) - width_um, places_um.max(axis=0) + width_um
        count = max(int(np.prod((high - low) / width_um)), 4)
        middles = rng.uniform(low, high, (count, 2))
        return cls(middles, rng.normal(scale=0.2 * width_um, size=count), rng.normal(scale=0.4, size=(count, 2)))

    def cell(self, places_um: Array) -> NDArray[np.intp]:
        """Return the cell of each place (n, 2), (n,)."""
        from scipy.spatial import cKDTree

        return np.asarray(cKDTree(self.middles_um).query(places_um)[1])

    def heights(self, points_um: Array, places_um: Array, edge_um: float) -> Array:
        """Return the plane over each point (n, 3) in the cell of its place (n, 2), (n,) um; steps are an edge wide."""
        from scipy.spatial import cKDTree

        away, near = cKDTree(self.middles_um).query(places_um, k=2)
        offset = points_um[:, None, :2] - self.middles_um[near]
        first, second = (self.level_um[near] + np.einsum("nkc,nkc->nk", self.slope[near], offset)).T
        share = 0.5 * np.clip(1.0 - (away[:, 1] - away[:, 0]) / (2.0 * edge_um), 0.0, 1.0)
        return np.asarray(first + share * (second - first))


def _fine_relief(x_um: Array, y_um: Array, width_um: float, seed: int) -> Array:
    """Return unit noise of a width over the crossings of two axes, (nx, ny).

    Taken on a slanting plane: on a plane of its own lattice the noise is weaker than in space.
    """
    x, y = np.meshgrid(x_um, y_um, indexing="ij")
    slanting = np.array([[2.0, 1.0, -2.0], [1.0, 2.0, 2.0]]) / 3.0  # at right angles, of unit length
    points = np.column_stack([x.ravel(), y.ravel()]) @ slanting
    return solid_noise(points, width_um, seed, octaves=2).reshape(x.shape)
