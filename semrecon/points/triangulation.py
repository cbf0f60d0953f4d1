"""Points from sightings in two or more views of known pose (Eq. 6), with what they are worth.

Under parallel projection the equations of Eq. 6 are linear in the point, and with the noise of each sighting as weight
their normal equations are its maximum likelihood. Under perspective Gauss-Newton takes over from there; k Z is a few
thousandths, so it settles in a few steps.

For two views, what the second pair of equations adds is known in closed form: the epipolar mismatch of a match,
``delta = p . c_i - t_p``, is shared out evenly, delta / 2 in either image and at right angles to the parallax, and the
depth is that of the linear system (Eqs. 4, 5), untouched. Errors along the epipolar line leave no residual at all.
"""

from __future__ import annotations

import numpy as np

from semrecon.data import Array, Optics, PointCloud, Poses, Tracks
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, project
from semrecon.points.beams import Views, lengths_px, newton_step, parallel_intersection, views_of

GAUSS_NEWTON_STEPS = 8
SETTLED_UM = 1e-12


def triangulate(
    tracks: Tracks, poses: Poses, optics: Optics, *, sigma_px: float | Array = 1.0, reference: int = 0
) -> PointCloud:
    """Intersect the beams of every track by weighted least squares.

    Parameters
    ----------
    tracks
        Sightings, NaN where missing.
    poses
        One for each view of the tracks.
    sigma_px
        Standard deviation of a sighting per coordinate: a number, (views,), (tracks, 1) or (tracks, views).
    reference
        View whose positions become `xy_px` of the cloud.

    Returns
    -------
    Points in the world frame. Covariance is ``(J^T J / sigma_px^2)^-1``: that of the matching noise, for exact poses.
    Residual is the root of the mean squared distance over the views that see the point. A point without two
    different beams is NaN throughout.

    Raises
    ------
    InputError
        Shapes do not fit, or a standard deviation is not positive.
    """
    weights, views = _weights(tracks, poses, sigma_px), views_of(poses, optics)
    xyz, covariance = intersect(tracks.xy_px, weights, views)
    return PointCloud(xyz, covariance, rms(lengths_px(tracks.xy_px, xyz, views)), tracks.xy_px[:, reference])


def residuals_px(tracks: Tracks, xyz_um: Array, poses: Poses, optics: Optics) -> Array:
    """Sighting minus reprojection, px, (tracks, views, 2); NaN where a view does not see the point."""
    views = zip(poses.rotations, poses.translations_um, strict=True)
    return tracks.xy_px - np.stack([project(xyz_um, rotation, t, optics) for rotation, t in views], axis=1)


def pair_cloud(
    xy1_px: Array,
    xy2_px: Array,
    rotation: Array,
    translation_um: Array,
    optics: Optics,
    *,
    sigma_px: float | Array = 1.0,
) -> PointCloud:
    """Triangulate a pair in its own frame, the seed's step 5: camera 1 is the identity, camera 2 the relative pose.

    Parameters
    ----------
    xy1_px, xy2_px
        Matches, (n, 2) each; NaN where missing.
    rotation
        R_2 R_1^T in camera axes, (3, 3).
    translation_um
        (t_x, t_y) of view 2 in camera axes, (2,) or with t_z (3,); from `translation.solve_closed_form`.

    Returns
    -------
    Points in the view frame of the first view: x right, y up, z to the gun, the image centre at the origin.
    """
    rotations = np.stack([CAM_FROM_VIEW, rotation @ CAM_FROM_VIEW])
    second = np.pad(translation_um, (0, 3 - len(translation_um)))
    poses = Poses(rotations, np.stack([np.zeros(3), second]))
    return triangulate(Tracks(np.stack([xy1_px, xy2_px], axis=1)), poses, optics, sigma_px=sigma_px)


def _weights(tracks: Tracks, poses: Poses, sigma_px: float | Array) -> Array:
    """Inverse variance of each sighting, 1/px^2, 0 where it is missing, (tracks, views)."""
    shape, sigma = tracks.xy_px.shape[:2], np.asarray(sigma_px, dtype=np.float64)
    if shape[1] != len(poses):
        raise InputError(f"tracks cover {shape[1]} views, but there are {len(poses)} poses")
    if sigma.ndim > 2 or any(have not in (1, want) for have, want in zip(sigma.shape[::-1], shape[::-1], strict=False)):
        raise InputError(f"sigma_px of shape {sigma.shape} does not fit {shape[0]} tracks in {shape[1]} views")
    if not (sigma > 0).all():
        raise InputError("sigma_px must be positive everywhere")
    return np.where(tracks.seen, 1 / sigma**2, 0.0)


def intersect(xy_px: Array, weights: Array, views: Views) -> tuple[Array, Array]:
    """Intersect the beams: positions (points, 3) and covariances (points, 3, 3) of weighted sightings, NaN if singular.

    Parameters
    ----------
    xy_px, weights, views
        As for `beams.newton_step`.
    """
    xyz, covariance, fixed = parallel_intersection(xy_px, weights, views)
    if views.k:
        for _ in range(GAUSS_NEWTON_STEPS):
            before = xyz
            xyz, covariance, fixed = newton_step(xy_px, weights, before, views)
            if np.abs(xyz - before).max(initial=0.0) <= SETTLED_UM:
                break
    xyz[~fixed], covariance[~fixed] = np.nan, np.nan
    return xyz, covariance


def rms(lengths: Array) -> Array:
    """Root-mean-square over the views that see the point; NaN where there is no point."""
    seen = np.isfinite(lengths)
    mean = np.where(seen, lengths**2, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return np.asarray(np.where(seen.any(axis=1), np.sqrt(mean), np.nan))
