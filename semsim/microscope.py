"""The microscope's geometry: pixel grid, stage, and the ray that each pixel sends into the specimen.

Frames and signs are those of docs/conventions.md. This is semsim's own projection, shared with no reconstruction code.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from semsim.errors import InputError
from semsim.imperfections import StageErrors, ViewErrors, draw
from semsim.mesh import Array

PRINT_WIDTH_UM = 127_000.0
"""Width of the print that a stated magnification refers to where nothing else is said: a 5 inch Polaroid."""
UM_PER_INCH = 25_400.0
EXACT_STAGE, EXACT_VIEWS = StageErrors(), ViewErrors()


@dataclass(frozen=True)
class Microscope:
    """Pixel grid and projection of every view.

    Parameters
    ----------
    pixel_size_um
        Edge of a pixel on the plane X_cam_z = 0, um.
    width_px, height_px
        Columns and rows.
    working_distance_um
        Distance from the pivot of the scan to the plane X_cam_z = 0, um; None is parallel projection.

    Raises
    ------
    InputError
        A size is not a positive finite number.
    """

    pixel_size_um: float
    width_px: int
    height_px: int
    working_distance_um: float | None = None

    def __post_init__(self) -> None:
        _require_positive(pixel_size_um=self.pixel_size_um, width_px=self.width_px, height_px=self.height_px)
        if self.working_distance_um is not None:
            _require_positive(working_distance_um=self.working_distance_um)

    @classmethod
    def from_data_bar(cls, bar_um: float, bar_px: float, width_px: int, height_px: int) -> Self:
        """Take the pixel size from a data bar that is `bar_um` long and covers `bar_px` pixels."""
        _require_positive(bar_um=bar_um, bar_px=bar_px)
        return cls(bar_um / bar_px, width_px, height_px)

    @classmethod
    def from_magnification(
        cls, magnification: float, width_px: int, height_px: int, print_width_um: float = PRINT_WIDTH_UM
    ) -> Self:
        """Take the pixel size from a magnification, which is the width of a print over the width of the field."""
        _require_positive(magnification=magnification, print_width_um=print_width_um, width_px=width_px)
        return cls(print_width_um / magnification / width_px, width_px, height_px)

    @property
    def inverse_working_distance(self) -> float:
        """Return k of the projection, 1/um; 0 is parallel."""
        return 0.0 if self.working_distance_um is None else 1.0 / self.working_distance_um

    @property
    def centre_px(self) -> Array:
        """Pixel (column, row) on the optical axis, shape (2,)."""
        return np.array([(self.width_px - 1) / 2, (self.height_px - 1) / 2])

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), as NumPy counts."""
        return self.height_px, self.width_px


