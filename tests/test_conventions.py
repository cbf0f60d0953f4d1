"""Where the two projections meet: a ray of semsim hits the mesh, and semrecon must project the hit back to the pixel.

Nowhere else may both be imported for their geometry. The signs are those of docs/conventions.md, stated here once
more as numbers, so that two packages that agree with each other but not with the page are found out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from semrecon import geometry
from semrecon.data import Array, Image, Optics, TiltSeries, View
from semsim import microscope as scope
from semsim.imperfections import StageErrors, ViewErrors
from semsim.mesh import Mesh
from semsim.raycast import RayCaster
from semsim.scan import ScanOptions, beam_positions, scan_offsets
from semsim.surface import surface_buffer
from semsim.truth import GroundTruth

WIDTH_PX, HEIGHT_PX, PIXEL_UM = 64, 48, 0.25
CLOSEST_PX = 1e-6


def hills(relief_um: float) -> Mesh:
    """Return an uneven sheet, wider than any tilted view of it, without a symmetry in which a sign could hide."""
    x, y = np.meshgrid(np.linspace(-40, 40, 60), np.linspace(-40, 40, 60))
    z = relief_um * (
        np.sin(0.31 * x + 0.4) * np.cos(0.23 * y - 0.9) + 0.05 * x / 4 + 0.3 * np.exp(-((x - 2) ** 2) - y**2)
    )
    corner = (np.arange(59)[:, None] * 60 + np.arange(59)).ravel()
    lower, upper = [corner, corner + 1, corner + 61], [corner, corner + 61, corner + 60]
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), np.stack([*lower, *upper], axis=-1).reshape(-1, 3))


MESH = hills(3.0)
CASTER = RayCaster(MESH)


@dataclass(frozen=True)
class Stand:
    """One view, told to both packages in the words of each."""

    tilt_deg: float
    axis_deg: float
    shift_um: tuple[float, float] = (0.0, 0.0)
    working_distance_um: float | None = None

    @property
    def microscope(self) -> scope.Microscope:
        return scope.Microscope(PIXEL_UM, WIDTH_PX, HEIGHT_PX, self.working_distance_um)

    @property
    def pose(self) -> scope.Pose:
        return scope.poses(scope.TiltSchedule((self.tilt_deg,), self.axis_deg, (self.shift_um,)))[0]

    @property
    def optics(self) -> Optics:
        return Optics(
            PIXEL_UM, WIDTH_PX, HEIGHT_PX, 0.0 if self.working_distance_um is None else 1 / self.working_distance_um
        )

    def seen_by_semrecon(self, xyz_um: Array) -> Array:
        """Project with semrecon's own rotation; only the shift, which is no convention, is handed over."""
        series = TiltSeries((View(BLANK, self.tilt_deg),), self.optics, self.axis_deg)
        rotation = geometry.nominal_poses(series).rotations[0]
        return geometry.project(xyz_um, rotation, np.array([*self.shift_um, 0.0]), self.optics)


BLANK: Image = np.zeros((HEIGHT_PX, WIDTH_PX), dtype=np.uint8)
TILTS = st.floats(-60, 60)
AXES = st.floats(-360, 360)
SHIFTS = st.tuples(st.floats(-3, 3), st.floats(-3, 3))
DISTANCES = st.none() | st.floats(150, 20_000)
PIXELS = st.tuples(st.floats(-0.5, WIDTH_PX - 0.5), st.floats(-0.5, HEIGHT_PX - 0.5))


def check_round_trip(stand: Stand, xy_px: Array) -> None:
    hits = CASTER.cast(*scope.pixel_rays(stand.microscope, stand.pose, xy_px))
    assert (hits.face >= 0).all(), "the sheet must fill every view"
    first = MESH.vertices_um[MESH.faces[hits.face, 0]]
    off_plane_um = np.einsum("...i,...i->...", hits.position_um - first, MESH.face_normals[hits.face])
    assert_allclose(off_plane_um, 0, atol=1e-5)
    assert_allclose(stand.seen_by_semrecon(hits.position_um), xy_px, rtol=0, atol=CLOSEST_PX)


