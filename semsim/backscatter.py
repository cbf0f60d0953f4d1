"""Backscattered electrons on a segmented detector: fast, so they fly straight; heavy atoms send back more.

Each segment sees the emission of the surface over its own solid angle: Lambert's law, and on inclined surfaces a lobe
forward of the mirror direction. The integral is tabulated once, over the tilt of the surface and its azimuth from the
middle of the segment. Walls on the way to a segment take their part.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Pose
from semsim.surface import SurfaceBuffer, interpolate

LOBE_EXPONENT = 4.0
"""Power of the cosine in the forward lobe: half its height at 33 degrees from the mirror direction."""
TILTS, AZIMUTHS = 91, 61
QUADRATURE = 24
SHADOW_DIRECTIONS, SHADOW_STEPS = 12, 12


@dataclass(frozen=True)
class BackscatterOptions:
    """An annular detector under the pole piece, whole or in segments.

    Parameters
    ----------
    segments
        Equal parts of the ring, 1 to 4; each of 2 or more is a channel of its own beside their sum.
    azimuth_deg
        Direction towards the middle of the first segment, counter-clockwise from right; the others follow that way.
    inner_deg, outer_deg
        Angles from the optical axis between which the ring is seen from the specimen.
    atomic_number
        Mean atomic number of the specimen, which decides how fast the signal grows with tilt.
    forward
        Share of the forward lobe at grazing incidence, from 0 (Lambert's law at any tilt) to 1.
    shadowing
        How much of what walls cover is lost, from 0 (off) to 1.
    shadow_reach_um
        How far around a place walls are looked for, um.

    Raises
    ------
    InputError
        A value outside its range.
    """

    segments: int = 4
    azimuth_deg: float = 0.0
    inner_deg: float = 20.0
    outer_deg: float = 60.0
    atomic_number: float = 6.0
    forward: float = 0.5
    shadowing: float = 1.0
    shadow_reach_um: float = 8.0

    def __post_init__(self) -> None:
        limits = {
            "segments": (1, 4),
            "azimuth_deg": (-360.0, 360.0),
            "inner_deg": (0.0, 89.0),
            "outer_deg": (self.inner_deg + 1.0, 90.0),
            "atomic_number": (1.0, 99.0),
            "forward": (0.0, 1.0),
            "shadowing": (0.0, 1.0),
            "shadow_reach_um": (0.0, 1e6),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"backscatter option {name} must lie between {low:g} and {high:g}, not {value}")


def backscatter_rates(
    buffer: SurfaceBuffer, pose: Pose, options: BackscatterOptions, mesh: Mesh, pixel_size_um: float, background: float
) -> dict[str, Array]:
    """Work out what each segment and the whole ring count, relative to the whole ring over a flat sheet.

    Parameters
    ----------
    background
        Rate of the whole ring where the beam misses.

    Returns
    -------
    (rows, columns) each: "bse_a", "bse_b" and so on for two segments or more, then "bse", their sum.
    """
    rates = np.full((options.segments, *buffer.depth_um.shape), background / options.segments)
    table = segment_table(options)
    middles = np.deg2rad(options.azimuth_deg) + np.arange(options.segments) * (2 * np.pi / options.segments)
    steps = _shadow_offsets(options, options.shadow_reach_um / pixel_size_um)
    polar = np.sin(np.deg2rad([options.inner_deg, options.outer_deg])) ** 2

    def work(start: int, stop: int) -> None:
        _segments(
            start, stop, buffer.depth_um, buffer.normal, pose.view_from_world, table, middles, steps,
            options.shadowing, polar[0], polar[1], pixel_size_um, rates,
        )  # fmt: skip
        if mesh.vertex_yield is not None:
            face, position = buffer.face[start:stop], buffer.position_um[start:stop]
            material = interpolate(mesh, mesh.vertex_yield, face, position)
            rates[:, start:stop] *= np.where(face < 0, 1.0, material)

    in_bands(len(buffer.depth_um), work)
    names = [f"bse_{letter}" for letter in "abcd"[: options.segments]] if options.segments > 1 else []
    return dict(zip(names, rates, strict=False)) | {"bse": rates.sum(axis=0)}


def backscatter_coefficient(atomic_number: float, cos_tilt: Array) -> Array:
    """Electrons sent back per incident electron, ``(1 + cos(phi))^(-9 / sqrt(Z))`` (Arnal et al. 1969).

    Parameters
    ----------
    cos_tilt
        (...,) cosine of the angle between beam and normal.
    """
    return np.asarray((1.0 + cos_tilt) ** (-9.0 / np.sqrt(atomic_number)))


def emission(direction: Array, normal: Array, forward: float) -> Array:
    """Share of the backscattered electrons that leaves in a direction, (...,) per steradian; 0 below the surface.

    Parameters
    ----------
    direction, normal
        (..., 3) unit vectors in the view frame, the beam along -z.
    forward
        Share of the lobe ``(direction . mirror direction)^4`` at grazing incidence; it grows as ``sin(phi)^2``.
    """
    cosine = np.einsum("...i,...i->...", direction, normal)
    mirror = 2 * normal[..., 2:] * normal - np.array([0.0, 0.0, 1.0])
    lobe = np.maximum(np.einsum("...i,...i->...", direction, mirror), 0.0) ** LOBE_EXPONENT / _lobe_norm(normal[..., 2])
    share = forward * (1 - normal[..., 2] ** 2)
    return np.asarray(np.where(cosine > 0, (1 - share) * cosine / np.pi + share * lobe, 0.0))


@lru_cache(maxsize=8)
def segment_table(options: BackscatterOptions) -> Array:
    """Response of one segment, (TILTS, AZIMUTHS), over 0 to 90 degrees of tilt and 0 to 180 of azimuth from its middle.

    Relative to the whole ring over a flat sheet, and with the growth of the yield with tilt in it.
    """
    tilt, azimuth = np.linspace(0, np.pi / 2, TILTS), np.linspace(0, np.pi, AZIMUTHS)
    normal = _unit(tilt[:, None, None], azimuth[:, None])
    directions, weights = _segment_quadrature(options)
    seen = np.stack([emission(directions, row, options.forward) @ weights for row in normal])
    total = backscatter_coefficient(options.atomic_number, np.cos(tilt))
    return np.asarray(seen * (total / total[0])[:, None] / (seen[0, 0] * options.segments))


def _segment_quadrature(options: BackscatterOptions) -> tuple[Array, Array]:
    """Directions (n, 3) towards a segment whose middle is at azimuth 0, and their solid angles (n,)."""
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    inner, outer = np.deg2rad([options.inner_deg, options.outer_deg])
    polar, half_width = (outer - inner) / 2 * nodes + (outer + inner) / 2, np.pi / options.segments
    solid_angle = np.outer(weights * (outer - inner) / 2 * np.sin(polar), weights * half_width)
    return _unit(polar[:, None], half_width * nodes).reshape(-1, 3), solid_angle.ravel()


def _lobe_norm(cos_tilt: Array) -> Array:
    """Integral of the forward lobe over the half space above the surface, (...,), by interpolation."""
    tilt = np.linspace(0, np.pi / 2, TILTS)
    return np.asarray(np.interp(np.arccos(np.clip(cos_tilt, 0, 1)), tilt, _lobe_norms()))


@lru_cache(maxsize=1)
def _lobe_norms() -> Array:
    """`_lobe_norm` at `TILTS` angles: the mirror direction stands `tilt` off the normal."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * QUADRATURE)
    polar, azimuth = np.pi / 4 * (nodes + 1), np.linspace(0, 2 * np.pi, 72, endpoint=False)
    direction = _unit(polar[:, None], azimuth)
    mirror = _unit(np.linspace(0, np.pi / 2, TILTS), np.zeros(TILTS))
    lobe = np.maximum(np.einsum("pai,ti->tpa", direction, mirror), 0.0) ** LOBE_EXPONENT
    return np.asarray(lobe.mean(axis=2) * 2 * np.pi @ (weights * np.pi / 4 * np.sin(polar)))


def _unit(polar_rad: Array, azimuth_rad: Array) -> Array:
    """Return unit vectors (..., 3) at angles from z and, counter-clockwise, from x."""
    x, y = np.sin(polar_rad) * np.cos(azimuth_rad), np.sin(polar_rad) * np.sin(azimuth_rad)
    return np.stack(np.broadcast_arrays(x, y, np.cos(polar_rad)), axis=-1)


def _shadow_offsets(options: BackscatterOptions, reach_px: float) -> NDArray[np.int64]:
    """(segments, directions, steps, 2) whole-pixel offsets (right, down) towards each segment."""
    count = SHADOW_DIRECTIONS // options.segments
    angle = (np.arange(options.segments)[:, None] + (np.arange(count) + 0.5) / count - 0.5) / options.segments
    angle = 2 * np.pi * angle + np.deg2rad(options.azimuth_deg)
    length = max(reach_px, 1.5) ** (np.arange(SHADOW_STEPS) / (SHADOW_STEPS - 1))
    compass = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    return np.asarray(np.rint(length[:, None] * compass[:, :, None]), dtype=np.int64)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _segments(
    start: int,
    stop: int,
    depth: Array,
    normal: Array,
    view_from_world: Array,
    table: Array,
    middles: Array,
    offsets: NDArray[np.int64],
    shadowing: float,
    inner: float,
    outer: float,
    pixel_size: float,
    rates: Array,
) -> None:  # pragma: no cover - compiled
    view = np.empty(3)
    for row in range(start, stop):
        for column in range(depth.shape[1]):
            if np.isnan(depth[row, column]):
                continue
            for i in range(3):
                view[i] = 0.0
                for j in range(3):
                    view[i] += view_from_world[i, j] * normal[row, column, j]
            tilt = np.arccos(min(max(view[2], 0.0), 1.0)) / (np.pi / 2) * (TILTS - 1)
            azimuth = np.arctan2(view[1], view[0])
            for k in range(len(middles)):
                turn = np.abs((azimuth - middles[k] + np.pi) % (2 * np.pi) - np.pi) / np.pi * (AZIMUTHS - 1)
                rates[k, row, column] = _bilinear(table, tilt, turn)
                if shadowing > 0:
                    open_share = _open(row, column, depth, view, offsets[k], inner, outer, pixel_size)
                    rates[k, row, column] *= 1.0 - shadowing * (1.0 - open_share)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _bilinear(table: Array, y: float, x: float) -> float:  # pragma: no cover - compiled
    i, j = min(int(y), table.shape[0] - 2), min(int(x), table.shape[1] - 2)
    v, u = y - i, x - j
    upper = table[i, j] * (1 - u) + table[i, j + 1] * u
    return float(upper * (1 - v) + (table[i + 1, j] * (1 - u) + table[i + 1, j + 1] * u) * v)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _open(
    row: int,
    column: int,
    depth: Array,
    view: Array,
    offsets: NDArray[np.int64],
    inner: float,
    outer: float,
    pixel_size: float,
) -> float:  # pragma: no cover - compiled
    """Share of a segment that no wall hides, of what the place's own tangent plane leaves of it."""
    rows, columns = depth.shape
    upright = max(view[2], 1e-3)
    total = 0.0
    for direction in range(offsets.shape[0]):
        last_x, last_y = offsets[direction, -1]
        reach = np.sqrt(float(last_x * last_x + last_y * last_y))
        tangent = (-view[0] * last_x + view[1] * last_y) / (upright * reach)
        horizon = tangent
        for step in range(offsets.shape[1]):
            right, down = offsets[direction, step]
            y, x = row + down, column + right
            if not (0 <= y < rows and 0 <= x < columns):
                break
            length = np.sqrt(float(right * right + down * down))
            own = (-view[0] * right + view[1] * down) / (upright * length)
            # What rises over the tangent plane in its own direction, which rounding turns from the nominal one. It
            # counts for less towards the end of the reach, lest shadows end in a line.
            rise = (depth[row, column] - depth[y, x]) / (length * pixel_size) - own
            rise *= max(0.0, 1.0 - (length / reach) ** 2)
            if rise > 0.0:  # false for a miss
                horizon = max(horizon, tangent + rise)
        # The horizon at slope h hides polar angles whose sine squared is above 1 / (1 + h^2).
        free = min(outer, 1.0 / (1.0 + tangent * tangent)) if tangent > 0.0 else outer
        left = min(outer, 1.0 / (1.0 + horizon * horizon)) if horizon > 0.0 else outer
        # Where the tangent plane itself hides all of it, or all but rounding, walls can hide no more.
        total += max(left - inner, 0.0) / (free - inner) if free - inner > 1e-6 else 1.0
    return float(total / offsets.shape[0])
