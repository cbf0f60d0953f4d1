"""The values that flow through a reconstruction: frozen data in, new data out.

Units stand in the names (um, px, deg, rad). Missing is NaN, never 0. Frames and signs: docs/conventions.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.errors import InputError

Array = NDArray[np.float64]
"""Numbers of the geometry: always float64."""
Image = NDArray[Any]
"""Grey values as recorded: (rows, columns), uint8, uint16 or float32."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Optics:
    """Pixel grid and projection of every view of a series.

    Parameters
    ----------
    pixel_size_um
        Edge of a pixel on the specimen plane through the world origin, um.
    width_px, height_px
        Columns and rows of every image.
    inverse_working_distance
        k of the projection ``xy = centre + X_cam_xy / (pixel_size_um * (1 + k * X_cam_z))``, 1/um; 0 is parallel
        projection, right at magnifications of 1000x and more.
    """

    pixel_size_um: float
    width_px: int
    height_px: int
    inverse_working_distance: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.pixel_size_um) and self.pixel_size_um > 0):
            raise InputError(f"pixel size must be a positive number of micrometres, not {self.pixel_size_um}")

    @property
    def centre_px(self) -> Array:
        """Pixel (column, row) to which the world origin projects in the reference view, shape (2,)."""
        return np.array([(self.width_px - 1) / 2, (self.height_px - 1) / 2])

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), as NumPy counts."""
        return self.height_px, self.width_px


@dataclass(frozen=True)
class View:
    """One micrograph of a series.

    Parameters
    ----------
    image
        Grey values as recorded, (rows, columns), read-only.
    tilt_deg
        Nominal stage tilt; the sign is that of docs/conventions.md.
    name
        What to call it in messages, usually the file name.
    mask
        True where the pixel may be used, (rows, columns); None means everywhere.
    channels
        Further detector signals recorded at the same pose, by name, each (rows, columns).
    stage_um
        Nominal stage position along camera x and y, um, such that a specimen moved by positive x appears farther
        right and one moved by positive y farther down; only differences between views mean anything. None is unknown.
    """

    image: Image
    tilt_deg: float
    name: str = ""
    mask: Mask | None = None
    channels: Mapping[str, Image] = field(default_factory=dict)
    stage_um: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 2:
            raise InputError(f"{self.name or 'a view'} must be one grey image, not of shape {self.image.shape}")
        if not np.isfinite(self.tilt_deg):
            raise InputError(f"{self.name or 'a view'} has no tilt angle; give one in degrees for every image")
        if self.stage_um is not None and not np.isfinite(self.stage_um).all():
            raise InputError(f"{self.name or 'a view'} has a stage position that is no pair of numbers; leave it out")


@dataclass(frozen=True)
class ChannelGeometry:
    """Where the detector of a channel nominally sits, seen from the specimen; fixed to the column, not to the stage.

    Parameters
    ----------
    azimuth_deg
        Direction towards it in the image, counter-clockwise from right as seen: 0 is right, 90 is up.
    elevation_deg
        Angle of that direction above the image plane: 0 is from the side, 90 along the beam. None is unknown.

    Raises
    ------
    InputError
        An angle that no detector can have.
    """

    azimuth_deg: float
    elevation_deg: float | None = None

    def __post_init__(self) -> None:
        if not abs(self.azimuth_deg) <= 360:
            raise InputError(f"azimuth_deg must be an angle from -360 to 360 degrees, not {self.azimuth_deg:g}")
        if self.elevation_deg is not None and not 0 <= self.elevation_deg <= 90:
            raise InputError(f"elevation_deg must be an angle from 0 to 90 degrees, not {self.elevation_deg:g}")

    @property
    def direction(self) -> Array:
        """Unit vector towards the detector in the view frame (x right, y up, z to the gun), (3,); NaN if unknown."""
        azimuth, elevation = np.deg2rad(
            [self.azimuth_deg, np.nan if self.elevation_deg is None else self.elevation_deg]
        )
        level = np.cos(elevation)
        return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


@dataclass(frozen=True)
class TiltSeries:
    """Micrographs of one specimen under different tilts. It has no field that could hold truth.

    Parameters
    ----------
    views
        In order of capture, all of the size that `optics` states.
    optics
        Pixel grid and projection.
    tilt_axis_deg
        Direction of the tilt axis in the image plane: 0 is up (world +y), 90 is right (world +x).
    channel_geometry
        Nominal direction of the detectors behind the views' `channels`, by the same names; those not known are absent.
    """

    views: tuple[View, ...]
    optics: Optics
    tilt_axis_deg: float = 0.0
    channel_geometry: Mapping[str, ChannelGeometry] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for view in self.views:
            if view.image.shape != self.optics.shape:
                raise InputError(
                    f"images must all have one size: {view.name or 'a view'} is "
                    f"{view.image.shape[1]} x {view.image.shape[0]} px, "
                    f"expected {self.optics.width_px} x {self.optics.height_px}"
                )

    def __len__(self) -> int:
        return len(self.views)

    @property
    def tilts_deg(self) -> Array:
        """Nominal tilt of every view, shape (views,)."""
        return np.array([view.tilt_deg for view in self.views], dtype=np.float64)

    @property
    def reference(self) -> int:
        """Index of the reference view: the one nearest zero tilt, the first of equals."""
        return int(np.argmin(np.abs(self.tilts_deg)))

    def select(self, *indices: int) -> TiltSeries:
        """Keep only the views named, in the order given."""
        return replace(self, views=tuple(self.views[i] for i in indices))


@dataclass(frozen=True)
class Poses:
    """Where the specimen stood in each view: ``X_cam = rotation @ X_world + translation``.

    Parameters
    ----------
    rotations
        R_cam_from_world, shape (views, 3, 3).
    translations_um
        Shape (views, 3); t_z is 0 under parallel projection, where it cannot be observed.
    """

    rotations: Array
    translations_um: Array

    def __len__(self) -> int:
        return len(self.rotations)


@dataclass(frozen=True)
class Tracks:
    """Image positions of the same specimen points over the views.

    Parameters
    ----------
    xy_px
        (tracks, views, 2) as (column, row); NaN where a view does not see the point.
    """

    xy_px: Array

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def seen(self) -> Mask:
        """True where a view sees the track, shape (tracks, views)."""
        return np.asarray(np.isfinite(self.xy_px).all(axis=2))


@dataclass(frozen=True)
class PointCloud:
    """Measured points.

    Parameters
    ----------
    xyz_um
        (points, 3), in the frame that the holder states (world unless said otherwise; z is up).
    covariance_um2
        Covariance of each point in the same frame, (points, 3, 3); NaN where unknown.
    residual_px
        Root-mean-square reprojection error of each point over its views, (points,); NaN where unknown.
    xy_px
        Where the reference view of the cloud sees each point, (points, 2); NaN where it does not.
    """

    xyz_um: Array
    covariance_um2: Array
    residual_px: Array
    xy_px: Array

    def __len__(self) -> int:
        return len(self.xyz_um)

    @property
    def sigma_um(self) -> Array:
        """One standard deviation of each point along z, (points,)."""
        return np.sqrt(self.covariance_um2[:, 2, 2])

    def keep(self, mask: NDArray[Any]) -> PointCloud:
        """Select points by a boolean mask or an index array."""
        return PointCloud(self.xyz_um[mask], self.covariance_um2[mask], self.residual_px[mask], self.xy_px[mask])


@dataclass(frozen=True)
class HeightMap:
    """Elevation along the beam of the reference view, on that view's pixel grid.

    Parameters
    ----------
    z_um
        (rows, columns), up is positive, NaN where nothing was measured; world z where the reference view has no tilt.
    sigma_um
        One standard deviation, (rows, columns), NaN where unknown.
    pixel_size_um
        Grid step.
    """

    z_um: Array
    sigma_um: Array
    pixel_size_um: float


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles: `vertices_um` (vertices, 3) in the world frame, `faces` (faces, 3), counter-clockwise from outside."""

    vertices_um: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Estimate:
    """What a method answers: any of points, heights and poses.

    Parameters
    ----------
    points
        Merged cloud in the world frame.
    heights
        Height map on the reference view.
    poses
        Estimated poses of all views.
    clouds
        Clouds of single pairs, each in the view frame of the pair's first view (`geometry.view_from_world`).
    pairs
        The view indices of each of `clouds`.
    ties
        Features that the poses rest on, in the world frame, where `points` are not those: their residuals tell how
        well the poses fit.
    diagnostics
        Counts, residuals, conditions: numbers and short words, ready for `report.json`.
    warnings
        Sentences that the user should read.
    """

    points: PointCloud | None = None
    heights: HeightMap | None = None
    poses: Poses | None = None
    clouds: tuple[PointCloud, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()
    ties: PointCloud | None = None
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
