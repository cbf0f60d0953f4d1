"""Pinhole cameras of unknown pose, as structure from motion for photographs has them, and their place in our frames.

A microscope with ``xy = centre + X_cam_xy / (pixel_size_um * (1 + k * X_cam_z))`` is a pinhole camera whose focal
length is ``1 / (k * pixel_size_um)`` px, standing 1/k in front of the specimen. A parallel projection is none; it is
nearly one with a very long focal length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array, Mask, Optics, PointCloud, Poses, TiltSeries
from semrecon.geometry import back_project, rotations_from_tilts

PASSES = 6
"""Of reweighting by depth in `intersect`: the algebraic error becomes the one in px."""
LEAST_RAY_PX2 = 1e-12
"""Smallest share of the third eigenvalue of a point's normal matrix: below, its beams do not differ."""


@dataclass(frozen=True)
class Pinholes:
    """Cameras of one focal length: ``xy = centre + focal * X_cam_xy / X_cam_z``, ``X_cam = R X + t``.

    Parameters
    ----------
    rotations, translations
        (views, 3, 3) and (views, 3), in an arbitrary frame and unit; NaN for a view that has not been placed.
    focal_px
        Focal length.
    centre_px
        Principal point, (2,).
    """

    rotations: Array
    translations: Array
    focal_px: float
    centre_px: Array

    def __len__(self) -> int:
        return len(self.rotations)

    @property
    def placed(self) -> Mask:
        """Views that have a pose, (views,)."""
        return np.asarray(np.isfinite(self.translations).all(axis=1))

    def in_camera(self, xyz: Array) -> Array:
        """Take points (n, 3) into the axes of every camera, (n, views, 3)."""
        return np.asarray(np.einsum("vij,nj->nvi", self.rotations, xyz) + self.translations)

    def project(self, xyz: Array) -> Array:
        """Where every view sees points (n, 3): (n, views, 2) px."""
        camera = self.in_camera(xyz)
        return np.asarray(self.centre_px + self.focal_px * camera[..., :2] / camera[..., 2:])


@dataclass(frozen=True)
class PinholeReconstruction:
    """Cameras and points in arbitrary units.

    Parameters
    ----------
    cameras
        A view that could not be placed is NaN.
    xyz, covariance
        (points, 3), and (points, 3, 3) for a noise of 1 px.
    xy_px
        Their sightings, (points, views, 2).
    start
        The pair that came first; None where that is not known.
    """

    cameras: Pinholes
    xyz: Array
    covariance: Array
    xy_px: Array
    start: tuple[int, int] | None = None

    @property
    def sigma_px(self) -> float:
        """Noise of a sighting per coordinate: a point of V sightings has 2 V numbers and takes three of them up."""
        views = np.isfinite(self.xy_px).all(axis=2).sum(axis=1)
        square = views * residual_px(self.xy_px, self.xyz, self.cameras) ** 2
        return float(np.sqrt(square.sum() / max(int((2 * views - 3).sum()), 1)))


def focal_length_px(optics: Optics, widths: float) -> float:
    """Focal length that the working distance means, or, where none is stated, so many image widths."""
    if optics.inverse_working_distance > 0:
        return 1 / (optics.inverse_working_distance * optics.pixel_size_um)
    return widths * optics.width_px


