"""Claims about geometry that determines nothing, or too little: NaN or a sentence, never a number out of nowhere.

What is claimed of every step: it answers with numbers that are finite or NaN and an honest covariance, or it raises
`InputError` or `MethodError`. No other exception, no warning, no finite value that the input cannot support.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semrecon.adjustment.refinement import Refinement, RefinementOptions, refine
from semrecon.clouds.icp import PcregistericpStop, icp
from semrecon.clouds.registration import icp_open3d, register_sequence
from semrecon.data import Array, Optics, PointCloud, Poses, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um, project, rotations_from_tilts
from semrecon.points.joint_translation import solve_series
from semrecon.points.sightings import without_wrong_sightings
from semrecon.points.translation import solve_closed_form
from semrecon.points.triangulation import triangulate
from semrecon.pose.resection import add_view, ransac_pose
from semrecon.pose.view_pose import orthographic_pose
from semrecon.surface.meshing import height_map_from_points, mesh_from_points, without_outliers

OPTICS = Optics(0.2, 200, 160)
PERSPECTIVE = Optics(0.2, 200, 160, inverse_working_distance=1 / 5000)
NOISE_PX = 0.3
FEW = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))

SHAPES: dict[str, Callable[[Array], Array]] = {
    "relief": lambda u: u * [18, 14, 6],
    "line": lambda u: u[:, :1] * [18, 10, 5],
    "vertical line": lambda u: u[:, :1] * [0, 0, 6],
    "plane": lambda u: np.column_stack([18 * u[:, 0], 14 * u[:, 1], 3 * u[:, 0]]),
    "flat": lambda u: u * [18, 14, 0],
    "one place": lambda u: np.tile([3.0, 2.0, 1.0], (len(u), 1)),
    "twins": lambda u: np.repeat(u[::2], 2, axis=0)[: len(u)] * [18, 14, 6],
}
TILTS = {
    "usual": (0.0, 3.0, 6.0, 9.0),
    "two": (0.0, 5.0),
    "twice the same": (0.0, 3.0, 3.0),
    "all the same": (3.0, 3.0, 3.0),
    "hardly any": (0.0, 0.001, 0.002),
    "edge on": (0.0, 45.0, 90.0),
}
HARM = ["none", "a NaN", "many NaNs", "infinite", "a view lost", "huge"]


def cloud_of(xyz: Array, sigma_um: float = 0.1) -> PointCloud:
    n = len(xyz)
    xy = project(np.where(np.isfinite(xyz), xyz, np.nan), rotations_from_tilts(np.zeros(1))[0], np.zeros(3), OPTICS)
    return PointCloud(xyz, np.tile(sigma_um**2 * np.eye(3), (n, 1, 1)), np.full(n, 0.1), xy)


def made(
    shape: str, points: int, tilts: tuple[float, ...], optics: Optics = OPTICS, seed: int = 0
) -> tuple[Array, Poses, Array]:
    """Points, poses, and sightings (points, views, 2) with noise."""
    rng = np.random.default_rng(seed)
    xyz = SHAPES[shape](rng.uniform(-1, 1, (points, 3)))
    rotations = rotations_from_tilts(np.array(tilts))
    poses = Poses(rotations, np.zeros((len(tilts), 3)))
    seen = np.stack([project(xyz, r, np.zeros(3), optics) for r in rotations], axis=1)
    return xyz, poses, seen + rng.normal(0, NOISE_PX, seen.shape)


def harmed(xy: Array, harm: str) -> Array:
    spoilt = xy.copy()
    if not len(xy):
        return spoilt
    if harm == "a NaN":
        spoilt[0, 0, 0] = np.nan
    elif harm == "many NaNs":
        spoilt[np.random.default_rng(1).random(xy.shape[:2]) < 0.4] = np.nan
    elif harm == "infinite":
        spoilt[0, -1] = [np.inf, -np.inf]
    elif harm == "a view lost":
        spoilt[:, -1] = np.nan
    elif harm == "huge":
        spoilt[0, 0] = 1e12
    return spoilt


def attempt(call: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Answer of a call, or None where it says in a sentence why there is none."""
    said = ""
    try:
        return call(*args, **options)
    except (InputError, MethodError) as error:
        said = str(error)
    assert len(said.split()) > 4
    return None


def assert_no_infinity(*values: Any) -> None:
    for value in values:
        assert not np.isinf(np.asarray(value, dtype=np.float64)).any()


cases = given(
    shape=st.sampled_from(sorted(SHAPES)),
    points=st.sampled_from([0, 1, 2, 3, 4, 7, 40]),
    tilts=st.sampled_from(sorted(TILTS)),
    harm=st.sampled_from(HARM),
    optics=st.sampled_from([OPTICS, PERSPECTIVE]),
)


