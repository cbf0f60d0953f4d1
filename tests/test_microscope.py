"""The simulator's geometry against the conventions, written out here a second time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.errors import InputError
from semsim.imperfections import StageErrors, ViewErrors, distortion, draw
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


SCHEDULE = TiltSchedule((0.0, 5.0, -20.0), 30.0, ((0.0, 0.0), (0.5, -0.2), (0.0, 1.0)))
CLOUD = np.random.default_rng(0).uniform(-3, 3, (40, 3))
angles = st.floats(-30, 30)


def test_without_errors_poses_are_those_of_the_schedule():
    rng = np.random.default_rng(9)
    for plain, drawn in zip(poses(SCHEDULE), poses(SCHEDULE, StageErrors(), ViewErrors(), rng), strict=True):
        assert np.array_equal(plain.rotation, drawn.rotation)
        assert np.array_equal(plain.translation_um, drawn.translation_um)
        assert np.array_equal(drawn.distortion, np.eye(2))
        assert not drawn.distorted


def test_shifts_in_whole_numbers_are_shifts_all_the_same():
    whole, errors = TiltSchedule((0.0, 0.0), shifts_um=((0, 0), (1, -2))), StageErrors(shift_sigma_um=0.3)
    first, second = (poses(each, errors, rng=np.random.default_rng(2)) for each in (whole, TiltSchedule((0.0, 0.0))))
    assert np.allclose(first[1].translation_um - second[1].translation_um, [1, -2, 0], atol=1e-12)


def test_a_stated_tilt_error_is_another_tilt_and_leaves_the_nominal_one():
    wrong = poses(TiltSchedule((0.0, 5.0)), StageErrors(tilts_deg=(0.1, -0.25), tilt_axis_deg=2.0))
    right = poses(TiltSchedule((0.1, 4.75), 2.0))
    for a, b in zip(wrong, right, strict=True):
        assert np.allclose(a.rotation, b.rotation, atol=1e-15)


def test_drawn_errors_have_the_standard_deviations_asked_for():
    stage = StageErrors(tilt_sigma_deg=0.1, shift_sigma_um=0.3)
    column = ViewErrors(magnification_sigma=0.002, rotation_sigma_deg=0.2, skew_sigma=0.001)
    drawn = draw(stage, column, 4000, np.random.default_rng(1))
    within = 5 / np.sqrt(2 * 4000)
    assert drawn.tilts_deg.std() == pytest.approx(0.1, rel=within)
    assert drawn.shifts_um.std(axis=0) == pytest.approx(0.3, rel=within)
    scale = np.sqrt(np.linalg.det(drawn.distortions)) - 1
    turn = np.degrees(np.arctan2(-drawn.distortions[:, 1, 0], drawn.distortions[:, 0, 0]))
    assert scale.std() == pytest.approx(0.002, rel=within)
    assert turn.std() == pytest.approx(0.2, rel=within)
    assert np.abs(np.corrcoef([drawn.tilts_deg, *drawn.shifts_um.T, scale, turn]) - np.eye(5)).max() < 4.5 / 63


def test_a_view_more_leaves_the_errors_of_the_others():
    stage, column = StageErrors(tilt_sigma_deg=0.1), ViewErrors(rotation_sigma_deg=1.0)
    three, four = (draw(stage, column, n, np.random.default_rng(1)) for n in (3, 4))
    assert np.array_equal(three.tilts_deg, four.tilts_deg[:3])
    assert np.array_equal(three.distortions, four.distortions[:3])


def test_the_operator_brings_every_view_back_save_the_reference():
    shifts = [pose.translation_um for pose in poses(TiltSchedule((5.0, -1.0, 9.0)), StageErrors(shift_sigma_um=1.0))]
    assert not shifts[1].any()
    assert all(shift[:2].all() and shift[2] == 0 for shift in (shifts[0], shifts[2]))


@given(angle, st.floats(-180, 180), st.tuples(lengths, lengths, lengths), lengths)
def test_a_tilt_axis_that_passes_the_origin_by_keeps_its_own_points(tilt, axis_deg, point, along):
    """X' = c + R (X - c): every point of the axis stays where zero tilt has it, in all three coordinates."""
    still, tilted = poses(TiltSchedule((0.0, tilt), axis_deg), StageErrors(axis_point_um=point))
    direction = np.array([np.sin(np.radians(axis_deg)), np.cos(np.radians(axis_deg)), 0.0])
    on_axis = np.array(point) + along * direction
    assert np.allclose(still.translation_um, 0.0, atol=1e-12)
    before, after = (pose.rotation @ on_axis + pose.translation_um for pose in (still, tilted))
    assert np.allclose(after, before, atol=1e-9)


