"""Claims about disparity: which formula is exact in which frame, and what the printed one does to the depth."""

from __future__ import annotations

import numpy as np
import pytest

from semrecon.data import Array, Optics
from semrecon.errors import InputError, MethodError
from semrecon.geometry import CAM_FROM_VIEW, centred_um, project, rotations_from_tilts, tilt_rotation
from semrecon.points.disparity import disparity_cloud
from semrecon.points.translation import solve_closed_form

OPTICS = Optics(0.147, 854, 640)
CASES = [(0.0, 3.0, 0.0), (4.0, 15.0, 0.0), (0.0, -15.0, 0.0), (2.0, 6.0, 90.0), (-3.0, 8.0, 35.0), (1.0, -9.0, -120.0)]
EVERY_CASE = pytest.mark.parametrize(("first", "step", "axis"), CASES)


def images(first_deg: float, step_deg: float, axis_deg: float, shift_um: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Exact positions (2, n, 2) of random points; view 1 stands still, view 2 is shifted in camera axes."""
    xyz = np.random.default_rng(0).uniform(-25, 25, (301, 3))
    rotations = rotations_from_tilts(np.array([first_deg, first_deg + step_deg]), axis_deg)
    return np.stack(
        [project(xyz, rotations[0], np.zeros(3), OPTICS), project(xyz, rotations[1], [*shift_um, 0], OPTICS)]
    )


def truth(tilt_deg: float, axis_deg: float) -> Array:
    """The same points in the view frame of a tilt."""
    return np.random.default_rng(0).uniform(-25, 25, (301, 3)) @ tilt_rotation(tilt_deg, axis_deg).T


@EVERY_CASE
def test_boyde_is_exact_in_the_first_view(first: float, step: float, axis: float) -> None:
    xy = images(first, step, axis)
    answer = disparity_cloud(*xy, step, OPTICS, variant="boyde", tilt_axis_deg=axis, gauge=0.0)
    np.testing.assert_allclose(answer.points.xyz_um, truth(first, axis), atol=1e-9 * 50)
    assert answer.frame_tilt_deg == 0


@EVERY_CASE
def test_symmetric_is_exact_midway(first: float, step: float, axis: float) -> None:
    xy = images(first, step, axis)
    answer = disparity_cloud(*xy, step, OPTICS, variant="symmetric", tilt_axis_deg=axis, gauge=0.0)
    np.testing.assert_allclose(answer.points.xyz_um, truth(first + step / 2, axis), atol=1e-9 * 50)
    np.testing.assert_allclose(answer.in_first_view().xyz_um, truth(first, axis), atol=1e-9 * 50)
    assert answer.frame_tilt_deg == step / 2


@EVERY_CASE
def test_printed_halves_the_depth_midway_and_keeps_the_first_image(first: float, step: float, axis: float) -> None:
    """``d = 2 h sin(theta / 2)``, so d / (2 sin theta) is ``h / (2 cos(theta / 2))``."""
    xy = images(first, step, axis)
    cloud = disparity_cloud(*xy, step, OPTICS, tilt_axis_deg=axis, gauge=0.0).points
    halved = truth(first + step / 2, axis)[:, 2] / (2 * np.cos(np.deg2rad(step / 2)))
    np.testing.assert_allclose(cloud.xyz_um[:, 2], halved, atol=1e-9 * 50)
    np.testing.assert_allclose(cloud.xyz_um[:, :2], centred_um(xy[0], OPTICS) * [1, -1])


@pytest.mark.parametrize("variant", ["printed", "symmetric", "boyde"])
@pytest.mark.parametrize("axis", [0.0, 90.0, 200.0])
@pytest.mark.parametrize("step", [5.0, -5.0])
def test_what_is_raised_comes_out_raised(variant: str, axis: float, step: float) -> None:
    xyz = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 10.0]])
    rotations = rotations_from_tilts(np.array([-step / 2, step / 2]), axis)
    xy = [project(xyz, r, np.zeros(3), OPTICS) for r in rotations]
    heights = disparity_cloud(*xy, step, OPTICS, variant=variant, tilt_axis_deg=axis).points.xyz_um[:, 2]
    assert heights[1] - heights[0] > 4


def test_a_raised_point_moves_to_higher_columns_as_the_tilt_grows() -> None:
    shift = np.array([[400.0, 300.0]]), np.array([[402.0, 300.0]])
    assert disparity_cloud(*shift, 3.0, OPTICS, gauge=0.0).points.xyz_um[0, 2] > 0
    assert disparity_cloud(*shift, -3.0, OPTICS, gauge=0.0).points.xyz_um[0, 2] < 0


@EVERY_CASE
@pytest.mark.parametrize("variant", ["symmetric", "boyde"])
def test_known_rotation_gives_the_same_depth(first: float, step: float, axis: float, variant: str) -> None:
    """The seed's linear system and disparity with its geometry put right are one method; only the gauge may differ."""
    xy = images(first, step, axis, (3.0, -2.0)) + np.random.default_rng(1).normal(0, 0.4, (2, 301, 2))
    relative = CAM_FROM_VIEW @ tilt_rotation(step, axis) @ CAM_FROM_VIEW
    solved = solve_closed_form(centred_um(xy[0], OPTICS), centred_um(xy[1], OPTICS), relative)
    cloud = disparity_cloud(*xy, step, OPTICS, variant=variant, tilt_axis_deg=axis).in_first_view()
    difference = cloud.xyz_um[:, 2] + solved.depth_um
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


@pytest.mark.parametrize("variant", ["printed", "symmetric", "boyde"])
@pytest.mark.parametrize(("gauge", "statistic"), [("zero_median", np.median), ("zero_mean", np.mean)])
def test_gauge_takes_out_the_shift_of_the_stage(variant: str, gauge: str, statistic: object) -> None:
    options = {"variant": variant, "tilt_axis_deg": 35.0, "gauge": gauge}
    still, moved = (
        disparity_cloud(*images(0, 5, 35, shift), 5.0, OPTICS, **options) for shift in ((0.0, 0.0), (4.0, -7.0))
    )
    assert abs(statistic(still.points.xyz_um[:, 2])) < 1e-9
    np.testing.assert_allclose(moved.points.xyz_um, still.points.xyz_um, atol=1e-9)
    along = 4.0 * np.cos(np.deg2rad(35)) - 7.0 * np.sin(np.deg2rad(35))
    assert moved.offset_um - still.offset_um == pytest.approx(along, abs=1e-9)


@pytest.mark.parametrize("variant", ["printed", "symmetric"])
def test_swapping_the_views_and_the_sign_of_the_step_keeps_the_heights(variant: str) -> None:
    first, second = images(0, 7, 20)
    forward = disparity_cloud(first, second, 7.0, OPTICS, variant=variant, tilt_axis_deg=20)
    backward = disparity_cloud(second, first, -7.0, OPTICS, variant=variant, tilt_axis_deg=20)
    np.testing.assert_allclose(backward.points.xyz_um[:, 2], forward.points.xyz_um[:, 2], atol=1e-9)


@pytest.mark.parametrize("variant", ["printed", "symmetric", "boyde"])
def test_stated_covariance_is_the_scatter(variant: str) -> None:
    """Over 20,000 draws the normalised squared error of (x, y, z) averages 3, by each formula's own scale."""
    xy, rng = images(0, 6, 35)[:, :1], np.random.default_rng(2)
    noisy = xy + rng.normal(0, 0.3, (2, 20_000, 2))
    options = {"variant": variant, "tilt_axis_deg": 35.0, "gauge": 0.0}
    exact = disparity_cloud(*xy, 6.0, OPTICS, **options).points.xyz_um
    cloud = disparity_cloud(*noisy, 6.0, OPTICS, sigma_px=0.3, **options).points
    miss = cloud.xyz_um - exact
    ratio = np.einsum("ia,ab,ib->i", miss, np.linalg.inv(cloud.covariance_um2[0]), miss).mean() / 3
    assert 0.97 < ratio < 1.03


def test_missing_matches_are_missing_points_and_count_nowhere() -> None:
    first, second = images(0, 5, 0)
    second[4] = np.nan
    cloud = disparity_cloud(first, second, 5.0, OPTICS).points
    rest = np.arange(301) != 4
    assert np.isnan(cloud.xyz_um[4]).all()
    assert np.isnan(cloud.covariance_um2[4]).all()
    np.testing.assert_allclose(
        cloud.xyz_um[rest], disparity_cloud(first[rest], second[rest], 5.0, OPTICS).points.xyz_um
    )
    np.testing.assert_array_equal(cloud.xy_px, first)
    assert np.isnan(cloud.residual_px).all()  # disparity has no reprojection error, as the seed says


def test_what_cannot_be_answered_is_refused_with_a_sentence() -> None:
    xy = images(0, 5, 0)
    with pytest.raises(MethodError, match="must differ in tilt"):
        disparity_cloud(*xy, 0.0, OPTICS)
    with pytest.raises(MethodError, match="must differ in tilt"):
        disparity_cloud(*xy, float("nan"), OPTICS)
    with pytest.raises(MethodError, match="at least one complete match"):
        disparity_cloud(xy[0] * np.nan, xy[1], 5.0, OPTICS)
    with pytest.raises(InputError, match="one shape"):
        disparity_cloud(xy[0], xy[1][:5], 5.0, OPTICS)
    with pytest.raises(InputError, match="parallel projection"):
        disparity_cloud(*xy, 5.0, Optics(0.147, 854, 640, inverse_working_distance=1e-4))
