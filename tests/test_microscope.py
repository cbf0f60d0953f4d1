"""The simulator's geometry against the conventions, written out here a second time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.errors import InputError
from semsim.microscope import Microscope, TiltSchedule, pixel_grid, pixel_rays, poses, project

PARALLEL = Microscope(0.2, 40, 30)
PERSPECTIVE = Microscope(0.2, 40, 30, working_distance_um=60.0)
angle = st.floats(-80, 80)
lengths = st.floats(-20, 20)


def test_the_origin_projects_to_the_centre_of_the_picture():
    pose = poses(TiltSchedule((25.0,), 70.0))[0]
    assert np.allclose(project(PARALLEL, pose, np.zeros(3)), [19.5, 14.5])


def test_at_zero_tilt_world_x_is_right_y_is_up_and_z_is_to_the_gun():
    pose = poses(TiltSchedule((0.0,)))[0]
    assert np.array_equal(pose.rotation, np.diag([1.0, -1.0, -1.0]))
    assert np.allclose(project(PARALLEL, pose, np.array([1.0, 2.0, 3.0])), [19.5 + 5, 14.5 - 10])


@given(angle, lengths, lengths, lengths)
def test_tilt_about_axis_0_follows_x_cos_plus_z_sin_and_keeps_rows(tilt, x, y, z):
    pose = poses(TiltSchedule((tilt,)))[0]
    column, row = project(PARALLEL, pose, np.array([x, y, z]))
    turned = x * np.cos(np.radians(tilt)) + z * np.sin(np.radians(tilt))
    assert column == pytest.approx(19.5 + turned / 0.2, abs=1e-9)
    assert row == pytest.approx(14.5 - y / 0.2, abs=1e-9)


@given(st.floats(0.5, 80), st.floats(0.1, 20))
def test_a_raised_point_moves_right_about_axis_0_and_down_about_axis_90(tilt, height):
    raised = np.array([0.0, 0.0, height])
    right = project(PARALLEL, poses(TiltSchedule((tilt,), 0.0))[0], raised) - PARALLEL.centre_px
    down = project(PARALLEL, poses(TiltSchedule((tilt,), 90.0))[0], raised) - PARALLEL.centre_px
    # Right-handed about +x takes z to -y, which is down in the picture.
    step = height * np.sin(np.radians(tilt)) / 0.2
    assert np.allclose(right, [step, 0.0], atol=1e-9)
    assert np.allclose(down, [0.0, step], atol=1e-9)


@given(angle, st.floats(-180, 180))
def test_the_tilt_axis_stays_where_it_is_and_rotations_are_proper(tilt, axis_deg):
    rotation = poses(TiltSchedule((tilt,), axis_deg))[0].view_from_world
    axis = np.array([np.sin(np.radians(axis_deg)), np.cos(np.radians(axis_deg)), 0.0])
    assert np.allclose(rotation @ axis, axis, atol=1e-12)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)
    assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(np.radians(tilt)), abs=1e-12)


@given(angle, st.floats(-180, 180), lengths, lengths, st.floats(-30, 30), st.booleans())
def test_every_point_of_a_pixels_ray_projects_back_to_the_pixel(tilt, axis_deg, shift, column, depth, near):
    microscope = PERSPECTIVE if near else PARALLEL
    pose = poses(TiltSchedule((tilt,), axis_deg, ((shift, -shift),)))[0]
    pixel = np.array([column, 7.25])
    origin, direction = pixel_rays(microscope, pose, pixel)
    assert (pose.rotation @ origin + pose.translation_um)[2] == pytest.approx(0, abs=1e-9)
    assert (pose.rotation @ direction)[2] == pytest.approx(1, abs=1e-12)
    assert np.allclose(project(microscope, pose, origin + depth * direction), pixel, atol=1e-9)


def test_a_stage_shift_moves_the_picture_by_shift_over_pixel_size():
    points = np.random.default_rng(0).normal(size=(9, 3))
    still, moved = poses(TiltSchedule((10.0, 10.0), 0.0, ((0.0, 0.0), (1.0, -0.5))))
    assert np.allclose(project(PARALLEL, moved, points) - project(PARALLEL, still, points), [5.0, -2.5])


def test_a_long_working_distance_becomes_parallel():
    pose = poses(TiltSchedule((10.0,)))[0]
    points = np.random.default_rng(0).uniform(-4, 4, (50, 3))
    far = Microscope(0.2, 40, 30, working_distance_um=1e9)
    # (N/2) * relief / working distance bounds the difference.
    assert np.abs(project(far, pose, points) - project(PARALLEL, pose, points)).max() < 20 * 8 / 1e9 * 2
    assert np.abs(project(PERSPECTIVE, pose, points) - project(PARALLEL, pose, points)).max() > 0.1


def test_what_is_nearer_to_the_gun_is_larger():
    pose = poses(TiltSchedule((0.0,)))[0]
    high, low = project(PERSPECTIVE, pose, np.array([[1.0, 0.0, 5.0], [1.0, 0.0, -5.0]]))
    assert high[0] > low[0] > PERSPECTIVE.centre_px[0]


def test_the_pixel_size_of_the_seed_three_ways():
    """FINDINGS A5: a = 337.3438 at 512 dpi is 5/34 um, and 1011x on a print of 127 mm."""
    bar = Microscope.from_data_bar(5, 34, 854, 640)
    assert bar.pixel_size_um == 5 / 34
    assert Microscope.from_magnification(1011, 854, 640).pixel_size_um == pytest.approx(5 / 34, rel=5e-4)
    dpi = Microscope.from_magnification(337.3438, 854, 640, print_width_um=854 / 512 * 25400)
    assert dpi.pixel_size_um == pytest.approx(5 / 34, rel=1e-6)


def test_the_grid_holds_column_then_row():
    grid = pixel_grid(PARALLEL)
    assert grid.shape == (30, 40, 2)
    assert grid[3, 5].tolist() == [5, 3]


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Microscope(0.0, 10, 10), "pixel_size_um"),
        (lambda: Microscope(float("nan"), 10, 10), "pixel_size_um"),
        (lambda: Microscope(0.1, 0, 10), "width_px"),
        (lambda: Microscope(0.1, 10, 10, -1.0), "working_distance_um"),
        (lambda: Microscope.from_data_bar(5, 0, 10, 10), "bar_px"),
        (lambda: Microscope.from_magnification(-5, 10, 10), "magnification"),
        (lambda: TiltSchedule(()), "tilts_deg"),
        (lambda: TiltSchedule((0.0, 90.0)), "tilts_deg"),
        (lambda: TiltSchedule((0.0, float("nan"))), "tilts_deg"),
        (lambda: TiltSchedule((0.0, 3.0), shifts_um=((1.0, 2.0),)), "shifts_um"),
        (lambda: TiltSchedule((0.0,), float("inf")), "tilt_axis_deg"),
    ],
)
def test_impossible_values_are_named(make, word):
    with pytest.raises(InputError, match=word):
        make()