@pytest.mark.parametrize("working_distance_um", [None, 400.0], ids=["parallel", "perspective"])
@pytest.mark.parametrize("axis_deg", [0.0, 90.0, 180.0, -37.0])
@pytest.mark.parametrize("tilt_deg", [-25.0, 0.0, 3.0, 40.0])
def test_every_pixel_comes_back(tilt_deg: float, axis_deg: float, working_distance_um: float | None) -> None:
    stand = Stand(tilt_deg, axis_deg, (0.7, -1.1), working_distance_um)
    check_round_trip(stand, scope.pixel_grid(stand.microscope))


@settings(max_examples=200)
@given(tilt=TILTS, axis=AXES, shift=SHIFTS, distance=DISTANCES, xy=PIXELS)
def test_any_position_comes_back(
    tilt: float, axis: float, shift: tuple[float, float], distance: float | None, xy: tuple[float, float]
) -> None:
    check_round_trip(Stand(tilt, axis, shift, distance), np.array([xy]))


SHAKY = ScanOptions((1.2, -0.7), 0.6, 0.2, (0.4, 0.2), 5.0, line_jitter_px=0.15, flyback_px=1.5)


@pytest.mark.parametrize("working_distance_um", [None, 400.0], ids=["parallel", "perspective"])
@pytest.mark.parametrize("tilt_deg", [0.0, -25.0, 40.0])
def test_every_pixel_comes_back_to_where_the_beam_was(tilt_deg: float, working_distance_um: float | None) -> None:
    """With scan errors on: what semrecon projects is off its pixel by the offset that the truth states, and no more."""
    stand = Stand(tilt_deg, 20.0, (0.7, -1.1), working_distance_um)
    beam = beam_positions(stand.microscope, SHAKY, np.random.default_rng(3))
    check_round_trip(stand, beam)
    offsets = scan_offsets(stand.microscope, SHAKY, np.random.default_rng(3))
    buffer = surface_buffer(MESH, stand.microscope, stand.pose, beam_px=beam)
    there = stand.seen_by_semrecon(buffer.position_um) - offsets
    assert_allclose(there, scope.pixel_grid(stand.microscope), rtol=0, atol=CLOSEST_PX)
    assert np.abs(offsets).max() > 1


@pytest.mark.parametrize("working_distance_um", [None, 400.0], ids=["parallel", "perspective"])
def test_the_truth_leads_back_through_column_and_scan(working_distance_um: float | None) -> None:
    """World point, semrecon's camera at the true tilt, the column's affine map written out here, then the scan."""
    stand = Stand(12.25, 20.0, (0.7, -1.1), working_distance_um)
    magnification, turn, skew = 0.013, math.radians(1.7), 0.006
    pose = scope.poses(
        scope.TiltSchedule((12.0,), 20.0, (stand.shift_um,)),
        StageErrors((0.25,)),
        ViewErrors((magnification,), (math.degrees(turn),), (skew,)),
    )[0]
    microscope, offsets = stand.microscope, scan_offsets(stand.microscope, SHAKY, np.random.default_rng(3))
    buffer = surface_buffer(MESH, microscope, pose, beam_px=scope.pixel_grid(microscope) + offsets)
    truth = GroundTruth(MESH, microscope, (pose,), (buffer,), (offsets,))

    x, y = np.moveaxis(stand.seen_by_semrecon(buffer.position_um) - microscope.centre_px, -1, 0)
    x = x + skew * y
    x, y = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x
    there = (1 + magnification) * np.stack([x, y], axis=-1) + microscope.centre_px - offsets
    assert_allclose(there, scope.pixel_grid(microscope), rtol=0, atol=CLOSEST_PX)
    assert_allclose(truth.image_of(0, buffer.position_um), there, rtol=0, atol=CLOSEST_PX)


@given(tilt=TILTS, axis=AXES)
def test_both_make_the_same_rotation(tilt: float, axis: float) -> None:
    theirs = geometry.rotations_from_tilts(np.array([tilt]), axis)[0]
    assert_allclose(scope.poses(scope.TiltSchedule((tilt,), axis))[0].rotation, theirs, rtol=0, atol=1e-14)


