"""Cameras of a tilt series with what may be wrong with them: tilt, axis, magnification, rotation in the plane, shift.

A point X of the world is seen in view v at (um from the image centre)::

    m_v = M_v T(w_v) p_v,     p_v = (P_v X + t_v) / (1 + k Z_v)

with P_v the first two rows of ``R_v = R(tilt_v, axis)``, Z_v the third, M_v the magnification and T(w_v) a turn in the
image plane by w_v from x towards y. M = 1 and w = 0 are the ideal camera of `geometry.project`; positions mapped back
to it by `Cameras.corrected` suit everything else in the package.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array, Optics, Poses, Tracks
from semrecon.geometry import CAM_FROM_VIEW, rotations_from_tilts

LOCAL = 5
"""Parameters of one view: t_x, t_y (um), tilt (rad), log magnification, turn (rad)."""
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
ABOUT_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Cameras:
    """Parameters of all views.

    Parameters
    ----------
    tilts_rad, log_magnifications, turns_rad
        One a view, (views,).
    axis_rad
        Direction of the tilt axis, common to all views.
    translations_um
        t_v, (views, 2); t_z is 0.
    """

    tilts_rad: Array
    axis_rad: float
    log_magnifications: Array
    turns_rad: Array
    translations_um: Array

    def __len__(self) -> int:
        return len(self.tilts_rad)

    @property
    def poses(self) -> Poses:
        """Poses of the ideal cameras, for tracks that are `corrected`."""
        rotations = rotations_from_tilts(np.rad2deg(self.tilts_rad), float(np.rad2deg(self.axis_rad)))
        return Poses(rotations, np.pad(self.translations_um, ((0, 0), (0, 1))))

    @property
    def magnifications(self) -> Array:
        """M_v, (views,)."""
        return np.asarray(np.exp(self.log_magnifications))

    @property
    def distortions(self) -> Array:
        """M_v T(w_v), (views, 2, 2)."""
        c, s = np.cos(self.turns_rad), np.sin(self.turns_rad)
        turns = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
        return np.asarray(self.magnifications[:, None, None] * turns)

    @property
    def vector(self) -> Array:
        """All parameters in a row: five a view, then the axis, (5 views + 1,)."""
        columns = [self.translations_um, self.tilts_rad, self.log_magnifications, self.turns_rad]
        return np.append(np.column_stack(columns).ravel(), self.axis_rad)

    def moved(self, step: Array) -> Cameras:
        """Add a step in the order of `vector`."""
        view = step[:-1].reshape(-1, LOCAL)
        return Cameras(
            self.tilts_rad + view[:, 2],
            self.axis_rad + float(step[-1]),
            self.log_magnifications + view[:, 3],
            self.turns_rad + view[:, 4],
            self.translations_um + view[:, :2],
        )

    def corrected(self, tracks: Tracks, optics: Optics) -> Tracks:
        """Positions that the ideal cameras would have seen: magnification and turn taken back."""
        (a, b), (c, d) = np.moveaxis(np.linalg.inv(self.distortions), 0, 2)
        x, y = np.moveaxis(tracks.xy_px - optics.centre_px, 2, 0)
        return Tracks(optics.centre_px + np.stack([a * x + b * y, c * x + d * y], axis=-1))


def sightings_and_derivatives(xyz_um: Array, cameras: Cameras, k: float) -> tuple[Array, Array, Array]:
    """Predict the sightings of points, with the derivatives by the points and by the cameras.

    Parameters
    ----------
    xyz_um
        (points, 3).
    k
        Inverse working distance, 1/um; 0 is parallel projection.

    Returns
    -------
    m_v in um from the image centre (points, views, 2), its derivative by the point (points, views, 2, 3), and by
    t_x, t_y, tilt, log magnification, turn and axis (points, views, 2, 6).
    """
    poses, distortions = cameras.poses, cameras.distortions
    by_tilt, by_axis = rotation_derivatives(cameras)
    shifted = _apply(poses.rotations, xyz_um) + poses.translations_um
    scale = 1 + k * shifted[..., 2]
    flat = shifted[..., :2] / scale[..., None]
    # d(flat) = (first two rows - k flat * third row) / scale: one map from any motion in camera axes to the image
    ideal = np.zeros((*flat.shape, 3))
    ideal[..., 0, 0] = ideal[..., 1, 1] = 1.0
    ideal[..., 2] = -k * flat
    image = (distortions @ ideal) / scale[..., None, None]
    seen = (distortions @ flat[..., None])[..., 0]
    motion = np.stack([_apply(by_tilt, xyz_um), _apply(by_axis, xyz_um)], axis=-1)
    moved = image @ motion
    cameras_columns = [image[..., :2], moved[..., :1], seen[..., None], (seen @ QUARTER.T)[..., None], moved[..., 1:]]
    return seen, image @ poses.rotations, np.concatenate(cameras_columns, axis=-1)


def _apply(matrices: Array, xyz_um: Array) -> Array:
    """Multiply all points by all matrices, (points, views, 3)."""
    return np.asarray((xyz_um @ matrices.reshape(-1, 3).T).reshape(len(xyz_um), len(matrices), 3))


def rotation_derivatives(cameras: Cameras) -> tuple[Array, Array]:
    """dR/d(tilt) and dR/d(axis), (views, 3, 3) each.

    With the axis in the plane at phi, ``tilt(phi) = Z(-phi) tilt(0) Z(phi)``, Z a turn about world z.
    """
    tilts = CAM_FROM_VIEW @ cameras.poses.rotations
    x, y = np.sin(cameras.axis_rad), np.cos(cameras.axis_rad)
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return CAM_FROM_VIEW @ cross @ tilts, CAM_FROM_VIEW @ (tilts @ ABOUT_Z - ABOUT_Z @ tilts)