def test_an_axis_below_the_specimen_shifts_the_picture_by_height_times_sine():
    pose = poses(TiltSchedule((10.0,)), StageErrors(axis_point_um=(0.0, 0.0, -50.0)))[0]
    column, row = project(PARALLEL, pose, np.zeros(3)) - PARALLEL.centre_px
    assert column == pytest.approx(50 * np.sin(np.radians(10)) / 0.2)
    assert row == 0
    # It also sinks, as everything does that leaves the top of a circle.
    assert pose.translation_um[2] == pytest.approx(50 * (1 - np.cos(np.radians(10))))


def test_distortions_are_what_their_names_say():
    right, down = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert np.array_equal(distortion(0.0, 0.0, 0.0), np.eye(2))
    assert np.allclose(distortion(0.01, 0.0, 0.0) @ right, [1.01, 0.0])
    # A quarter turn counter-clockwise, as the eye sees it, takes what is right to the top: a lower row.
    assert np.allclose(distortion(0.0, np.pi / 2, 0.0) @ right, [0.0, -1.0])
    assert np.allclose(distortion(0.0, 0.0, 0.1) @ down, [0.1, 1.0])
    assert np.allclose(distortion(0.0, 0.0, 0.1) @ right, right)


@given(st.floats(-0.2, 0.2), angles, st.floats(-0.2, 0.2), st.booleans())
def test_a_distorted_picture_is_the_affine_map_of_the_straight_one(magnification, turn, skew, near):
    microscope = PERSPECTIVE if near else PARALLEL
    column = ViewErrors((0.0, magnification), (0.0, turn), (0.0, skew))
    straight, bent = poses(TiltSchedule((7.0, 7.0)), views=column)
    a, b = (project(microscope, pose, CLOUD) - microscope.centre_px for pose in (straight, bent))
    assert np.allclose(b, a @ distortion(magnification, np.radians(turn), skew).T, atol=1e-9)


@given(st.floats(-0.1, 0.1), angles, st.floats(-0.1, 0.1), st.floats(-30, 30), st.booleans())
def test_every_point_of_a_pixels_ray_returns_whatever_the_errors(magnification, turn, skew, depth, near):
    microscope = PERSPECTIVE if near else PARALLEL
    stage = StageErrors((0.3,), 0.1, 1.0, (5.0, -3.0, 20.0), 0.5)
    pose = poses(TiltSchedule((25.0,), 30.0), stage, ViewErrors((magnification,), (turn,), (skew,)))[0]
    pixels = pixel_grid(microscope)
    origins, directions = pixel_rays(microscope, pose, pixels)
    assert np.allclose(project(microscope, pose, origins + depth * directions), pixels, atol=1e-9)


def test_a_translation_series_has_parallax_in_perspective_only():
    """A point at camera depth z moves by s / (pixel (1 + z / WD)): the nearer to the gun, the farther."""
    series = TiltSchedule((0.0, 0.0), 0.0, ((0.0, 0.0), (2.0, 0.0)))
    points = np.array([[0.3, 0.5, 5.0], [0.3, 0.5, -5.0]])
    for microscope, factor in ((PARALLEL, np.ones(2)), (PERSPECTIVE, 1 / (1 + np.array([-5.0, 5.0]) / 60))):
        left, right = (project(microscope, pose, points) for pose in poses(series))
        assert np.allclose((right - left)[:, 0], 2.0 / 0.2 * factor, atol=1e-12)
        assert np.allclose((right - left)[:, 1], 0.0, atol=1e-12)


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
        (lambda: StageErrors(tilt_sigma_deg=-0.1), "stage_errors tilt_sigma_deg"),
        (lambda: StageErrors(axis_point_um=(0.0, float("nan"), 0.0)), "stage_errors axis_point_um"),
        (lambda: ViewErrors(magnifications=(0.0, -1.0)), "view_errors magnifications"),
        (lambda: ViewErrors(skews=(float("inf"),)), "view_errors skews"),
        (lambda: poses(SCHEDULE, StageErrors(tilts_deg=(0.1,))), "stage_errors tilts_deg"),
        (lambda: poses(SCHEDULE, views=ViewErrors(rotations_deg=(0.1,))), "view_errors rotations_deg"),
        (lambda: poses(TiltSchedule((89.0,)), StageErrors(tilts_deg=(2.0,))), "true tilts"),
    ],
)
def test_impossible_values_are_named(make, word):
    with pytest.raises(InputError, match=word):
        make()