@given(tilt=TILTS, axis=AXES, shift=SHIFTS, distance=DISTANCES, xy=PIXELS, depth=st.floats(-20, 20))
def test_semrecon_goes_back_along_the_ray_of_semsim(
    tilt: float, axis: float, shift: tuple[float, float], distance: float | None, xy: tuple[float, float], depth: float
) -> None:
    stand = Stand(tilt, axis, shift, distance)
    origin, direction = scope.pixel_rays(stand.microscope, stand.pose, np.array(xy))
    rotation = geometry.rotations_from_tilts(np.array([tilt]), axis)[0]
    back = geometry.back_project(np.array(xy), np.array(depth), rotation, np.array([*shift, 0.0]), stand.optics)
    assert_allclose(back, origin + depth * direction, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("axis_deg", "point_um", "move_px"),
    [
        (0.0, (0.0, 0.0, 2.0), (+8 * math.sin(math.radians(10)), 0.0)),  # raised: right
        (90.0, (0.0, 0.0, 2.0), (0.0, +8 * math.sin(math.radians(10)))),  # raised: down
        (180.0, (0.0, 0.0, 2.0), (-8 * math.sin(math.radians(10)), 0.0)),
        (270.0, (0.0, 0.0, 2.0), (0.0, -8 * math.sin(math.radians(10)))),
        (0.0, (0.0, 2.0, 0.0), (0.0, 0.0)),  # on the axis: stays
        (90.0, (2.0, 0.0, 0.0), (0.0, 0.0)),
    ],
)
def test_what_is_raised_moves_as_the_page_says(
    axis_deg: float, point_um: tuple[float, float, float], move_px: tuple[float, float]
) -> None:
    still, tilted = Stand(0.0, axis_deg), Stand(10.0, axis_deg)
    point = np.array(point_um)
    ours = tilted.seen_by_semrecon(point) - still.seen_by_semrecon(point)
    theirs = [scope.project(stand.microscope, stand.pose, point) for stand in (still, tilted)]
    assert_allclose(ours, move_px, rtol=0, atol=1e-12)
    assert_allclose(theirs[1] - theirs[0], move_px, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("axis_deg", "lifted_um"), [(0.0, (-5.0, 0.0, 0.0)), (90.0, (0.0, 5.0, 0.0))])
def test_the_left_or_the_upper_side_is_lifted(axis_deg: float, lifted_um: tuple[float, float, float]) -> None:
    rise_um = 5 * math.sin(math.radians(10))
    ours = geometry.view_from_world(geometry.rotations_from_tilts(np.array([10.0]), axis_deg)[0])
    theirs = Stand(10.0, axis_deg).pose.view_from_world
    assert_allclose([(ours @ lifted_um)[2], (theirs @ lifted_um)[2]], rise_um)


def test_zero_tilt_is_a_picture_of_the_world() -> None:
    """World x goes to columns, world y against the rows, the origin to the middle; and z is not seen."""
    stand = Stand(0.0, 0.0)
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    expected = np.array([[31.5, 23.5], [35.5, 23.5], [31.5, 19.5], [31.5, 23.5]])
    assert_allclose(stand.seen_by_semrecon(points), expected, rtol=0, atol=1e-12)
    assert_allclose(scope.project(stand.microscope, stand.pose, points), expected, rtol=0, atol=1e-12)


def test_what_lies_deeper_is_drawn_smaller_in_perspective() -> None:
    stand = Stand(0.0, 0.0, working_distance_um=100.0)
    high, low = stand.seen_by_semrecon(np.array([[4.0, 0.0, 10.0], [4.0, 0.0, -10.0]]))[:, 0] - 31.5
    assert_allclose([high, low], [16 / 0.9, 16 / 1.1])


def test_a_wrong_sign_is_noticed() -> None:
    """The round trip would not notice a sign that both had wrong; it must notice one that one of them has wrong."""
    right, wrong = Stand(5.0, 0.0), Stand(-5.0, 0.0)
    hits = CASTER.cast(*scope.pixel_rays(right.microscope, right.pose, scope.pixel_grid(right.microscope)))
    miss_px = np.abs(wrong.seen_by_semrecon(hits.position_um) - scope.pixel_grid(right.microscope))
    assert miss_px.max() > 1
