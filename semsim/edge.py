"""Edges and ridges glow: electrons set free in the depth escape through the side walls as well.

What lies within the escape depth of a place is a half ball under its tangent plane where the surface is flat. At an
edge part of that half ball is missing, and the share that is missing says how much more of the electrons get out. It is
the volume descriptor of integral invariants (Pottmann et al. 2009), taken from the depth map. It sees what the beam
sees: the space below an overhang counts as solid.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.mesh import Array
from semsim.microscope import Pose
from semsim.surface import SurfaceBuffer

LEAST_REACH_PX = 2.5
"""A smaller ball would have too few pixels in it; the glow is then spread over this one and weakened in proportion."""
FULL_REACH_PX = 4.0
"""Up to here every pixel under the ball is looked at, above a fixed number of them."""
SUBPIXELS = 8
SAMPLES = 14
"""In a quarter of a large ball."""
GOLDEN_ANGLE = 2.399963229728653
STRIP = 3 / 16
"""Missing share beside a high upright wall, integrated over the distance from its edge, in escape depths."""
STEEPEST = 1e3
FACETS = 0.15
"""Steps up to this share of the ball's radius are the facets of a smooth surface; twice as high, they are steps."""


def edge_response(glow: Array, strength: float) -> Array:
    """Gain by edges, ``1 + strength * glow``; strength 0 gives one."""
    return np.asarray(1.0 + strength * glow)


def edge_glow(buffer: SurfaceBuffer, pose: Pose, pixel_size_um: float, escape_depth_um: float) -> Array:
    """Share of the solid half ball of radius `escape_depth_um` that is missing, (rows, columns), NaN for a miss.

    It is 0 on any plane and in a hollow; ``(1 - s)^2 (2 + s) / 4`` at ``s`` escape depths from the edge of a high
    upright wall; and ``3/8`` of the escape depth times the mean curvature on a smooth ridge. The last two both
    integrate to something in proportion to the escape depth. So where the ball is too small for the grid a larger one
    is used and its answer scaled down: what a pixel shows is then the mean over the pixels round it.

    Parameters
    ----------
    pixel_size_um
        Step of the grid; under perspective this is its value at X_cam_z = 0.
    escape_depth_um
        How far below the surface electrons that still get out are set free.
    """
    glow = np.full(buffer.depth_um.shape, np.nan)
    if escape_depth_um <= 0:
        return np.where(buffer.miss, np.nan, 0.0)
    offsets, area, chord = _ball(escape_depth_um / pixel_size_um)
    # Mean |x| and |y| under the ball, halved, is what the strip beside an edge integrates to on this grid.
    strip_px = ((area * chord) @ np.abs(offsets)).mean() / 2 / (area @ chord)
    scale = STRIP * escape_depth_um / (strip_px * pixel_size_um)
    slopes = np.empty((*glow.shape, 2))

    def slope(start: int, stop: int) -> None:
        _slopes(start, stop, buffer.normal, pose.view_from_world, pixel_size_um, slopes)

    def missing(start: int, stop: int) -> None:
        _missing(start, stop, buffer.depth_um, slopes, offsets, area, chord * pixel_size_um, scale, glow)

    in_bands(len(glow), slope)
    in_bands(len(glow), missing)
    return glow


def _ball(radius_px: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Columns of pixels under a ball: offsets (n, 2) (right, down), areas (n,), and mean half chords (n,), px.

    Quarter turns take the columns to each other, so that planes cancel and no direction of the grid is favoured.
    """
    radius = max(radius_px, LEAST_REACH_PX)
    if radius > FULL_REACH_PX:
        share = (np.arange(SAMPLES) + 0.5) / SAMPLES
        angle = np.arange(SAMPLES) * GOLDEN_ANGLE
        x, y = (np.rint(radius * np.sqrt(share) * side) for side in (np.cos(angle), np.sin(angle)))
        offsets = np.concatenate([np.stack(turned, axis=1) for turned in ((x, y), (-y, x), (-x, -y), (y, -x))])
        return offsets.astype(np.int64), np.ones(len(offsets)), np.tile(radius * np.sqrt(1 - share), 4)
    side = np.arange(-int(radius + 0.5), int(radius + 0.5) + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    part = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    within = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2)
    squared = radius**2 - ((offsets[:, None] + within) ** 2).sum(axis=-1)
    area, volume = (squared > 0).mean(axis=1), np.sqrt(np.maximum(squared, 0.0)).mean(axis=1)
    under = area > 0
    return offsets[under], area[under], volume[under] / area[under]


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _slopes(
    start: int, stop: int, normal: Array, view_from_world: Array, pixel_size: float, slopes: Array
) -> None:  # pragma: no cover - compiled
    """Rise of the tangent planes for a pixel to the right and a pixel down, um."""
    view = np.empty(3)
    for row in range(start, stop):
        for column in range(normal.shape[1]):
            for i in range(3):
                view[i] = 0.0
                for j in range(3):
                    view[i] += view_from_world[i, j] * normal[row, column, j]
            upright = max(view[2], 1.0 / STEEPEST)
            slopes[row, column, 0] = -view[0] / upright * pixel_size
            slopes[row, column, 1] = view[1] / upright * pixel_size


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _missing(
    start: int,
    stop: int,
    depth: Array,
    slopes: Array,
    offsets: NDArray[np.int64],
    area: Array,
    half_chord: Array,
    scale: float,
    glow: Array,
) -> None:  # pragma: no cover - compiled
    rows, columns = depth.shape
    facets = FACETS * half_chord.max()
    whole = (area * half_chord).sum()  # under any tangent plane, because every offset has its opposite
    for row in range(start, stop):
        for column in range(columns):
            here = depth[row, column]
            if np.isnan(here):
                continue
            missing = 0.0
            for k in range(len(half_chord)):
                right, down = offsets[k]
                y, x = row + down, column + right
                if not (0 <= y < rows and 0 <= x < columns):
                    continue
                most = half_chord[k]
                tangent = slopes[row, column, 0] * right + slopes[row, column, 1] * down
                rise = -most
                if not np.isnan(depth[y, x]):
                    far = slopes[y, x, 0] * right + slopes[y, x, 1] * down
                    rise = _without_facets(here - depth[y, x], (tangent + far) / 2, facets)
                # Signed, so that a small misfit of the tangent plane cancels between opposite offsets.
                missing += area[k] * (min(max(tangent, -most), most) - min(max(rise, -most), most))
            glow[row, column] = scale * max(missing, 0.0) / whole


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _without_facets(rise: float, smooth: float, facets: float) -> float:  # pragma: no cover - compiled
    """Rise to a neighbour: by the slopes at both ends where the heights nearly agree, else by the heights.

    Triangles have all their curvature in their edges, which would glow; the normals spread it over the triangles.
    """
    step = min(max(np.abs(rise - smooth) / facets - 1.0, 0.0), 1.0)
    return float(smooth + step * (rise - smooth))
