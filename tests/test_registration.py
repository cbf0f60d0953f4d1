"""Registration: exact recovery, the stopping rule of pcregistericp, and chains of clouds."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from semrecon.clouds.icp import step
from semrecon.clouds.registration import PcregistericpStop, icp, icp_open3d, register_sequence
from semrecon.data import PointCloud
from semrecon.errors import InputError
from semrecon.geometry import tilt_rotation
from semrecon.judging.metrics import relative_rotation_error_deg, rmse_um
from semrecon.numerics.motion import RigidMotion, fit_motion, rotation_angle_rad
from semrecon.numerics.neighbours import NearestNeighbours

KINDS = ("point_to_point", "point_to_plane", "generalized")


def motion(rotvec_deg, translation):
    return RigidMotion(Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix(), np.array(translation, dtype=float))


def lattice(side=7, step_um=10.0, seed=0):
    """Points far apart and off any symmetry, so a small motion leaves no doubt about who belongs to whom."""
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    xyz = step_um * (grid - (side - 1) / 2) + np.random.default_rng(seed).uniform(-2, 2, (side**3, 3))
    return xyz[: side**3 - 40]


def wavy(points=1500, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-50, 50, (points, 2))
    return np.column_stack([xy, 4 * np.sin(xy[:, 0] / 9) + 3 * np.cos(xy[:, 1] / 7 + xy[:, 0] / 13)])


def cloud(xyz, xy_px=None):
    n = len(xyz)
    covariance = np.broadcast_to(np.diag([0.01, 0.04, 0.25]), (n, 3, 3)).copy()
    return PointCloud(np.asarray(xyz, float), covariance, np.arange(n, dtype=float), np.zeros((n, 2)))


def test_icp_recovers_a_small_motion_exactly_where_pairs_are_unambiguous():
    fixed = lattice()
    truth = motion([0.5, -0.8, 0.6], [0.4, -0.3, 0.2])
    found = icp(truth.inverse.apply(fixed), fixed)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-13)
    np.testing.assert_allclose(found.translation_um, truth.translation_um, atol=1e-11)
    assert found.rmse_um < 1e-11
    assert found.converged


def test_icp_of_a_cloud_with_itself_stays_put_after_one_iteration():
    found = icp(wavy(), wavy())
    assert (found.iterations, found.converged) == (1, True)
    assert found.rmse_um < 1e-12
    assert rotation_angle_rad(found.rotation) < 1e-14


@pytest.mark.parametrize("method", [icp, *[partial(icp_open3d, kind=kind) for kind in KINDS]])
def test_every_kind_recovers_the_same_motion(method):
    fixed = wavy(3000)
    truth = motion([0.3, -0.5, 0.2], [0.3, -0.2, 0.1])
    found = method(truth.inverse.apply(fixed), fixed)
    assert relative_rotation_error_deg(truth.rotation, found.rotation) < 1e-4
    np.testing.assert_allclose(found.translation_um, truth.translation_um, atol=1e-3)


def test_open3d_point_to_point_ends_where_ours_does_on_noisy_clouds():
    rng = np.random.default_rng(3)
    fixed, moving = wavy(1500, 1) + rng.normal(0, 0.2, (1500, 3)), wavy(1500, 2)
    ours, theirs = icp(moving, fixed), icp_open3d(moving, fixed, tolerance=1e-12, max_iterations=2000)
    assert relative_rotation_error_deg(ours.rotation, theirs.rotation) < 2e-3
    assert ours.rmse_um == pytest.approx(theirs.rmse_um, rel=1e-4)


def test_icp_follows_a_rigid_motion_of_both_clouds():
    rng = np.random.default_rng(5)
    fixed, moving = wavy(800, 1), wavy(800, 2) @ tilt_rotation(1.0).T + rng.normal(0, 0.1, (800, 3))
    plain = icp(moving, fixed).fixed_from_moving
    new_from_old = motion([20, -35, 50], [3, -7, 11])
    moved = icp(new_from_old.apply(moving), new_from_old.apply(fixed), initial=RigidMotion.identity()).fixed_from_moving
    expected = new_from_old @ plain @ new_from_old.inverse
    np.testing.assert_allclose(moved.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(moved.translation_um, expected.translation_um, atol=1e-7)


def test_icp_does_not_depend_on_the_order_of_points_and_repeats_its_bits():
    fixed, moving = wavy(600, 1), wavy(600, 2)
    first, again = icp(moving, fixed), icp(moving, fixed)
    assert first.rotation.tobytes() == again.rotation.tobytes()
    order = np.random.default_rng(0).permutation(600)
    shuffled = icp(moving[order], fixed[order[::-1]])
    np.testing.assert_allclose(shuffled.rotation, first.rotation, atol=1e-12)


def test_icp_equals_the_plain_loop_that_asks_the_tree_every_time():
    fixed, moving = wavy(700, 1), wavy(700, 2) @ tilt_rotation(3.0).T
    found = icp(moving, fixed)
    tree, current = cKDTree(fixed), RigidMotion.identity()
    for _ in range(found.iterations):
        current = fit_motion(moving, fixed[tree.query(current.apply(moving))[1]])
    assert current.rotation.tobytes() == found.rotation.tobytes()
    assert found.iterations > 5


def test_rmse_of_a_registration_is_equation_7_in_the_direction_it_names():
    fixed, moving = wavy(700, 1), wavy(500, 2)
    found = icp(moving, fixed)
    expected = rmse_um(found.fixed_from_moving.apply(moving), fixed).moving_to_fixed_um
    assert found.rmse_um == pytest.approx(expected, rel=1e-12)


def test_a_good_start_finds_a_motion_that_the_identity_misses():
    fixed = lattice()
    truth = motion([0, 0, 150], [30, 0, 0])
    moving = truth.inverse.apply(fixed)
    near = motion([0.1, 0.1, 149.6], [29.6, 0.3, 0.2])
    assert icp(moving, fixed, initial=near).rmse_um < 1e-10
    assert icp(moving, fixed).rmse_um > 1.0


def test_stop_looks_at_the_mean_of_the_last_three_steps_and_at_both_tolerances():
    stop = PcregistericpStop(tolerance=(1.0, 0.1))
    quiet = (0.9, 0.09)
    assert not stop.reached([(1.3, 0.0)])
    assert stop.reached([(0.9, 0.05)])
    assert not stop.reached([(2.0, 0.0), (1.0, 0.0), (0.1, 0.0)])  # mean 1.03
    assert stop.reached([(9.0, 9.0), (1.9, 0.0), (1.0, 0.0), (0.1, 0.0)])  # mean 1.0: the bound itself counts
    assert not stop.reached([quiet, quiet, (0.0, 0.13)])  # only the rotation is too large
    assert not stop.reached([quiet, quiet, (1.3, 0.0)])  # only the translation is


def test_the_rotation_step_is_half_the_angle_as_quaternions_have_it():
    old, new = motion([0, 0, 10], [1, 2, 3]), motion([0, 0, 10.5], [1, 2, 7])
    translation, half_angle = step(new, old)
    assert translation == pytest.approx(4.0, abs=1e-12)
    assert half_angle == pytest.approx(0.25, abs=1e-12)
    product = Rotation.from_matrix(old.rotation).as_quat() @ Rotation.from_matrix(new.rotation).as_quat()
    assert half_angle == pytest.approx(np.rad2deg(np.arccos(abs(product))), abs=1e-6)


def test_looser_tolerance_stops_earlier_and_the_limit_of_iterations_shows():
    fixed, moving = wavy(600, 1), wavy(600, 2) @ tilt_rotation(3.0).T
    strict, loose = icp(moving, fixed), icp(moving, fixed, PcregistericpStop(tolerance=(1e-1, 1e-1)))
    assert loose.iterations < strict.iterations
    cut = icp(moving, fixed, PcregistericpStop(max_iterations=2))
    assert (cut.iterations, cut.converged) == (2, False)


def test_neighbours_are_exact_along_a_walk():
    rng = np.random.default_rng(0)
    fixed, points = rng.normal(size=(400, 3)), rng.normal(size=(300, 3))
    nearest, tree = NearestNeighbours(fixed), cKDTree(fixed)
    for size in (0.0, 0.3, 1e-3, 0.1, 1e-6, 0.0, 2.0):
        points = points + rng.normal(size=3) * size
        np.testing.assert_array_equal(nearest(points), tree.query(points)[1])


@pytest.mark.parametrize("method", [icp, icp_open3d])
@pytest.mark.parametrize(
    ("moving", "sentence"),
    [
        (np.zeros((2, 3)), "the moving cloud has 2 points; registration needs at least three"),
        (np.vstack([np.zeros((4, 3)), [np.nan, 0, 0]]), "1 of 5 points that are not finite"),
        (np.zeros((4, 2)), "must be of shape"),
    ],
)
def test_clouds_that_cannot_be_registered_get_a_sentence(method, moving, sentence):
    with pytest.raises(InputError, match=sentence):
        method(moving, wavy(10))


def test_open3d_says_what_is_wrong_with_its_options():
    with pytest.raises(InputError, match="kind must be one of"):
        icp_open3d(wavy(10), wavy(10), kind="coloured")
    with pytest.raises(InputError, match="longer distance"):
        icp_open3d(wavy(50) + 100, wavy(50), max_distance_um=0.1)


def test_iterations_must_be_allowed():
    with pytest.raises(InputError, match="max_iterations"):
        PcregistericpStop(max_iterations=0)


def test_fit_never_answers_with_a_reflection():
    fixed = np.random.default_rng(0).normal(size=(50, 3))
    found = fit_motion(fixed * [1, 1, -1], fixed)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(InputError, match="three pairs"):
        fit_motion(fixed[:2], fixed[:2])


@settings(max_examples=50, deadline=None)
@given(hnp.arrays(float, 3, elements=st.floats(-170, 170)), hnp.arrays(float, 3, elements=st.floats(-100, 100)))
def test_fit_inverse_and_chain_agree(rotvec, translation):
    if np.linalg.norm(rotvec) > 180:
        rotvec = rotvec / 2
    truth = motion(rotvec, translation)
    points = np.random.default_rng(0).normal(size=(20, 3))
    found = fit_motion(points, truth.apply(points))
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    np.testing.assert_allclose((truth.inverse @ found).apply(points), points, atol=1e-11)


def test_sequence_chains_the_motions_into_the_first_frame():
    base = lattice()
    steps = [motion([0.4, 0.2, -0.3], [0.3, 0, 0.1]), motion([-0.2, 0.5, 0.1], [0, 0.2, -0.1])]
    first_from_third = steps[0] @ steps[1]
    clouds = [cloud(base), cloud(steps[0].inverse.apply(base)), cloud(first_from_third.inverse.apply(base))]
    found = register_sequence(clouds)
    assert len(found.pairs) == 2
    np.testing.assert_allclose(found.first_from_each[0].rotation, np.eye(3), atol=0)
    np.testing.assert_allclose(found.first_from_each[2].rotation, first_from_third.rotation, atol=1e-12)
    np.testing.assert_allclose(found.merged.xyz_um, np.tile(base, (3, 1)), atol=1e-10)
    assert found.rmse_um < 1e-10


def test_merged_covariances_turn_with_their_cloud_and_pixels_stay_with_the_first():
    base = lattice()
    turn = motion([0, 0, 1.0], [0, 0, 0])
    found = register_sequence([cloud(base), cloud(turn.inverse.apply(base))])
    n = len(base)
    expected = turn.rotation @ np.diag([0.01, 0.04, 0.25]) @ turn.rotation.T
    np.testing.assert_allclose(found.merged.covariance_um2[n], expected, atol=1e-12)
    assert np.isfinite(found.merged.xy_px[:n]).all()
    assert np.isnan(found.merged.xy_px[n:]).all()
    np.testing.assert_array_equal(found.merged.residual_px[n:], np.arange(n))


def test_a_sequence_of_one_is_itself_and_of_none_an_error():
    alone = register_sequence([cloud(wavy(20))])
    assert alone.pairs == ()
    assert np.isnan(alone.rmse_um)
    with pytest.raises(InputError, match="at least one"):
        register_sequence([])
