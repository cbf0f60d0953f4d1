"""Metrics: hand-computed values, gauges that remove what they say and no more, missing heights that never pay."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from semrecon.errors import InputError
from semrecon.geometry import tilt_rotation
from semrecon.judging.gauge import gauge_residual
from semrecon.judging.metrics import (
    depth_errors,
    error_split,
    relative_rotation_error_arccos_deg,
    relative_rotation_error_deg,
    rmse_um,
)

ALL = ("offset", "plane", "scale", "mirror")
SETS = [(), ("offset",), ("plane",), ("offset", "plane"), ("offset", "scale"), ("offset", "mirror"), ALL]


def relief(shape=(24, 32)):
    rows, columns = np.indices(shape, dtype=float)
    return 3 * np.sin(rows / 4) + 2 * np.cos(columns / 3 + rows / 7)


def grid_xy(shape, pixel_um=0.5):
    rows, columns = np.indices(shape, dtype=float)
    return pixel_um * np.stack([columns - (shape[1] - 1) / 2, (shape[0] - 1) / 2 - rows], axis=-1)


# --- Eq. 7 ----------------------------------------------------------------------------------------------------------


def test_rmse_by_hand():
    moving = np.array([[0.0, 0, 0], [10, 0, 0]])
    fixed = np.array([[0.0, 0, 3], [10, 4, 0], [10, 0, 12]])
    found = rmse_um(moving, fixed)
    assert found.moving_to_fixed_um == pytest.approx(np.sqrt((9 + 16) / 2))
    assert found.fixed_to_moving_um == pytest.approx(np.sqrt((9 + 16 + 144) / 3))
    assert found.symmetric_um == pytest.approx(np.sqrt((12.5 + 169 / 3) / 2))


def test_rmse_is_a_root_of_squares_and_not_the_average_distance_of_the_text():
    moving, fixed = np.array([[0.0, 0, 0], [100, 0, 0]]), np.array([[0.0, 0, 1], [100, 0, 7]])
    assert rmse_um(moving, fixed).moving_to_fixed_um == pytest.approx(5.0)


def test_rmse_swaps_with_its_clouds_and_does_not_see_a_common_motion():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(60, 3))
    one, other = rmse_um(a, b), rmse_um(b, a)
    assert one.moving_to_fixed_um == other.fixed_to_moving_um
    assert one.symmetric_um == other.symmetric_um
    turn = Rotation.random(rng=1).as_matrix()
    assert rmse_um(a @ turn.T + 5, b @ turn.T + 5).symmetric_um == pytest.approx(one.symmetric_um, rel=1e-12)


def test_rmse_of_strewn_points_on_one_surface_is_their_spacing_and_not_zero():
    """The mean square distance to the nearest of n random points a unit area is 1/(pi n): sparsity alone."""
    rng = np.random.default_rng(2)
    flat = [np.column_stack([rng.uniform(0, 100, (20000, 2)), np.zeros(20000)]) for _ in range(2)]
    expected = np.sqrt(1 / (np.pi * 2.0))
    assert rmse_um(*flat).moving_to_fixed_um == pytest.approx(expected, rel=0.03)


def test_a_missing_point_does_not_lower_the_rmse_but_is_refused():
    good = np.zeros((3, 3))
    for bad in (np.array([[np.nan, 0, 0]]), np.zeros((0, 3))):
        with pytest.raises(InputError, match="fixed cloud"):
            rmse_um(good, bad)


# --- Eq. 8 ----------------------------------------------------------------------------------------------------------


def test_rre_of_the_truth_is_zero():
    assert relative_rotation_error_deg(np.eye(3), np.eye(3)) == 0.0
    turn = tilt_rotation(37.0, 20.0)
    assert relative_rotation_error_deg(turn, turn) < 1e-13


@pytest.mark.parametrize("angle_deg", [1e-12, 1e-9, 1e-7, 1e-3, 3.0, 90.0, 179.0, 180.0 - 1e-9, 180.0])
def test_rre_is_exact_at_any_size(angle_deg):
    true = tilt_rotation(15.0, 30.0)
    wrong = Rotation.from_rotvec(np.deg2rad(angle_deg) * np.array([2, -1, 2]) / 3).as_matrix() @ true
    assert relative_rotation_error_deg(true, wrong) == pytest.approx(angle_deg, rel=1e-9, abs=3e-14)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.01, 85), st.floats(0, 360))
def test_a_transposed_rotation_shows_as_twice_its_angle(tilt, axis):
    turn = tilt_rotation(tilt, axis)
    assert relative_rotation_error_deg(turn, turn.T) == pytest.approx(2 * tilt, rel=1e-9)


def test_the_printed_arccos_agrees_where_it_can_and_loses_small_angles():
    small, large = tilt_rotation(1e-7), tilt_rotation(12.0)
    assert relative_rotation_error_arccos_deg(large, np.eye(3)) == pytest.approx(12.0, abs=1e-9)
    assert abs(relative_rotation_error_arccos_deg(small, np.eye(3)) - 1e-7) > 5e-8
    assert relative_rotation_error_deg(small, np.eye(3)) == pytest.approx(1e-7, rel=1e-9)


def test_rre_swaps_and_turns_with_both_rotations():
    a, b, c = (Rotation.random(rng=seed).as_matrix() for seed in range(3))
    assert relative_rotation_error_deg(a, b) == pytest.approx(relative_rotation_error_deg(b, a), rel=1e-12)
    assert relative_rotation_error_deg(a @ c, b @ c) == pytest.approx(relative_rotation_error_deg(a, b), rel=1e-12)


@pytest.mark.parametrize("bad", [np.diag([1.0, 1, -1]), 2 * np.eye(3), np.eye(4), np.full((3, 3), np.nan)])
def test_rre_refuses_what_is_no_rotation(bad):
    with pytest.raises(InputError, match="estimated rotation"):
        relative_rotation_error_deg(np.eye(3), bad)


# --- depth errors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", SETS)
def test_the_truth_as_an_estimate_scores_exactly_zero(gauge):
    true = relief()
    true[:3] = np.nan
    found = depth_errors(true.copy(), true, gauge)
    assert (found.median_abs_um, found.rms_um, found.p95_um, found.bias_um) == (0, 0, 0, 0)
    assert (found.penalised_median_abs_um, found.penalised_p95_um) == (0, 0)
    assert (found.completeness, found.count) == (1.0, 21 * 32)


def test_depth_errors_by_hand():
    true = np.zeros(5)
    estimated = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    plain = depth_errors(estimated, true, ())
    assert (plain.median_abs_um, plain.bias_um) == (3.0, 4.0)
    assert plain.rms_um == pytest.approx(np.sqrt(26))
    assert plain.p95_um == pytest.approx(np.quantile(estimated, 0.95))
    level = depth_errors(estimated, true, ("offset",))
    assert level.median_abs_um == 1.0  # |-2, -1, 0, 1, 7| about the median
    assert level.rms_um == pytest.approx(np.sqrt(10.0))  # -3, -2, -1, 0, 6 about the mean
    assert level.bias_um == pytest.approx(0.0, abs=1e-15)


def test_missing_heights_by_hand():
    true = np.array([0.0, 0, 0, 0, np.nan])
    found = depth_errors(np.array([1.0, np.nan, 3.0, np.inf, 100.0]), true, ())
    assert (found.completeness, found.count, found.median_abs_um) == (0.5, 2, 2.0)
    assert found.penalised_p95_um == np.inf
    assert found.penalised_median_abs_um == np.inf  # halfway between the second and a missing third
    one_more = depth_errors(np.array([1.0, 2.0, 3.0, np.inf, 100.0]), true, ())
    assert one_more.penalised_median_abs_um == 2.5


def test_an_estimate_of_nothing_has_no_error_and_no_completeness():
    found = depth_errors(np.full((4, 5), np.nan), np.zeros((4, 5)))
    assert (found.completeness, found.count) == (0.0, 0)
    assert np.isnan([found.median_abs_um, found.rms_um, found.p95_um, found.bias_um]).all()
    assert found.penalised_median_abs_um == np.inf


def test_as_few_heights_as_the_gauge_has_numbers_are_no_perfect_score():
    true, estimated = relief((4, 5)), np.full((4, 5), np.nan)
    estimated.ravel()[[0, 7, 13]] = [5.0, -2.0, 9.0]
    assert np.isnan(depth_errors(estimated, true, ("offset", "plane")).median_abs_um)
    assert np.isfinite(depth_errors(estimated, true, ("offset",)).median_abs_um)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_leaving_heights_out_never_helps(data):
    errors = data.draw(hnp.arrays(float, st.integers(1, 30), elements=st.floats(-5, 5)))
    dropped = data.draw(hnp.arrays(bool, len(errors)))
    full = depth_errors(errors, np.zeros(len(errors)), ())
    part = depth_errors(np.where(dropped, np.nan, errors), np.zeros(len(errors)), ())
    assert part.penalised_median_abs_um >= full.penalised_median_abs_um
    assert part.penalised_p95_um >= full.penalised_p95_um
    assert part.completeness == pytest.approx(1 - dropped.mean())
    assert part.count == (~dropped).sum()


def test_points_and_map_score_the_same():
    rng = np.random.default_rng(0)
    true = relief()
    estimated = true + rng.normal(0, 0.3, true.shape)
    xy = grid_xy(true.shape)
    for gauge in (("offset",), ("offset", "plane"), ("offset", "scale")):
        one = depth_errors(estimated, true, gauge)
        other = depth_errors(estimated.ravel(), true.ravel(), gauge, xy.reshape(-1, 2))
        assert one.rms_um == pytest.approx(other.rms_um, rel=1e-9)
        assert one.median_abs_um == pytest.approx(other.median_abs_um, rel=1e-4)


CHANGES = {
    "offset": lambda z, xy: z + 7.0,
    "plane": lambda z, xy: z + 0.05 * xy[..., 0] - 0.08 * xy[..., 1],
    "scale": lambda z, xy: 0.5 * z,
    "mirror": lambda z, xy: -z,
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("gauge", [(), *[(name,) for name in CHANGES], ("offset", "plane"), ALL])
def test_a_gauge_removes_what_it_says_and_nothing_else(change, gauge):
    """What is declared vanishes to rounding; what is not stays."""
    true = relief()
    xy = grid_xy(true.shape)
    found = depth_errors(CHANGES[change](true, xy), true, gauge, xy)
    if change in gauge:
        assert max(found.rms_um, found.p95_um) < 1e-9
    else:
        assert min(found.rms_um, found.median_abs_um) > 0.1


@settings(max_examples=30, deadline=None)
@given(st.floats(-50, 50), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.2, 4.0), st.booleans())
def test_scores_do_not_see_a_change_within_the_full_gauge(offset, p, q, scale, mirrored):
    rng = np.random.default_rng(1)
    true = relief((12, 15))
    xy = grid_xy(true.shape)
    noisy = true + rng.normal(0, 0.2, true.shape)
    changed = (-1 if mirrored else 1) * scale * noisy + offset + p * xy[..., 0] + q * xy[..., 1]
    before, after = depth_errors(noisy, true, ALL, xy), depth_errors(changed, true, ALL, xy)
    assert after.rms_um == pytest.approx(before.rms_um, rel=1e-6)
    assert after.median_abs_um == pytest.approx(before.median_abs_um, rel=1e-3)


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(float, (5, 6), elements=st.floats(-9, 9)))
def test_a_wider_gauge_never_raises_the_rms(estimated):
    true = relief((5, 6))
    chain = [(), ("offset",), ("offset", "plane"), ("offset", "plane", "scale"), ALL]
    rms = [depth_errors(estimated, true, gauge).rms_um for gauge in chain]
    assert all(wide <= narrow * (1 + 1e-9) + 1e-9 for narrow, wide in pairwise(rms))


def test_scale_alone_never_turns_relief_inside_out():
    true = relief()
    level = true - true.mean()
    upside_down = depth_errors(-true, true, ("offset", "scale"))
    assert upside_down.rms_um == pytest.approx(np.sqrt(np.mean(level**2)), rel=1e-9)


def test_outliers_do_not_drag_the_gauge_of_the_median():
    rng = np.random.default_rng(4)
    true = relief()
    xy = grid_xy(true.shape)
    clean = true + rng.normal(0, 0.1, true.shape)
    spoilt = clean.copy()
    spoilt[rng.random(true.shape) < 0.1] += 40
    for gauge in (("offset",), ("offset", "plane"), ("offset", "plane", "scale")):
        without, with_them = depth_errors(clean, true, gauge, xy), depth_errors(spoilt, true, gauge, xy)
        assert with_them.median_abs_um == pytest.approx(without.median_abs_um, rel=0.25)
        assert with_them.rms_um > 15 * without.rms_um


def test_noise_comes_back_as_noise():
    """Median |N(0, s)| is 0.6745 s and its 95 % quantile 1.96 s; two-sided, 3 % of 76,800 heights."""
    true = relief((240, 320))
    found = depth_errors(true + np.random.default_rng(0).normal(0, 0.2, true.shape) + 5, true)
    assert found.rms_um == pytest.approx(0.2, rel=0.03)
    assert found.median_abs_um == pytest.approx(0.6745 * 0.2, rel=0.03)
    assert found.p95_um == pytest.approx(1.96 * 0.2, rel=0.03)


def test_residual_keeps_the_shape_and_the_holes():
    true = relief()
    estimated = true + 2
    estimated[3, 4] = np.nan
    left = gauge_residual(estimated, true, ("offset",), norm="absolute")
    assert left.shape == true.shape
    assert np.argwhere(np.isnan(left)).tolist() == [[3, 4]]
    assert np.nanmax(np.abs(left)) < 1e-12


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: depth_errors(np.zeros(3), np.zeros(4)), "one shape"),
        (lambda: depth_errors(np.zeros(9), np.zeros(9), ("offset", "plane")), "xy_um"),
        (lambda: depth_errors(np.zeros(9), np.zeros(9), ("tilt",)), "unknown gauge 'tilt'"),
        (lambda: depth_errors(np.zeros(3), np.full(3, np.nan)), "nothing to judge"),
        (lambda: depth_errors(np.zeros(9), np.zeros(9), ("plane",), np.zeros((9, 3))), "of shape"),
        (lambda: error_split(np.zeros(4), np.zeros(4), np.zeros((4, 2))), "five heights"),
        (lambda: error_split(np.zeros(9), np.zeros(9), np.zeros((8, 2))), "of shape"),
    ],
)
def test_bad_input_gets_a_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


# --- split of the error ---------------------------------------------------------------------------------------------


def test_split_finds_each_part():
    true = relief()
    xy = grid_xy(true.shape)
    slope_x, slope_y = np.tan(np.deg2rad([0.3, -0.2]))
    estimated = true + 1.5 - 0.1 * (true - true.mean()) + slope_x * xy[..., 0] + slope_y * xy[..., 1]
    found = error_split(estimated, true, xy)
    assert found.offset_um == pytest.approx(1.5, abs=1e-12)
    assert found.scale == pytest.approx(0.9, abs=1e-12)
    assert found.tilt_x_deg == pytest.approx(0.3, abs=1e-10)
    assert found.tilt_y_deg == pytest.approx(-0.2, abs=1e-10)
    assert found.remainder_rms_um < 1e-12


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(float, (6, 7), elements=st.floats(-9, 9)))
def test_shares_add_up_in_squares(estimated):
    true = relief((6, 7))
    found = error_split(estimated, true, grid_xy(true.shape))
    parts = [found.offset_rms_um, found.scale_rms_um, found.tilt_rms_um, found.remainder_rms_um]
    assert np.sum(np.square(parts)) == pytest.approx(found.total_rms_um**2, rel=1e-9, abs=1e-12)


def test_a_tilt_of_a_leaning_specimen_is_not_taken_for_scale():
    shape = (24, 32)
    xy = grid_xy(shape)
    leaning = relief(shape) + 0.4 * xy[..., 0]
    found = error_split(leaning + 0.01 * xy[..., 0], leaning, xy)
    assert found.scale == pytest.approx(1.0, abs=1e-12)
    assert found.tilt_x_deg == pytest.approx(np.rad2deg(np.arctan(0.01)), abs=1e-10)


def test_on_a_plane_scale_cannot_be_told_and_says_so():
    xy = grid_xy((8, 9))
    plane = 0.2 * xy[..., 0] + 3
    found = error_split(1.1 * plane, plane, xy)
    assert np.isnan(found.scale)
    assert found.tilt_x_deg == pytest.approx(np.rad2deg(np.arctan(0.02)), abs=1e-10)
    assert found.remainder_rms_um < 1e-12


def test_split_leaves_missing_heights_out_and_keeps_noise_as_the_remainder():
    rng = np.random.default_rng(0)
    true = relief((100, 120))
    estimated = 1.2 * true + rng.normal(0, 0.1, true.shape)
    estimated[:20] = np.nan
    found = error_split(estimated, true, grid_xy(true.shape))
    assert found.count == 80 * 120
    assert found.scale == pytest.approx(1.2, abs=0.003)
    assert found.remainder_rms_um == pytest.approx(0.1, rel=0.03)


def test_a_tilt_error_of_the_stage_shows_as_the_scale_and_tilt_that_it_makes():
    """Two views at 0 and 3.0 degrees, taken for 3.1: depth is too small by sin 3.0 / sin 3.1, about 3.2 %."""
    true = relief()
    xy = grid_xy(true.shape)
    nominal, actual = np.deg2rad([3.1, 3.0])
    seen = xy[..., 0] * np.cos(actual) + true * np.sin(actual)
    estimated = (seen - xy[..., 0] * np.cos(nominal)) / np.sin(nominal)
    found = error_split(estimated, true, xy)
    assert found.scale == pytest.approx(np.sin(actual) / np.sin(nominal), abs=1e-12)
    assert found.tilt_x_deg == pytest.approx(0.1, rel=0.03)
