"""How much of the sky a place on the surface sees: pits are dark because their walls catch the electrons.

A horizon scan of the depth map, told apart by compass direction (Bavoil et al. 2008), with the cosine-weighted sky in
the slice of each direction in closed form (Jimenez et al. 2016). It sees only what the beam sees: an overhang beside a
place shades it like a solid wall, and what lies under one is not known.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semsim.bands import in_bands
from semsim.mesh import Array
from semsim.microscope import Pose
from semsim.surface import SurfaceBuffer

DIRECTIONS = 8
STEPS = 16
GOLDEN = 0.6180339887498949
EDGE_ON = 1e-3
"""Least cosine between normal and beam that is reckoned with: interpolated normals can turn away from the gun."""
JOINT = 0.25 * np.pi / 0.7854096
"""Makes the polynomial for the arc tangent meet its own continuation at 1."""


def sky_visibility(buffer: SurfaceBuffer, pose: Pose, pixel_size_um: float, reach_um: float) -> Array:
    """Share of the sky above the tangent plane that is open, (rows, columns), 1 on any plane, NaN for a miss.

    The sky is weighted with the cosine to the normal, as electrons leave a surface. In each direction the horizon takes
    from it all that lies below; what rises over the nearer horizon at some distance takes its part with the weight
    ``1 - (distance / reach)^2``, so that shadows begin softly. Places outside the picture count as open.

    Against rays cast at the mesh (256 a place, the same weight at their first hit, noise 0.01) the RMS error is 0.02 on
    a diatom and 0.06 on a pollen grain with its overhangs, the median error 0.008 and 0.02. Denser scans do no better.

    Parameters
    ----------
    pixel_size_um
        Step of the grid; under perspective this is its value at X_cam_z = 0.
    reach_um
        How far to look.
    """
    reach_px = max(1.0, reach_um / pixel_size_um)
    offsets = _offsets(reach_px)
    sky = np.empty(buffer.face.shape)
    in_bands(
        len(sky),
        lambda top, bottom: _scan(
            top, bottom, buffer.depth_um, buffer.normal, pose.view_from_world, offsets, pixel_size_um, reach_px, sky
        ),
    )
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
def _scan(
    top: int,
    bottom: int,
    depth: Array,
    normal: Array,
    view_from_world: Array,
    offsets: NDArray[np.int64],
    pixel_size: float,
    reach_px: float,
    sky: Array,
) -> None:  # pragma: no cover - compiled
    """Scan some rows. All columns take each step together, which compiles to vector instructions."""
    rows, columns = depth.shape
    nx, ny, nz, lateral = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    horizon, left, whole, closed = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    for row in range(top, bottom):
        for x in range(columns):
            nx[x], ny[x], nz[x] = 0.0, 0.0, 0.0
            for k in range(3):
                nx[x] += view_from_world[0, k] * normal[row, x, k]
                ny[x] += view_from_world[1, k] * normal[row, x, k]
                nz[x] += view_from_world[2, k] * normal[row, x, k]
            nz[x] = EDGE_ON if nz[x] < EDGE_ON else nz[x]
        whole[:], closed[:] = 0.0, 0.0
        for direction in range(offsets.shape[0]):
            angle = direction * 2 * np.pi / offsets.shape[0]
            right_share, up_share = np.cos(angle), -np.sin(angle)
            for x in range(columns):
                lateral[x] = nx[x] * right_share + ny[x] * up_share
                horizon[x] = -lateral[x] / nz[x]
                left[x] = _sky_above(horizon[x], lateral[x], nz[x])
                whole[x] += left[x]
            for step in range(offsets.shape[1]):
                right, down = offsets[direction, step]
                first, end = max(0, -right), min(columns, columns - right)
                if first >= end or not 0 <= row + down < rows:
                    break
                length = np.sqrt(float(right * right + down * down))
                _step(
                    depth[row, first:end],
                    depth[row + down, first + right : end + right],
                    nx[first:end],
                    ny[first:end],
                    nz[first:end],
                    right / length - right_share,
                    -down / length - up_share,
                    1.0 / (length * pixel_size),
                    max(0.0, 1.0 - (length / reach_px) ** 2),
                    lateral[first:end],
                    horizon[first:end],
                    left[first:end],
                    closed[first:end],
                )
        for x in range(columns):
            sky[row, x] = 1.0 - closed[x] / whole[x]


@numba.njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _step(
    here: Array,
    there: Array,
    nx: Array,
    ny: Array,
    nz: Array,
    astray_right: float,
    astray_up: float,
    per_um: float,
    weight: float,
    lateral: Array,
    horizon: Array,
    left: Array,
    closed: Array,
) -> None:  # pragma: no cover - compiled
    """Raise the horizon of a row of places to the depths `there`, one step away, and close the sky that this takes.

    A whole-pixel step strays from its direction; what the tangent plane gains by that is taken from the rise, so that
    a plane never shades itself. A comparison with NaN (a miss there) is false: the horizon stays where it is.
    """
    for x in range(len(closed)):
        gain = -(nx[x] * astray_right + ny[x] * astray_up) / nz[x]
        rise = (here[x] - there[x]) * per_um - gain
        above = _sky_above(rise, lateral[x], nz[x])
        higher = rise > horizon[x]
        closed[x] += weight * (left[x] - above) if higher else 0.0
        left[x] = above if higher else left[x]
        horizon[x] = rise if higher else horizon[x]


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _sky_above(rise: float, lateral: float, upward: float) -> float:  # pragma: no cover - compiled
    """Cosine-weighted sky over a horizon of slope `rise`, in a slice where the normal is (`lateral`, `upward`).

    With t the angle from zenith to horizon, the integral of ``(lateral sin + upward cos) sin`` from 0 to t.
    The arc tangent is the polynomial of Abramowitz and Stegun 4.4.49, good to 3e-5, which vector units can do.
    """
    steep = abs(rise) > 1.0
    u = (1.0 if steep else rise) / (rise if steep else 1.0)
    uu = u * u
    arc = JOINT * u * (0.9998660 + uu * (-0.3302995 + uu * (0.1801410 + uu * (-0.0851330 + uu * 0.0208351))))
    turn = np.pi if rise < 0.0 else 0.0
    zenith = turn + arc if steep else 0.5 * np.pi - arc
    squared = 1.0 / (1.0 + rise * rise)
    return 0.5 * (lateral * (zenith - rise * squared) + upward * squared)