@dataclass(frozen=True)
class TiltSchedule:
    """What the stage is told to do: one tilt a view, about one axis, and a shift where one is wanted.

    Tilts that are all equal, with shifts that are not, make a translation series; it has parallax in perspective only.

    Parameters
    ----------
    tilts_deg
        Stage tilt of each view, degrees, right-handed about the axis.
    tilt_axis_deg
        0 is world +y (image up), 90 is world +x (image right).
    shifts_um
        Shift of the specimen in each view along camera x and y, um; empty is none at all.

    Raises
    ------
    InputError
        No tilt, a tilt at or beyond 90 degrees, or another number of shifts than of tilts.
    """

    tilts_deg: tuple[float, ...]
    tilt_axis_deg: float = 0.0
    shifts_um: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if not self.tilts_deg:
            raise InputError("tilts_deg must hold one angle in degrees for every view; it is empty")
        if not all(abs(tilt) < 90 for tilt in self.tilts_deg):
            raise InputError(f"tilts_deg must lie between -90 and 90 degrees, not {list(self.tilts_deg)}")
        if self.shifts_um and len(self.shifts_um) != len(self.tilts_deg):
            raise InputError(
                f"shifts_um must hold one (x, y) for each of the {len(self.tilts_deg)} tilts, not {len(self.shifts_um)}"
            )
        if not np.isfinite([self.tilt_axis_deg, *np.ravel(self.shifts_um)]).all():
            raise InputError("tilt_axis_deg and shifts_um must be finite numbers")

    @property
    def reference(self) -> int:
        """Index of the reference view: the one nearest zero tilt, the first of equals."""
        return int(np.argmin(np.abs(self.tilts_deg)))


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the specimen stands in one view, and how its picture is bent.

    ``X_cam = rotation @ X_world + translation_um``

    Parameters
    ----------
    rotation
        R_cam_from_world, (3, 3).
    translation_um
        (3,); its z is 0 unless the tilt axis passes the world origin by.
    distortion
        (2, 2) map of image offsets from the centre, from what the projection says to what the column does; the
        identity by default.
    """

    rotation: Array
    translation_um: Array
    distortion: Array = field(default_factory=lambda: np.eye(2))

    @property
    def distorted(self) -> bool:
        """Whether the picture is bent at all."""
        return not np.array_equal(self.distortion, np.eye(2))

    @property
    def view_from_world(self) -> Array:
        """R_view_from_world, (3, 3): the view frame has x right, y up and z to the gun."""
        return np.asarray(self.rotation * np.array([[1.0], [-1.0], [-1.0]]))


def poses(
    schedule: TiltSchedule,
    stage: StageErrors = EXACT_STAGE,
    views: ViewErrors = EXACT_VIEWS,
    rng: np.random.Generator | None = None,
) -> tuple[Pose, ...]:
    """Work out the true pose of every view of a schedule, in its order; without errors they are the nominal ones.

    Parameters
    ----------
    rng
        For the errors that are drawn; None is a generator seeded with 0.

    Raises
    ------
    InputError
        Errors are stated for another number of views, or lead to a tilt at or beyond 90 degrees.
    """
    number = len(schedule.tilts_deg)
    errors = draw(stage, views, number, np.random.default_rng(0) if rng is None else rng)
    tilts = np.asarray(schedule.tilts_deg) + errors.tilts_deg
    if not (np.abs(tilts) < 90).all():
        raise InputError(f"true tilts must lie between -90 and 90 degrees; stage_errors make them {tilts.tolist()}")
    shifts = np.array(schedule.shifts_um or ((0.0, 0.0),) * number, dtype=np.float64)  # whole numbers also
    shifts += np.where(np.arange(number)[:, None] == schedule.reference, 0.0, errors.shifts_um)
    rotations = [_camera_rotation(tilt, schedule.tilt_axis_deg + stage.tilt_axis_deg) for tilt in tilts]
    return tuple(
        Pose(rotation, np.array([*shift, 0.0]) + _swing(rotation, stage.axis_point_um), distortion)
        for rotation, shift, distortion in zip(rotations, shifts, errors.distortions, strict=True)
    )


def pixel_grid(microscope: Microscope) -> Array:
    """Where the beam dwells for each pixel: (rows, columns, 2) image positions (column, row), px.

    A scan error is a displacement of this array before the rays are cast, never of the finished picture.
    """
    columns, rows = np.meshgrid(np.arange(microscope.width_px), np.arange(microscope.height_px))
    return np.stack([columns, rows], axis=-1).astype(np.float64)


def pixel_rays(microscope: Microscope, pose: Pose, xy_px: Array) -> tuple[Array, Array]:
    """Rays of the beam through image positions.

    The projection solved for X_cam is ``X_cam_xy = q (1 + k X_cam_z)``, with ``q = (xy - centre) * pixel_size_um``
    after the distortion is undone: a line from (q, 0) along (k q, 1).

    Parameters
    ----------
    xy_px
        (..., 2) positions (column, row), px.

    Returns
    -------
    origins_um, directions
        (..., 3) each, world frame; X_cam_z is 0 at the origin and grows by 1 um a unit of direction.
    """
    q = (np.asarray(xy_px, dtype=np.float64) - microscope.centre_px) * microscope.pixel_size_um
    if pose.distorted:
        q = q @ np.linalg.inv(pose.distortion).T
    origins = (_with_z(q, 0.0) - pose.translation_um) @ pose.rotation
    if microscope.working_distance_um is None:
        return origins, np.broadcast_to(pose.rotation[2], origins.shape)
    return origins, _with_z(q * microscope.inverse_working_distance, 1.0) @ pose.rotation


def project(microscope: Microscope, pose: Pose, xyz_um: Array) -> Array:
    """Image positions of world points: ``xy = centre + D X_cam_xy / (pixel_size_um (1 + k X_cam_z))``.

    D is the distortion of the view. The scan is not in it: this is where the beam is, not what pixel records it.

    Parameters
    ----------
    xyz_um
        (..., 3), world frame; NaN stays NaN.

    Returns
    -------
    (..., 2) positions (column, row), px.
    """
    camera = camera_from_world(pose, xyz_um)
    size_um = microscope.pixel_size_um * (1 + microscope.inverse_working_distance * camera[..., 2:])
    offset = camera[..., :2] / size_um
    return np.asarray((offset @ pose.distortion.T if pose.distorted else offset) + microscope.centre_px)


def camera_from_world(pose: Pose, xyz_um: Array) -> Array:
    """Camera coordinates (x right, y down, z along the beam), um, of world points (..., 3)."""
    return np.asarray(xyz_um @ pose.rotation.T + pose.translation_um)


def _camera_rotation(tilt_deg: float, tilt_axis_deg: float) -> Array:
    """R_cam_from_world: turn the axis to +y, tilt about +y, turn back; then y and z change sign."""
    tilt, axis = np.deg2rad([tilt_deg, tilt_axis_deg])
    c, s, ca, sa = np.cos(tilt), np.sin(tilt), np.cos(axis), np.sin(axis)
    about_y = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    axis_to_y = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(np.diag([1.0, -1.0, -1.0]) @ axis_to_y.T @ about_y @ axis_to_y)


def _swing(rotation: Array, axis_point_um: tuple[float, float, float]) -> Array:
    """Translate (3,), camera frame, so that a point of the tilt axis stays where zero tilt has it."""
    point = np.asarray(axis_point_um)
    return np.asarray(np.diag([1.0, -1.0, -1.0]) @ point - rotation @ point)


def _with_z(xy: Array, z: float) -> Array:
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1)


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number, not {value}")
