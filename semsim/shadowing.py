"""How much of the sky a place on the surface sees: pits are dark because their walls catch the electrons.

A horizon scan of the depth map, after the ambient-occlusion methods of computer graphics (Bavoil et al. 2008), told
apart by compass direction. It sees only what the beam sees: an overhang beside a place shades it like a solid wall.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Array
from semsim.microscope import Pose
from semsim.surface import SurfaceBuffer

DIRECTIONS = 8
STEPS = 16
GOLDEN = 0.6180339887498949


def sky_visibility(buffer: SurfaceBuffer, pose: Pose, pixel_size_um: float, reach_um: float) -> Array:
    """Share of the sky above the tangent plane that is open, (rows, columns), 1 on any plane, NaN for a miss.

    With ``h`` the angle by which the horizon in one direction rises over the tangent plane, the cosine-weighted share
    is ``cos(h)^2``, averaged over the directions. What a wall takes from it falls off as ``1 - (distance / reach)^2``,
    so that shadows begin softly. Places outside the picture count as open.

    Parameters
    ----------
    pixel_size_um
        Step of the grid; under perspective this is its value at X_cam_z = 0.
    reach_um
        How far to look.
    """
    normal = buffer.normal @ pose.view_from_world.T
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_x, slope_y = (-normal[..., k] / normal[..., 2] for k in (0, 1))
    reach_px = max(1.0, reach_um / pixel_size_um)
    offsets = _offsets(reach_px)
    height = -buffer.depth_um
    sky = np.full(height.shape, np.nan)

    def scan(row: int) -> None:
        _scan_row(row, height, slope_x, slope_y, offsets, pixel_size_um, reach_px, sky)

    # Threads of our own rather than numba's, whose threading layers differ from machine to machine.
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(scan, range(len(height))))
    return sky


def _offsets(reach_px: float) -> NDArray[np.int64]:
    """(directions, steps, 2) whole-pixel offsets (right, down), their length growing geometrically.

    Each direction has lengths of its own between those of the others, lest shadows end in common rings.
    """
    direction = np.arange(DIRECTIONS)
    angle, stagger = direction * (2 * np.pi / DIRECTIONS), direction * GOLDEN % 1
    length = np.minimum(reach_px ** ((np.arange(STEPS) + stagger[:, None]) / (STEPS - 1)), reach_px)
    compass = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.rint(length[..., None] * compass[:, None]), dtype=np.int64)


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _scan_row(
    row: int,
    height: Array,
    slope_x: Array,
    slope_y: Array,
    offsets: NDArray[np.int64],
    pixel_size: float,
    reach_px: float,
    sky: Array,
) -> None:  # pragma: no cover - compiled
    rows, columns = height.shape
    for column in range(columns):
        here = height[row, column]
        if np.isnan(here):
            continue
        total = 0.0
        for direction in range(offsets.shape[0]):
            open_share = 1.0
            for step in range(offsets.shape[1]):
                right, down = offsets[direction, step]
                y, x = row + down, column + right
                if not (0 <= y < rows and 0 <= x < columns):
                    break
                # A comparison with NaN (a miss there) is false, so the sky stays open.
                length = np.sqrt(float(right * right + down * down))
                tangent = (slope_x[row, column] * right - slope_y[row, column] * down) / length
                rise = (height[y, x] - here) / (length * pixel_size)
                if rise > tangent:
                    # tan(a - b) for a = atan(rise), b = atan(tangent); beyond a right angle nothing is open.
                    cosine = 1.0 + rise * tangent
                    share = cosine * cosine / ((1.0 + rise * rise) * (1.0 + tangent * tangent))
                    closed = (1.0 - (share if cosine > 0.0 else 0.0)) * max(0.0, 1.0 - (length / reach_px) ** 2)
                    open_share = min(open_share, 1.0 - closed)
            total += open_share
        sky[row, column] = total / offsets.shape[0]
