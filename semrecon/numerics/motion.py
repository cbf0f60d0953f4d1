"""Rigid motions: apply, compose, invert, and fit to pairs of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array, PointCloud
from semrecon.errors import InputError


@dataclass(frozen=True)
class RigidMotion:
    """A change of frame, ``X_a = rotation @ X_b + translation``; name the value ``a_from_b``.

    Parameters
    ----------
    rotation
        (3, 3), proper.
    translation_um
        (3,).
    """

    rotation: Array
    translation_um: Array

    @staticmethod
    def identity() -> RigidMotion:
        """Leave every point where it is."""
        return RigidMotion(np.eye(3), np.zeros(3))

    def __matmul__(self, other: RigidMotion) -> RigidMotion:
        """Chain frames: ``a_from_c = a_from_b @ b_from_c``."""
        return RigidMotion(self.rotation @ other.rotation, self.rotation @ other.translation_um + self.translation_um)

    @property
    def inverse(self) -> RigidMotion:
        """``b_from_a`` of ``a_from_b``."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.translation_um)

    def apply(self, xyz_um: Array) -> Array:
        """Move points, (..., 3) um."""
        return np.asarray(xyz_um @ self.rotation.T + self.translation_um)

    def carry(self, cloud: PointCloud) -> PointCloud:
        """Move a cloud and turn its covariances.

        `xy_px` becomes NaN: the view that saw the points there is not the reference of the new frame.
        """
        covariance = self.rotation @ cloud.covariance_um2 @ self.rotation.T
        return PointCloud(self.apply(cloud.xyz_um), covariance, cloud.residual_px, np.full_like(cloud.xy_px, np.nan))


def rotation_angle_rad(rotation: Array) -> float:
    """Angle of a rotation matrix, 0 to pi, without the loss of digits that arccos has near 0 and pi.

    Twice the sine is the length of the vector of the antisymmetric part, twice the cosine is trace - 1; both are exact
    to rounding, so the angle is too, at any size.
    """
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return float(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1))


def fit_motion(moving_um: Array, fixed_um: Array) -> RigidMotion:
    """Fit the motion that brings paired points together with the least sum of squared distances.

    Parameters
    ----------
    moving_um, fixed_um
        (points, 3) each; row i of one belongs to row i of the other.

    Returns
    -------
    fixed_from_moving, a proper rotation even where a reflection would fit better.

    Raises
    ------
    InputError
        If there are fewer than three pairs.

    Notes
    -----
    Kabsch (1976) with the sign of Umeyama (1991), Eq. 40: the singular direction of least weight is turned round where
    the determinant would be -1.
    """
    if len(moving_um) < 3:
        raise InputError(f"a rigid motion needs at least three pairs of points, not {len(moving_um)}")
    moving_centre, fixed_centre = moving_um.mean(axis=0), fixed_um.mean(axis=0)
    u, _, vt = np.linalg.svd((fixed_um - fixed_centre).T @ (moving_um - moving_centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return RigidMotion(rotation, fixed_centre - rotation @ moving_centre)