def intersect(xy_px: Array, cameras: Pinholes) -> tuple[Array, Array]:
    """Intersect beams by the linear method, reweighted until its error is the one in px (Hartley and Sturm 1997).

    Parameters
    ----------
    xy_px
        Sightings, (n, views, 2), NaN where missing; views that are not placed do not count.

    Returns
    -------
    Points (n, 3), and their covariances (n, 3, 3) for a noise of 1 px in exact cameras; NaN without two beams.
    """
    ray = (xy_px - cameras.centre_px) / cameras.focal_px
    rows = ray[..., None] * cameras.rotations[:, None, 2] - cameras.rotations[:, :2]
    right = cameras.translations[:, :2] - ray * cameras.translations[:, 2:]
    seen: Mask = np.asarray(np.isfinite(right).all(axis=2) & np.isfinite(rows).all(axis=(2, 3)))
    rows, right = np.where(seen[..., None, None], rows, 0.0), np.where(seen[..., None], right, 0.0)
    weights = np.where(seen, 1.0, 0.0)
    xyz, normal = _solved(rows, right, weights)
    for _ in range(PASSES):
        depth = np.where(seen, np.abs(cameras.in_camera(xyz)[..., 2]), np.inf)
        xyz, normal = _solved(rows, right, (cameras.focal_px / np.maximum(depth, 1e-12)) ** 2)
    strength = np.linalg.eigvalsh(normal)
    good = (seen.sum(axis=1) >= 2) & (strength[:, 0] > LEAST_RAY_PX2 * strength[:, 2])
    covariance = np.full(normal.shape, np.nan)
    covariance[good] = np.linalg.inv(normal[good])
    return np.where(good[:, None], xyz, np.nan), covariance


def _solved(rows: Array, right: Array, weights: Array) -> tuple[Array, Array]:
    normal = np.einsum("nv,nvci,nvcj->nij", weights, rows, rows)
    held = normal + 1e-15 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    force = np.einsum("nv,nvci,nvc->ni", weights, rows, right)
    return np.linalg.solve(held, force[..., None])[..., 0], normal


def residual_px(xy_px: Array, xyz: Array, cameras: Pinholes) -> Array:
    """Root-mean-square distance of sightings (n, views, 2) from where points (n, 3) are seen, (n,); NaN without any."""
    square = ((xy_px - cameras.project(xyz)) ** 2).sum(axis=2)
    seen = np.isfinite(square)
    mean = np.where(seen, square, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return np.asarray(np.where(seen.any(axis=1), np.sqrt(mean), np.nan))


def in_front(xyz: Array, cameras: Pinholes) -> Mask:
    """Tell which points lie in front of all placed cameras, (n,)."""
    return np.asarray((cameras.in_camera(xyz)[:, cameras.placed, 2] > 0).all(axis=1))


def in_series(series: TiltSeries, found: PinholeReconstruction) -> tuple[PointCloud, Poses]:
    """Bring a reconstruction in arbitrary units to um and to the world frame of a series.

    The camera of the reference view stands where its focal length and the pixel size put it: at the median depth of the
    points a pixel is as large as stated. The stated tilt of that view alone orients the world. Points are laid where
    the reference view sees them in the optics of the series, which may be parallel where the cameras are not.

    Returns
    -------
    Points, their median height along the reference beam 0, with the covariance of the matching noise in exact cameras;
    poses, NaN for views that have none.
    """
    view, optics, cameras = series.reference, series.optics, found.cameras
    camera = cameras.in_camera(found.xyz)[:, view]
    distance_um = cameras.focal_px * optics.pixel_size_um
    scale = distance_um / float(np.median(camera[:, 2]))
    frame = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[view]
    place = cameras.centre_px + cameras.focal_px * camera[:, :2] / camera[:, 2:]
    world = back_project(place, scale * camera[:, 2] - distance_um, frame, np.zeros(3), optics)
    turn = frame.T @ cameras.rotations[view]
    covariance = (found.sigma_px * scale) ** 2 * turn @ found.covariance @ turn.T
    residual = residual_px(found.xy_px, found.xyz, cameras)
    return PointCloud(world, covariance, residual, found.xy_px[:, view]), _poses(
        cameras, view, scale, distance_um, frame, parallel=optics.inverse_working_distance == 0
    )


def _poses(cameras: Pinholes, view: int, scale: float, distance_um: float, frame: Array, *, parallel: bool) -> Poses:
    """Poses in our axes, whose origin lies `distance_um` in front of the camera of the reference view."""
    relative = cameras.rotations @ cameras.rotations[view].T
    away = np.array([0.0, 0.0, distance_um])
    moved = cameras.translations - relative @ cameras.translations[view]
    shift = relative @ away + scale * moved - away
    if parallel:  # what the distance does to the magnification stays in the image plane; t_z is 0 by convention
        shift = shift / (1 + shift[:, 2:] / distance_um) * [1.0, 1.0, 0.0]
    return Poses(relative @ frame, shift)
