"""Projection and rotations: semrecon's own few lines, shared with nobody (docs/adr/0001)."""

from __future__ import annotations

import numpy as np

from semrecon.data import Array, Optics, Poses, TiltSeries

CAM_FROM_VIEW = np.diag([1.0, -1.0, -1.0])
"""Camera axes (x right, y down, z along the beam) from view axes (x right, y up, z to the gun)."""


def tilt_rotation(tilt_deg: float, tilt_axis_deg: float = 0.0) -> Array:
    """R_view_from_world of a stage tilt: right-handed, about an axis in the image plane.

    The axis is (sin phi, cos phi, 0) in world axes: phi = 0 is +y (up), phi = 90 degrees is +x (right).
    At phi = 0, ``x' = x cos + z sin``: what is raised moves right as the tilt grows.

    Returns
    -------
    (3, 3) rotation by Rodrigues' formula.
    """
    tilt, phi = np.deg2rad(tilt_deg), np.deg2rad(tilt_axis_deg)
    x, y = np.sin(phi), np.cos(phi)
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * (cross @ cross))


def rotations_from_tilts(tilts_deg: Array, tilt_axis_deg: float = 0.0) -> Array:
    """R_cam_from_world of every tilt, (views, 3, 3): the seed's "known rotation"."""
    return np.stack([CAM_FROM_VIEW @ tilt_rotation(float(tilt), tilt_axis_deg) for tilt in tilts_deg])


def nominal_poses(series: TiltSeries) -> Poses:
    """Poses as the stage states them: rotations from the tilts, no translation."""
    rotations = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)
    return Poses(rotations, np.zeros((len(series), 3)))


def project(xyz_um: Array, rotation: Array, translation_um: Array, optics: Optics) -> Array:
    """Project world points: ``xy = centre + X_cam_xy / (pixel_size_um * (1 + k * X_cam_z))`` (Eqs. 1, 2).

    Parameters
    ----------
    xyz_um
        (..., 3) in the world frame.
    rotation, translation_um
        R_cam_from_world (3, 3) and t (3,).

    Returns
    -------
    (..., 2) pixel positions (column, row).
    """
    cam = xyz_um @ rotation.T + translation_um
    scale = optics.pixel_size_um * (1 + optics.inverse_working_distance * cam[..., 2:])
    return np.asarray(optics.centre_px + cam[..., :2] / scale)


def back_project(xy_px: Array, depth_um: Array, rotation: Array, translation_um: Array, optics: Optics) -> Array:
    """World points from pixels and depth along the beam, the inverse of `project`.

    Parameters
    ----------
    xy_px
        (..., 2); `depth_um` (...) is X_cam_z, positive into the specimen.

    Returns
    -------
    (..., 3) in the world frame.
    """
    scale = optics.pixel_size_um * (1 + optics.inverse_working_distance * depth_um[..., None])
    cam = np.concatenate([(xy_px - optics.centre_px) * scale, depth_um[..., None]], axis=-1)
    return np.asarray((cam - translation_um) @ rotation)


def centred_um(xy_px: Array, optics: Optics) -> Array:
    """Pixels as lengths from the image centre (Eq. 3 with the principal point): (..., 2) um, x right, y down."""
    return np.asarray((xy_px - optics.centre_px) * optics.pixel_size_um)


def view_from_world(rotation: Array) -> Array:
    """R_view_from_world of a pose: the view frame has z to the gun and equals the world frame at zero tilt, (3, 3)."""
    return np.asarray(CAM_FROM_VIEW @ rotation)
