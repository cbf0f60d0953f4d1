"""Claims about pose from points: exact on exact data, the best of all orientations, honest about noise and planes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Mask, Optics, PointCloud, Poses, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import CAM_FROM_VIEW, project, rotations_from_tilts
from semrecon.numerics.motion import rotation_angle_rad
from semrecon.points.triangulation import triangulate
from semrecon.pose.onp import find_minima, moments
from semrecon.pose.resection import AddedView, ResectionOptions, add_view, orthographic_pose, ransac_pose
from semrecon.pose.view_pose import OrthographicPose

PARALLEL = Optics(0.147, 854, 640)
PERSPECTIVE = Optics(0.147, 854, 640, inverse_working_distance=1e-4)
BOTH = pytest.mark.parametrize("optics", [PARALLEL, PERSPECTIVE], ids=["parallel", "perspective"])
T_UM = np.array([3.0, -2.0, 0.0])
GUIDE = Path(__file__).resolve().parent.parent / "docs" / "arbitrary-views.md"

seeds = st.integers(0, 2**32 - 1)


def any_rotation(rng: np.random.Generator) -> Array:
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


def points(rng: np.random.Generator, n: int, relief: float = 0.4) -> Array:
    return rng.uniform(-40, 40, (n, 3)) * [1, 1, relief]


def error_of(pose: OrthographicPose, rotation: Array, translation_um: Array = T_UM) -> Array:
    """Turn and shift from the estimate to the truth, in the parameters of the covariance, (5,)."""
    turn = Rotation.from_matrix(rotation @ pose.rotation.T).as_rotvec()
    return np.concatenate([turn, (translation_um - pose.translation_um)[:2]])


def normalised_square(pose: OrthographicPose, rotation: Array) -> float:
    error = error_of(pose, rotation)
    return float(error @ np.linalg.solve(pose.covariance, error))


@BOTH
@given(seed=seeds, n=st.integers(4, 40), relief=st.sampled_from([0.02, 0.4, 1.0]))
@settings(max_examples=15)
def test_exact_sightings_give_the_exact_pose(optics: Optics, seed: int, n: int, relief: float) -> None:
    rng = np.random.default_rng(seed)
    xyz, rotation = points(rng, n, relief), any_rotation(rng)
    assume(np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)[2] > 0.1)  # four points may lie on a plane by chance
    pose = orthographic_pose(xyz, project(xyz, rotation, T_UM, optics), optics)
    np.testing.assert_allclose(pose.rotation, rotation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.translation_um, T_UM, rtol=0, atol=1e-9)
    assert pose.alternative is None
    assert pose.residual_px.max() < 1e-7


@pytest.mark.parametrize("turn", [0.0, 45.0, 90.0, 180.0])
@pytest.mark.parametrize("tilt", [0.0, 3.0, 60.0, 90.0, 180.0])
def test_special_orientations_are_no_trap(tilt: float, turn: float) -> None:
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix() @ rotations_from_tilts(np.array([tilt]))[0]
    xyz = points(np.random.default_rng(5), 12)
    pose = orthographic_pose(xyz, project(xyz, rotation, T_UM, PARALLEL), PARALLEL)
    np.testing.assert_allclose(pose.rotation, rotation, rtol=0, atol=1e-9)
    assert pose.proven


@pytest.mark.parametrize("relief", [0.0, 0.05, 1.0])
def test_no_orientation_of_a_dense_grid_is_better(relief: float) -> None:
    grid = Rotation.from_rotvec(Rotation.random(20_000, random_state=1).as_rotvec()).as_matrix()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        xyz, rotation = rng.normal(size=(rng.integers(3, 9), 3)) * [1, 1, relief], any_rotation(rng)
        m = xyz @ rotation[:2].T + rng.normal(0, 0.6, (len(xyz), 2))  # noise as large as the scene: many minima
        x, y = xyz - xyz.mean(axis=0), m - m.mean(axis=0)
        found = find_minima(moments(xyz, m)).rotations[0]
        squares = ((y - np.einsum("gij,nj->gni", grid[:, :2], x)) ** 2).sum(axis=(1, 2))
        assert ((y - x @ found[:2].T) ** 2).sum() <= squares.min() + 1e-12


def test_what_is_called_proven_is_stationary_and_noise_can_forbid_it() -> None:
    rng = np.random.default_rng(3)
    proofs = []
    for noise in np.repeat([0.01, 3.0], 20):
        xyz = rng.normal(size=(6, 3))
        m = xyz @ any_rotation(rng)[:2].T + rng.normal(0, noise, (6, 2))
        sums = moments(xyz, m)
        found = find_minima(sums)
        proofs.append(found.proven)
        multiplier = found.rotations[0, :2] @ sums.points - sums.mixed.T
        across = multiplier @ found.rotations[0, 2]
        lagrange = multiplier @ found.rotations[0, :2].T
        np.testing.assert_allclose(across, 0, atol=1e-7)
        np.testing.assert_allclose(lagrange, lagrange.T, atol=1e-7)
    assert all(proofs[:20])
    assert not all(proofs[20:])


def calibration(optics: Optics, point_sigma_um: Array | None, stated: bool, runs: int = 120) -> tuple[float, float]:
    """Return the mean normalised square over 5, and the mean stated sigma over the true one."""
    rng, squares, sigmas = np.random.default_rng(11), [], []
    for _ in range(runs):
        truth, rotation = points(rng, 60), any_rotation(rng)
        xy = project(truth, rotation, T_UM, optics) + rng.normal(0, 0.3, (60, 2))
        xyz, covariance = truth, None
        if point_sigma_um is not None:
            xyz = truth + rng.normal(size=truth.shape) * point_sigma_um
            covariance = np.tile(np.diag(point_sigma_um**2), (60, 1, 1))
        pose = orthographic_pose(xyz, xy, optics, sigma_px=0.3 if stated else None, covariance_um2=covariance)
        squares.append(normalised_square(pose, rotation) / 5)
        sigmas.append(pose.sigma_px / 0.3)
    return float(np.mean(squares)), float(np.mean(sigmas))


@BOTH
def test_the_covariance_is_calibrated(optics: Optics) -> None:
    square, sigma = calibration(optics, None, stated=False)
    assert square == pytest.approx(1, abs=0.18)  # 0.058 is one sigma of 120 runs of 5
    assert sigma == pytest.approx(1, abs=0.03)


def test_the_covariance_is_calibrated_with_noisy_points() -> None:
    square, _ = calibration(PARALLEL, np.array([0.04, 0.04, 1.5]), stated=True)
    assert square == pytest.approx(1, abs=0.15)


def test_the_noise_of_a_sighting_is_told_from_few_points() -> None:
    """Six sightings have 12 numbers, five of which the pose absorbs: to forget that would lose a quarter of sigma."""
    rng, variances = np.random.default_rng(13), []
    for _ in range(150):
        xyz, rotation = points(rng, 6, 1.0), any_rotation(rng)
        xy = project(xyz, rotation, T_UM, PARALLEL) + rng.normal(0, 0.3, (6, 2))
        variances.append(orthographic_pose(xyz, xy, PARALLEL).sigma_px ** 2 / 0.09)
    assert np.mean(variances) == pytest.approx(1, abs=0.15)  # sqrt(2 / 7 / 150) = 0.044


@pytest.mark.parametrize("k", [0.0, 5e-3], ids=["parallel", "strong perspective"])
def test_the_covariance_is_that_of_numerical_derivatives(k: float) -> None:
    rng, optics, step = np.random.default_rng(14), Optics(0.147, 854, 640, k), 1e-6
    xyz, rotation = points(rng, 20), any_rotation(rng)

    def seen(change: Array) -> Array:
        turned = Rotation.from_rotvec(change[:3]).as_matrix() @ rotation
        return project(xyz, turned, T_UM + np.append(change[3:], 0.0), optics).ravel()

    jacobian = np.stack([(seen(step * one) - seen(-step * one)) / (2 * step) for one in np.eye(5)], axis=1)
    pose = orthographic_pose(xyz, seen(np.zeros(5)).reshape(-1, 2), optics, sigma_px=0.3)
    np.testing.assert_allclose(pose.rotation, rotation, rtol=0, atol=1e-9)
    expected = 0.09 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(pose.covariance, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(pose.covariance[:3, :3], expected[:3, :3], rtol=0, atol=1e-4 * expected[:3, :3].max())


def test_noise_of_points_that_is_ignored_flattens_the_relief() -> None:
    """Depths with noise as large as the relief: plain least squares sees too small a tilt, the full cost does not."""
    rng, rotation = np.random.default_rng(2), rotations_from_tilts(np.array([50.0]))[0]
    truth, sigma = points(rng, 4000, 0.1), np.array([0.01, 0.01, 2.0])
    xy = project(truth, rotation, T_UM, PARALLEL) + rng.normal(0, 0.3, (4000, 2))
    noisy = truth + rng.normal(size=truth.shape) * sigma
    covariance = np.tile(np.diag(sigma**2), (4000, 1, 1))
    plain = orthographic_pose(noisy, xy, PARALLEL)
    full = orthographic_pose(noisy, xy, PARALLEL, sigma_px=0.3, covariance_um2=covariance)
    assert normalised_square(full, rotation) < 20.5  # chi-square of 5, one in a thousand
    assert rotation_angle_rad(plain.rotation @ rotation.T) > 3 * rotation_angle_rad(full.rotation @ rotation.T)


@given(seed=seeds)
@settings(max_examples=15)
def test_turning_the_world_or_the_image_turns_the_answer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz, rotation, world, angle = points(rng, 15), any_rotation(rng), any_rotation(rng), rng.uniform(-np.pi, np.pi)
    xy = project(xyz, rotation, T_UM, PARALLEL) + rng.normal(0, 0.3, (15, 2))
    plain = orthographic_pose(xyz, xy, PARALLEL)
    turned = orthographic_pose(xyz @ world.T, xy, PARALLEL)
    np.testing.assert_allclose(turned.rotation, plain.rotation @ world.T, rtol=0, atol=1e-8)
    np.testing.assert_allclose(turned.translation_um, plain.translation_um, rtol=0, atol=1e-8)
    spin = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    spun = orthographic_pose(xyz, PARALLEL.centre_px + (xy - PARALLEL.centre_px) @ spin[:2, :2].T, PARALLEL)
    np.testing.assert_allclose(spun.rotation, spin @ plain.rotation, rtol=0, atol=1e-8)
    np.testing.assert_allclose(spun.covariance[:3, :3], spin @ plain.covariance[:3, :3] @ spin.T, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("n", [3, 30])
def test_a_plane_has_two_poses_and_one_of_them_is_right(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        xyz, rotation = points(rng, n, 0.0), any_rotation(rng)
        pose = orthographic_pose(xyz, project(xyz, rotation, T_UM, PARALLEL), PARALLEL)
        assert pose.alternative is not None
        both = (pose, pose.alternative)
        assert min(rotation_angle_rad(one.rotation @ rotation.T) for one in both) < 1e-6
        assert all(one.residual_px.max() < 1e-6 for one in both)
        normals = [one.rotation[:, 2] for one in both]  # slopes of opposite sign
        np.testing.assert_allclose(normals[0][:2], -normals[1][:2] * np.sign(normals[0][2] * normals[1][2]), atol=1e-6)


def test_a_plane_seen_face_on_says_that_its_slope_is_unknown() -> None:
    xyz = points(np.random.default_rng(0), 20, 0.0)
    pose = orthographic_pose(xyz, project(xyz, CAM_FROM_VIEW, T_UM, PARALLEL), PARALLEL)
    assert rotation_angle_rad(pose.rotation @ CAM_FROM_VIEW.T) < 1e-3
    known = np.isfinite(pose.covariance).all()
    assert not known or np.sqrt(pose.covariance[:2, :2].diagonal()).min() > 1e3 * np.sqrt(pose.covariance[2, 2])


def test_relief_turned_inside_out_fits_as_well() -> None:
    """A limit, not a merit: a later view cannot tell that the tilts of the first ones have the wrong sign."""
    rng = np.random.default_rng(4)
    xyz, rotation = points(rng, 30), any_rotation(rng)
    inside_out = orthographic_pose(xyz * [1, 1, -1], project(xyz, rotation, T_UM, PARALLEL), PARALLEL)
    assert inside_out.residual_px.max() < 1e-8
    assert rotation_angle_rad(inside_out.rotation @ rotation.T) > 0.1


def spoiled(rng: np.random.Generator, n: int, wrong: float, relief: float) -> tuple[Array, Array, Array, Mask]:
    """Return points, sightings, the rotation, and which sightings are wrong."""
    xyz, rotation = points(rng, n, relief), any_rotation(rng)
    xy = project(xyz, rotation, T_UM, PARALLEL) + rng.normal(0, 0.3, (n, 2))
    bad = rng.permutation(n) < wrong * n
    xy[bad] = rng.uniform(0, 640, (int(bad.sum()), 2))
    return xyz, xy, rotation, bad


@pytest.mark.parametrize("relief", [0.05, 0.4])
@pytest.mark.parametrize("n", [40, 300])
def test_half_of_the_sightings_may_be_wrong(n: int, relief: float) -> None:
    rng = np.random.default_rng(n)
    xyz, xy, rotation, bad = spoiled(rng, n, 0.5, relief)
    found = ransac_pose(xyz, xy, PARALLEL, rng, 1.5)
    assert found.inliers[~bad].mean() > 0.97
    assert found.inliers[bad].mean() <= 0.05
    assert normalised_square(found.pose, rotation) < 20.5
    plain = orthographic_pose(xyz, xy, PARALLEL)
    assert rotation_angle_rad(plain.rotation @ rotation.T) > 0.05


def test_the_same_seed_gives_the_same_pose_and_missing_rows_change_nothing() -> None:
    xyz, xy, _, _ = spoiled(np.random.default_rng(8), 60, 0.3, 0.4)
    first, again = (ransac_pose(xyz, xy, PARALLEL, np.random.default_rng(1), 1.5) for _ in range(2))
    np.testing.assert_array_equal(first.pose.rotation, again.pose.rotation)
    holes = np.full((3, 2), np.nan)
    more = ransac_pose(
        np.vstack([np.ones((3, 3)), xyz]), np.vstack([holes, xy]), PARALLEL, np.random.default_rng(1), 1.5
    )
    np.testing.assert_allclose(more.pose.rotation, first.pose.rotation, rtol=0, atol=1e-12)
    assert not more.inliers[:3].any()
    assert np.isnan(more.pose.residual_px[:3]).all()


def test_a_hundred_thousand_points_are_no_more_search_than_three() -> None:
    rng = np.random.default_rng(6)
    xyz, rotation = points(rng, 100_000), any_rotation(rng)
    xy = project(xyz, rotation, T_UM, PARALLEL) + rng.normal(0, 0.3, (100_000, 2))
    pose = orthographic_pose(xyz, xy, PARALLEL)
    assert normalised_square(pose, rotation) < 20.5
    assert pose.sigma_px == pytest.approx(0.3, rel=0.01)
    assert moments(xyz, xy).points.shape == (3, 3)


LINE = np.linspace(-1, 1, 9)[:, None] * [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("xyz", "sentence"),
    [
        (np.eye(3)[:2], "at least 3 points, not 2"),
        (np.zeros((0, 3)), "at least 3 points, not 0"),
        (np.full((5, 3), np.nan), "at least 3 points, not 0"),
        (LINE, "on one line"),
        (np.ones((7, 3)), "on one line"),
    ],
    ids=["two", "none", "missing", "line", "one place"],
)
def test_too_little_is_said_in_a_sentence(xyz: Array, sentence: str) -> None:
    with pytest.raises(MethodError, match=sentence):
        orthographic_pose(xyz, np.zeros((len(xyz), 2)), PARALLEL)
    with pytest.raises(MethodError):
        ransac_pose(xyz, np.zeros((len(xyz), 2)), PARALLEL, np.random.default_rng(0))


def test_noise_alone_is_no_pose() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(MethodError, match="no 4 of 30 sightings agree"):
        ransac_pose(points(rng, 30), rng.uniform(0, 640, (30, 2)), PARALLEL, rng, 0.01)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"xy_px": np.zeros((4, 2))}, "points \\(n, 3\\)"),
        ({"sigma_px": 0.0}, "positive number of pixels"),
        ({"covariance_um2": np.zeros((5, 3, 3))}, "need sigma_px"),
        ({"covariance_um2": np.zeros((5, 3)), "sigma_px": 1.0}, "must be of shape"),
    ],
)
def test_input_that_does_not_fit_is_refused(change: dict[str, object], sentence: str) -> None:
    arguments = {"xyz_um": np.zeros((5, 3)), "xy_px": np.zeros((5, 2)), "optics": PARALLEL} | change
    with pytest.raises(InputError, match=sentence):
        orthographic_pose(**arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="threshold_px"):
        ransac_pose(np.zeros((5, 3)), np.zeros((5, 2)), PARALLEL, np.random.default_rng(0), -1.0)


def three_views(seed: int, n: int = 150) -> tuple[Array, Poses, Array, PointCloud]:
    """Return points, true poses (0 and 10 degrees, then any), sightings (n, 3, 2), and the cloud of the first two."""
    rng = np.random.default_rng(seed)
    xyz, rotations = points(rng, n), rotations_from_tilts(np.array([0.0, 10.0]))
    poses = Poses(np.stack([*rotations, any_rotation(rng)]), np.stack([np.zeros(3), -T_UM, T_UM]))
    exact = [project(xyz, r, t, PARALLEL) for r, t in zip(poses.rotations, poses.translations_um, strict=True)]
    xy = np.stack(exact, axis=1) + rng.normal(0, 0.3, (n, 3, 2))
    first = Poses(poses.rotations[:2], poses.translations_um[:2])
    return xyz, poses, xy, triangulate(Tracks(xy[:, :2]), first, PARALLEL, sigma_px=0.3)


def add_third(xy: Array, cloud: PointCloud, poses: Poses, seed: int, options: ResectionOptions) -> AddedView:
    """Matches in another order, a third of them wrong, and some far from every point."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(xy))
    reference, new = xy[order, 0].copy(), xy[order, 2].copy()
    new[: len(xy) // 3] = rng.uniform(0, 640, (len(xy) // 3, 2))
    reference[-10:] += 1000
    first = Poses(poses.rotations[:2], poses.translations_um[:2])
    return add_view(cloud, reference, new, first, PARALLEL, rng, options)


def test_a_third_view_of_any_orientation_joins_two_tilted_ones() -> None:
    squares, gains, misses = [], [], []
    for seed in range(8):
        xyz, poses, xy, cloud = three_views(seed)
        added = add_third(xy, cloud, poses, seed, ResectionOptions(sigma_px=0.3, threshold_px=1.5))
        assert (added.matches, added.joined) == (150, 140)
        assert 85 <= added.inliers <= 100  # 90 are right, and a wrong one may pass where the point is uncertain
        assert len(added.poses) == 3
        squares.append(normalised_square(added.pose, poses.rotations[2]) / 5)
        tracks = Tracks(np.concatenate([xy[:, :2], added.xy_px[:, None]], axis=1))
        refined = triangulate(tracks, added.poses, PARALLEL, sigma_px=0.3)
        seen = np.isfinite(added.xy_px).all(axis=1)
        gains.append(np.median(refined.sigma_um[seen]) / np.median(cloud.sigma_um))
        misses.append(
            np.sqrt(np.mean((refined.xyz_um - xyz)[seen, 2] ** 2) / np.mean((cloud.xyz_um - xyz)[seen, 2] ** 2))
        )
    assert 0.4 < np.mean(squares) < 1.7  # 40 numbers: one sigma is 0.22
    assert np.median(gains) < 0.5
    assert np.median(misses) < 0.6


def test_a_cloud_without_covariance_serves_as_well() -> None:
    _, poses, xy, cloud = three_views(1)
    bare = PointCloud(cloud.xyz_um, np.full_like(cloud.covariance_um2, np.nan), cloud.residual_px, cloud.xy_px)
    added = add_third(xy, bare, poses, 1, ResectionOptions(threshold_px=6.0))
    assert rotation_angle_rad(added.pose.rotation @ poses.rotations[2].T) < np.deg2rad(2)


def test_two_matches_to_one_point_leave_the_nearest() -> None:
    _, poses, xy, cloud = three_views(2)
    first = Poses(poses.rotations[:2], poses.translations_um[:2])
    reference, new = np.concatenate([xy[:, 0] + 0.2, xy[:, 0]]), np.concatenate([xy[:, 2] + 500, xy[:, 2]])
    options = ResectionOptions(sigma_px=0.3)
    added = add_view(cloud, reference, new, first, PARALLEL, np.random.default_rng(0), options)
    assert added.joined == len(cloud)
    np.testing.assert_array_equal(added.xy_px[np.isfinite(added.xy_px[:, 0])], xy[np.isfinite(added.xy_px[:, 0]), 2])


def test_a_view_that_cannot_be_added_says_why() -> None:
    _, poses, xy, cloud = three_views(3)
    rng = np.random.default_rng(0)
    with pytest.raises(MethodError, match="only 0 of 150 matches"):
        add_view(cloud, xy[:, 0] + 1000, xy[:, 2], poses, PARALLEL, rng)
    with pytest.raises(MethodError, match="agree"):
        add_view(cloud, xy[:, 0], rng.uniform(0, 640, (150, 2)), poses, PARALLEL, rng, ResectionOptions(sigma_px=0.05))
    with pytest.raises(InputError, match="twice"):
        add_view(cloud, xy[:, 0], xy[:9, 2], poses, PARALLEL, rng)


def test_a_flat_specimen_comes_with_a_warning() -> None:
    rng = np.random.default_rng(5)
    xyz, rotation = points(rng, 50, 0.0), rotations_from_tilts(np.array([30.0]))[0]
    start = Poses(CAM_FROM_VIEW[None], np.zeros((1, 3)))
    reference = project(xyz, CAM_FROM_VIEW, np.zeros(3), PARALLEL)
    cloud = PointCloud(xyz, np.full((50, 3, 3), np.nan), np.zeros(50), reference)
    added = add_view(cloud, reference, project(xyz, rotation, T_UM, PARALLEL), start, PARALLEL, rng)
    assert any("two orientations" in sentence for sentence in added.warnings)


def test_the_example_of_the_guide_runs() -> None:
    example = re.search(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert example is not None
    names: dict[str, object] = {}
    exec(example[1], names)
    added = names["added"]
    assert isinstance(added, AddedView)
    assert rotation_angle_rad(added.pose.rotation @ np.asarray(names["true_rotation"]).T) < np.deg2rad(0.5)
    assert added.warnings == ()
