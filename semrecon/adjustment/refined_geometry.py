"""What a bundle adjustment answers: the geometry of a series, and how far to trust each number of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.adjustment.camera_model import Cameras
from semrecon.data import Array, PointCloud, Poses, Tracks


@dataclass(frozen=True)
class Refinement:
    """Refined geometry of a series with its uncertainty.

    Parameters
    ----------
    poses
        Of ideal cameras: they fit `tracks`, not the positions as measured.
    tracks
        Positions with magnification and rotation in the plane taken back, NaN where a sighting was left out.
    tilts_deg, magnifications, rotations_deg, tilt_axis_deg
        One a view (views,), and the axis common to all. Rotation counts from x to y of the image (clockwise as seen).
    shifts_um
        t_x, t_y of every view, (views, 2).
    tilt_covariance_deg2
        (views, views). Tilts share the uncertainty of their mean, so differences are better known than each.
    tilt_sigma_deg, magnification_sigma, rotation_sigma_deg, shift_sigma_um, axis_sigma_deg
        Posterior standard deviations, 0 for what is held.
    points
        One a track in the world frame, NaN where left out. Covariances hold the matching noise and the uncertainty of
        the cameras: the exact block of the inverse normal matrix, to first order, the mean depth being held.
    sigma_px
        Noise of a sighting per coordinate, as estimated.
    unobservable
        Sentences: what the images do not say, and what holds it.
    cameras, covariance
        All parameters as one, and the covariance of `Cameras.vector`, (5 views + 1, 5 views + 1): 0 for what is held.
    iterations, converged
        Gauss-Newton steps taken, and whether the last one was negligible.
    history_px
        Root-mean-square distance of the sightings that count, by their weights, from their reprojections: before the
        first step and after each of them. It may rise where the weights change.
    """

    poses: Poses
    tracks: Tracks
    tilts_deg: Array
    tilt_axis_deg: float
    magnifications: Array
    rotations_deg: Array
    shifts_um: Array
    tilt_covariance_deg2: Array
    tilt_sigma_deg: Array
    axis_sigma_deg: float
    magnification_sigma: Array
    rotation_sigma_deg: Array
    shift_sigma_um: Array
    points: PointCloud
    sigma_px: float
    unobservable: tuple[str, ...]
    cameras: Cameras
    covariance: Array
    iterations: int
    converged: bool
    history_px: tuple[float, ...] = ()

    @property
    def tilt_step_sigma_deg(self) -> Array:
        """Standard deviation of the step from each view to the next, (views - 1,)."""
        c = self.tilt_covariance_deg2
        return np.asarray(np.sqrt(np.maximum(np.diag(c)[1:] + np.diag(c)[:-1] - 2 * np.diag(c, 1), 0.0)))