@FEW
@cases
def test_pair_translation(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    _, poses, xy = made(shape, points, TILTS[tilts], optics)
    xy = harmed(xy, harm)
    relative = poses.rotations[-1] @ poses.rotations[0].T
    answer = attempt(solve_closed_form, centred_um(xy[:, 0], optics), centred_um(xy[:, -1], optics), relative)
    if answer is not None:
        assert np.isfinite(answer.translation_um).all()
        assert_no_infinity(answer.depth_um, answer.epipolar_um, answer.condition)
        complete = np.isfinite(xy[:, [0, -1]]).all(axis=(1, 2))
        np.testing.assert_array_equal(np.isfinite(answer.depth_um), complete)


@FEW
@cases
def test_series_translation(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    _, poses, xy = made(shape, points, TILTS[tilts], optics)
    answer = attempt(solve_series, Tracks(harmed(xy, harm)), poses.rotations, optics)
    if answer is not None:
        assert np.isfinite(answer.poses.translations_um).all()
        assert_no_infinity(answer.xyz_um, answer.weights, answer.scale_px, answer.condition)


@FEW
@cases
def test_triangulation(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    xyz, poses, xy = made(shape, points, TILTS[tilts], optics)
    tracks = Tracks(harmed(xy, harm))
    for each in (tracks, without_wrong_sightings(tracks, poses, optics)):
        cloud = attempt(triangulate, each, poses, optics, sigma_px=NOISE_PX)
        assert_no_infinity(cloud.xyz_um, cloud.covariance_um2, cloud.residual_px)
        known = np.isfinite(cloud.xyz_um).all(axis=1)
        assert not known[each.seen.sum(axis=1) < 2].any()
        np.testing.assert_array_equal(known, np.isfinite(cloud.covariance_um2).all(axis=(1, 2)))
        if tilts == "all the same" and optics is OPTICS:
            assert not known.any()
        if harm != "huge" and known.any():
            error = np.abs(cloud.xyz_um - xyz)[known, 2]
            assert (error < 8 * cloud.sigma_um[known] + 1e-9).all()


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@cases
def test_refinement(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    _, _, xy = made(shape, points, TILTS[tilts], optics)
    stated = np.array(TILTS[tilts])
    answer: Refinement | None = attempt(refine, Tracks(harmed(xy, harm)), stated, optics)
    if answer is None:
        return
    for value in (answer.tilts_deg, answer.shifts_um, answer.magnifications, answer.rotations_deg, answer.sigma_px):
        assert np.isfinite(value).all()
    assert (answer.tilt_sigma_deg <= 0.1 * 1.001).all()
    assert np.linalg.eigvalsh(answer.tilt_covariance_deg2).min() > -1e-8  # of a variance of 1e-2
    assert np.abs(answer.tilts_deg - stated).max() < 1.0
    assert_no_infinity(answer.points.xyz_um, answer.points.covariance_um2, answer.points.residual_px)
    known = np.isfinite(answer.points.xyz_um).all(axis=1)
    assert np.isfinite(answer.points.covariance_um2[known]).all()


@FEW
@cases
def test_pose_from_points(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    xyz, _, xy = made(shape, points, TILTS[tilts], optics)
    rng = np.random.default_rng(0)
    view = harmed(xy, harm)[:, -1]
    for answer in (
        attempt(orthographic_pose, xyz, view, optics),
        getattr(attempt(ransac_pose, xyz, view, optics, rng, trials=20), "pose", None),
    ):
        if answer is not None:
            np.testing.assert_allclose(answer.rotation @ answer.rotation.T, np.eye(3), atol=1e-9)
            assert shape not in ("line", "vertical line", "one place")
            assert_no_infinity(answer.translation_um, answer.covariance, answer.residual_px)
            assert len(xyz) > 3 or not np.isfinite(answer.covariance).all()


@FEW
@cases
def test_added_view(shape: str, points: int, tilts: str, harm: str, optics: Optics) -> None:
    xyz, poses, xy = made(shape, points, TILTS[tilts], optics)
    spoilt = harmed(xy, harm)
    cloud = PointCloud(xyz, np.tile(0.01 * np.eye(3), (len(xyz), 1, 1)), np.zeros(len(xyz)), xy[:, 0])
    rng = np.random.default_rng(0)
    answer = attempt(add_view, cloud, spoilt[:, 0], spoilt[:, -1], poses, optics, rng)
    if answer is not None:
        assert answer.inliers >= 12
        assert shape not in ("line", "vertical line", "one place")
        assert np.isfinite(answer.pose.rotation).all()


def spoilt_cloud(shape: str, points: int, harm: str) -> PointCloud:
    xyz = SHAPES[shape](np.random.default_rng(2).uniform(-1, 1, (points, 3)))
    return cloud_of(harmed(xyz[:, None, :], harm)[:, 0] if harm != "infinite" else with_infinity(xyz))


def with_infinity(xyz: Array) -> Array:
    spoilt = xyz.copy()
    spoilt[:1] = np.inf
    return spoilt


clouds = given(
    shape=st.sampled_from(sorted(SHAPES)), points=st.sampled_from([0, 1, 2, 3, 5, 60]), harm=st.sampled_from(HARM[:4])
)


@FEW
@clouds
def test_registration(shape: str, points: int, harm: str) -> None:
    moving, fixed = spoilt_cloud(shape, points, harm), spoilt_cloud("relief", 30, "none")
    stop = PcregistericpStop(max_iterations=50)
    for pair in ((moving, fixed), (fixed, moving)):
        for answer in (attempt(icp, *pair, stop), attempt(icp_open3d, *pair)):
            if answer is not None:
                np.testing.assert_allclose(answer.rotation @ answer.rotation.T, np.eye(3), atol=1e-6)
                assert np.linalg.det(answer.rotation) > 0
                assert np.isfinite(answer.rmse_um)
    chain = attempt(register_sequence, [moving, fixed, moving], lambda a, b: icp(a, b, stop))
    assert chain is None or len(chain.merged) == 2 * len(moving) + len(fixed)


@FEW
@clouds
def test_surfaces(shape: str, points: int, harm: str) -> None:
    cloud = spoilt_cloud(shape, points, harm)
    heights = attempt(height_map_from_points, cloud, OPTICS)
    mesh = attempt(mesh_from_points, cloud)
    thinned = attempt(without_outliers, cloud)
    if shape in ("line", "vertical line", "one place"):
        assert heights is None
        assert mesh is None
    if heights is not None:
        assert_no_infinity(heights.z_um, heights.sigma_um)
        finite = np.isfinite(cloud.xyz_um).all(axis=1)
        low, high = cloud.xyz_um[finite, 2].min(), cloud.xyz_um[finite, 2].max()
        covered = np.isfinite(heights.z_um)
        assert (heights.z_um[covered] >= low - 1e-9).all()
        assert (heights.z_um[covered] <= high + 1e-9).all()
    if mesh is not None:
        assert np.isfinite(mesh.vertices_um).all()
    assert thinned is None or len(thinned) <= len(cloud)


def test_views_along_one_beam_have_no_depth() -> None:
    """Parallel projection: a tilt given twice is no tilt, in any of the steps."""
    _, poses, xy = made("relief", 50, (4.0, 4.0))
    assert np.isnan(triangulate(Tracks(xy), poses, OPTICS).xyz_um).all()
    with pytest.raises(MethodError, match="beam"):
        solve_closed_form(centred_um(xy[:, 0], OPTICS), centred_um(xy[:, 1], OPTICS), np.eye(3))
    for call in (
        lambda: solve_series(Tracks(xy), poses.rotations, OPTICS),
        lambda: refine(Tracks(xy), np.array([4.0, 4.0]), OPTICS),
    ):
        with pytest.raises(MethodError, match="beam"):
            call()


@pytest.mark.parametrize("step_deg", [0.001, 0.01, 0.1])
def test_hardly_any_tilt_is_hardly_any_knowledge(step_deg: float) -> None:
    """Sigma of depth grows as the tilt shrinks, sigma = sqrt(2) noise / sin(step): large is right, small is a lie."""
    xyz, poses, xy = made("relief", 400, (0.0, step_deg))
    cloud = triangulate(Tracks(xy), poses, OPTICS, sigma_px=NOISE_PX)
    expected = np.sqrt(2) * NOISE_PX * OPTICS.pixel_size_um / np.sin(np.deg2rad(step_deg))
    np.testing.assert_allclose(cloud.sigma_um, expected, rtol=1e-3)
    normalised = (cloud.xyz_um - xyz)[:, 2] / cloud.sigma_um
    assert np.mean(normalised**2) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("optics", [OPTICS, PERSPECTIVE], ids=["parallel", "perspective"])
@pytest.mark.parametrize("shape", ["plane", "flat", "line"])
def test_a_flat_specimen_does_not_tell_its_tilts(shape: str, optics: Optics) -> None:
    """Three views of a plane fix neither tilt nor magnification beyond what was stated: the sigma must say so."""
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        true = np.array([0.0, 5.0, 10.0])
        _, _, xy = made(shape, 150, tuple(true), optics, seed)
        stated = true + rng.normal(0, 0.1, 3)
        answer = attempt(refine, Tracks(xy), stated, optics, options=RefinementOptions(magnification_sigma=0.001))
        if answer is None:
            continue
        error = answer.tilts_deg - true
        errors.append(error @ np.linalg.solve(answer.tilt_covariance_deg2, error) / 3)
    if shape != "line":
        assert errors
    assert not errors or np.mean(errors) < 2.5


@pytest.mark.slow
def test_a_million_points() -> None:
    _, poses, xy = made("relief", 1_000_000, (0.0, 6.0, 12.0))
    assert np.isfinite(
        solve_closed_form(
            *(centred_um(xy[:, v], OPTICS) for v in (0, 2)), poses.rotations[2] @ poses.rotations[0].T
        ).depth_um
    ).all()
    answer = refine(Tracks(xy), np.array([0.0, 6.0, 12.0]), OPTICS)
    assert np.isfinite(answer.points.xyz_um).mean() > 0.99
    heights = height_map_from_points(
        without_outliers(answer.points.keep(np.isfinite(answer.points.residual_px))), OPTICS
    )
    assert np.isfinite(heights.z_um).mean() > 0.3
