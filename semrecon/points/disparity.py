"""Depth from the disparity between two images of a tilted specimen: the printed formula, and the geometry put right.

Tilt steps by theta about an axis at phi in the image plane (0 is up). Along q, the image direction in which raised
features move as the tilt grows (columns at phi = 0, rows at phi = 90 degrees), the frame of view 1 gives
``q . m1 = X`` and ``q . m2 = X cos(theta) + h sin(theta) + t``; across q nothing moves. With the disparity
``d = q . (m2 - m1)``:

===========  =============================================  ===============================================
variant      height                                         holds
===========  =============================================  ===============================================
printed      h = d / (2 sin theta)                          for a total tilt of 2 theta, symmetric frame; with theta
                                                            the step between the images, it halves the depth
symmetric    h = (d - t) / (2 sin(theta / 2))               exactly, in the frame midway between the views
boyde        h = (d + X (1 - cos theta) - t) / sin(theta)   exactly, in the frame of view 1
===========  =============================================  ===============================================

All need parallel projection, one tilt axis, equal magnification. t, the shift of the stage, cannot be told from depth:
it is the gauge. Read literally, the printed variant also takes (x, y) from image 1 though its height belongs midway.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from semrecon.data import Array, Optics, PointCloud
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um, tilt_rotation

Variant = Literal["printed", "symmetric", "boyde"]
OffsetGauge = Literal["zero_median", "zero_mean"]

LEAST_SINE = 1e-6
"""Least sine of the tilt step: below, depth is a million times as noisy as the matches."""


@dataclass(frozen=True)
class DisparityCloud:
    """Points from disparity and the frame they are in.

    Parameters
    ----------
    points
        x right, y up, z to the gun. There is no reprojection error in this method: `residual_px` is NaN.
    frame_tilt_deg
        Tilt of the cloud's frame beyond view 1: theta / 2 for "symmetric", 0 for "boyde"; 0 for "printed" too, which
        claims the (x, y) of view 1.
    tilt_axis_deg
        Direction of the tilt axis, 0 is up.
    offset_um
        t, what was taken off the disparity to satisfy the gauge.
    """

    points: PointCloud
    frame_tilt_deg: float
    tilt_axis_deg: float
    offset_um: float

    def in_first_view(self) -> PointCloud:
        """Turn the points from the cloud's frame into the view frame of view 1."""
        turn = tilt_rotation(-self.frame_tilt_deg, self.tilt_axis_deg)
        p = self.points
        return PointCloud(p.xyz_um @ turn.T, turn @ p.covariance_um2 @ turn.T, p.residual_px, p.xy_px)


def disparity_cloud(
    xy1_px: Array,
    xy2_px: Array,
    tilt_step_deg: float,
    optics: Optics,
    *,
    variant: Variant = "printed",
    tilt_axis_deg: float = 0.0,
    gauge: OffsetGauge | float = "zero_median",
    sigma_px: float | Array = 1.0,
) -> DisparityCloud:
    """Map the disparity of matches to height: the control experiment of the seed (Rehman 2018).

    Parameters
    ----------
    xy1_px, xy2_px
        Matches, (n, 2) each; a match with a NaN becomes a NaN point.
    tilt_step_deg
        theta, tilt of view 2 beyond view 1, signed.
    variant
        Formula of the height, in the module's table.
    tilt_axis_deg
        Direction of the tilt axis, 0 is up.
    gauge
        Fixes t by the median or mean height being zero, or states it in um (0 takes the disparity as it is).
    sigma_px
        Standard deviation of a position per coordinate, for the covariance that the formula implies: a number or (n,).

    Raises
    ------
    InputError
        Shapes do not fit, or the projection is not parallel.
    MethodError
        No tilt step, or no match to fix the gauge by.
    """
    _check(xy1_px, xy2_px, tilt_step_deg, optics)
    theta = float(np.deg2rad(tilt_step_deg))
    rows, shift = _position_map(variant, theta, np.deg2rad(tilt_axis_deg))
    raw = np.hstack([centred_um(xy1_px, optics), centred_um(xy2_px, optics)]) @ rows.T
    offset = _offset(raw[:, 2] / shift[2], gauge)
    missing = np.asarray(~np.isfinite(raw).all(axis=1))
    xyz = np.where(missing[:, None], np.nan, raw - offset * shift)
    variance = np.broadcast_to((np.asarray(sigma_px) * optics.pixel_size_um) ** 2, len(xyz))
    covariances = np.where(missing[:, None, None], np.nan, variance[:, None, None] * (rows @ rows.T))
    points = PointCloud(xyz, covariances, np.full(len(xyz), np.nan), xy1_px)
    return DisparityCloud(points, tilt_step_deg / 2 if variant == "symmetric" else 0.0, tilt_axis_deg, offset)


def _position_map(variant: Variant, theta: float, phi: float) -> tuple[Array, Array]:
    """Matrix (3, 4) and vector (3,) of ``xyz = matrix @ (m1, m2) - t * vector``: every variant is linear."""
    q = np.array([np.cos(phi), np.sin(phi)])
    plane, plane_shift = np.hstack([np.eye(2), np.zeros((2, 2))]), np.zeros(2)
    if variant == "printed":
        height, gain = np.concatenate([-q, q]), 2 * np.sin(theta)
    elif variant == "boyde":
        height, gain = np.concatenate([-np.cos(theta) * q, q]), np.sin(theta)
    else:
        height, gain = np.concatenate([-q, q]), 2 * np.sin(theta / 2)
        middle = np.concatenate([q, q]) / (2 * np.cos(theta / 2))
        # along q the position midway between the views, across q that of image 1
        plane = plane - np.outer(q, q) @ plane + np.outer(q, middle)
        plane_shift = q / (2 * np.cos(theta / 2))
    up = np.array([1.0, -1.0])  # image rows grow downwards
    return np.vstack([up[:, None] * plane, height / gain]), np.append(up * plane_shift, 1 / gain)


def _offset(shifts_um: Array, gauge: OffsetGauge | float) -> float:
    """Stage shift t in um from the shift that would bring each point to height zero."""
    if not isinstance(gauge, str):
        return float(gauge)
    known = shifts_um[np.isfinite(shifts_um)]
    if not len(known):
        raise MethodError("disparity needs at least one complete match to fix the offset of heights, none found")
    return float(np.median(known) if gauge == "zero_median" else np.mean(known))


def _check(xy1_px: Array, xy2_px: Array, tilt_step_deg: float, optics: Optics) -> None:
    if xy1_px.ndim != 2 or xy1_px.shape[1] != 2 or xy1_px.shape != xy2_px.shape:
        raise InputError(f"matches must be two arrays of one shape (n, 2), not {xy1_px.shape} and {xy2_px.shape}")
    if optics.inverse_working_distance:
        raise InputError("disparity depth mapping is for parallel projection: set inverse_working_distance to 0")
    if not abs(np.sin(np.deg2rad(tilt_step_deg))) > LEAST_SINE:
        raise MethodError(f"a tilt step of {tilt_step_deg} degrees gives no disparity; the views must differ in tilt")
