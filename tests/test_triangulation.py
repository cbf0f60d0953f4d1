"""Claims about triangulation: exact where the sightings are, honest about what it is not told."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Optics, Poses, Tracks
from semrecon.errors import InputError
from semrecon.geometry import centred_um, project, rotations_from_tilts, view_from_world
from semrecon.numerics.point_bands import in_bands
from semrecon.points import beams
from semrecon.points.translation import solve_closed_form
from semrecon.points.triangulation import (
    pair_cloud,
    residuals_px,
    triangulate,
)

PARALLEL = Optics(0.147, 854, 640)
PERSPECTIVE = Optics(0.147, 854, 640, inverse_working_distance=1 / 3000)
BOTH = pytest.mark.parametrize("optics", [PARALLEL, PERSPECTIVE], ids=["parallel", "perspective"])


def poses_at(tilts_deg: list[float], axis_deg: float = 0.0) -> Poses:
    t = np.random.default_rng(len(tilts_deg)).uniform(-8, 8, (len(tilts_deg), 3))
    t[:, 2] = 0
    return Poses(rotations_from_tilts(np.array(tilts_deg), axis_deg), t)


def sightings(xyz: Array, poses: Poses, optics: Optics) -> Array:
    views = zip(poses.rotations, poses.translations_um, strict=True)
    return np.stack([project(xyz, r, t, optics) for r, t in views], axis=1)


def points(n: int = 200, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-30, 30, (n, 3))


@BOTH
@pytest.mark.parametrize(("tilts", "axis"), [([0, 3], 0), ([0, 3, 6, 9], 0), ([-10, 0, 10], 90), ([0, -15, -30], 25)])
def test_exact_sightings_give_exact_points(optics: Optics, tilts: list[float], axis: float) -> None:
    poses, xyz = poses_at(tilts, axis), points()
    cloud = triangulate(Tracks(sightings(xyz, poses, optics)), poses, optics)
    np.testing.assert_allclose(cloud.xyz_um, xyz, rtol=0, atol=1e-9 * 30)
    np.testing.assert_allclose(cloud.residual_px, 0, atol=1e-8)


@BOTH
def test_a_view_that_misses_a_point_is_as_if_it_were_not_there(optics: Optics) -> None:
    poses = poses_at([0, 5, 10])
    xy = sightings(points(), poses, optics) + np.random.default_rng(1).normal(0, 0.5, (200, 3, 2))
    some = xy.copy()
    some[:, 1, 0] = np.nan
    cloud = triangulate(Tracks(some), poses, optics, sigma_px=0.5)
    two = Poses(poses.rotations[[0, 2]], poses.translations_um[[0, 2]])
    other = triangulate(Tracks(xy[:, [0, 2]]), two, optics, sigma_px=0.5)
    np.testing.assert_allclose(cloud.xyz_um, other.xyz_um, atol=1e-8)
    np.testing.assert_allclose(cloud.covariance_um2, other.covariance_um2, rtol=1e-9)
    np.testing.assert_allclose(cloud.residual_px, other.residual_px, atol=1e-8)


@BOTH
def test_points_without_two_beams_are_missing_throughout(optics: Optics) -> None:
    poses, xyz = poses_at([0, 0, 8]), points(4)
    xy = sightings(xyz, poses, optics)
    xy[0, 1:], xy[1] = np.nan, np.nan  # seen once, never
    xy[2, 2] = np.nan  # seen twice along one beam
    cloud = triangulate(Tracks(xy), poses, optics)
    if optics is PERSPECTIVE:  # two views of one tilt but different shift are a stereo pair, if a poor one
        cloud, xyz = cloud.keep(np.array([0, 1, 3])), xyz[[0, 1, 3]]
    assert np.isnan(cloud.xyz_um[:-1]).all()
    assert np.isnan(cloud.covariance_um2[:-1]).all()
    assert np.isnan(cloud.residual_px[:-1]).all()
    np.testing.assert_allclose(cloud.xyz_um[-1], xyz[-1], atol=1e-8)
    assert not (cloud.residual_px <= 1e9)[:-1].any()


def test_precise_sightings_outweigh_coarse_ones() -> None:
    poses, xyz = poses_at([0, 5, 10]), points()
    xy = sightings(xyz, poses, PARALLEL)
    xy[:, 1] += 3.0
    sigma = np.array([0.1, 1e4, 0.1])
    cloud = triangulate(Tracks(xy), poses, PARALLEL, sigma_px=sigma)
    np.testing.assert_allclose(cloud.xyz_um, xyz, atol=1e-5)
    full = triangulate(Tracks(xy), poses, PARALLEL, sigma_px=np.tile(sigma, (200, 1)))
    np.testing.assert_allclose(full.xyz_um, cloud.xyz_um, atol=1e-12)
    by_track = triangulate(Tracks(xy), poses, PARALLEL, sigma_px=np.linspace(0.1, 2, 200)[:, None])
    even = triangulate(Tracks(xy), poses, PARALLEL)
    np.testing.assert_allclose(by_track.sigma_um, even.sigma_um * np.linspace(0.1, 2, 200), rtol=1e-9)


@BOTH
def test_turning_the_world_turns_the_points_and_their_covariance(optics: Optics) -> None:
    poses = poses_at([0, 5, 10])
    xy = sightings(points(), poses, optics) + np.random.default_rng(2).normal(0, 0.5, (200, 3, 2))
    turn = Rotation.from_euler("xyz", [20, -40, 70], degrees=True).as_matrix()
    here = triangulate(Tracks(xy), poses, optics)
    there = triangulate(Tracks(xy), Poses(poses.rotations @ turn.T, poses.translations_um), optics)
    np.testing.assert_allclose(there.xyz_um, here.xyz_um @ turn.T, atol=1e-7)
    np.testing.assert_allclose(there.covariance_um2, turn @ here.covariance_um2 @ turn.T, atol=1e-9)
    np.testing.assert_allclose(there.residual_px, here.residual_px, atol=1e-9)


def test_bands_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = poses_at([0, 5, 10])
    tracks = Tracks(sightings(points(), poses, PERSPECTIVE))
    whole = triangulate(tracks, poses, PERSPECTIVE)
    monkeypatch.setattr(beams, "in_bands", partial(in_bands, length=7))
    np.testing.assert_array_equal(triangulate(tracks, poses, PERSPECTIVE).xyz_um, whole.xyz_um)


def test_no_tracks_give_an_empty_cloud() -> None:
    cloud = triangulate(Tracks(np.empty((0, 2, 2))), poses_at([0, 3]), PARALLEL)
    assert len(cloud) == 0
    assert cloud.covariance_um2.shape == (0, 3, 3)


def test_cloud_carries_the_positions_of_the_reference_view() -> None:
    poses = poses_at([-5, 0, 5])
    xy = sightings(points(), poses, PARALLEL)
    np.testing.assert_array_equal(triangulate(Tracks(xy), poses, PARALLEL, reference=1).xy_px, xy[:, 1])


def noisy_pair(axis_deg: float = 0.0, across_px: float = 0.6) -> tuple[Array, Array, Poses]:
    poses = poses_at([2, 9], axis_deg)
    xy = sightings(points(), poses, PARALLEL) + np.random.default_rng(3).normal(0, across_px, (200, 2, 2))
    return xy[:, 0], xy[:, 1], poses


@pytest.mark.parametrize("axis", [0, 40, 90])
def test_a_pair_shares_out_the_epipolar_mismatch_and_leaves_the_depth(axis: float) -> None:
    """The four equations of Eq. 6 add nothing to the depth of Eqs. 4, 5; a mismatch delta leaves delta / 2."""
    xy1, xy2, poses = noisy_pair(axis)
    relative = poses.rotations[1] @ poses.rotations[0].T
    answer = solve_closed_form(centred_um(xy1, PARALLEL), centred_um(xy2, PARALLEL), relative)
    cloud = pair_cloud(xy1, xy2, relative, answer.translation_um, PARALLEL)
    np.testing.assert_allclose(cloud.xyz_um[:, 2], -answer.depth_um, atol=1e-9)
    np.testing.assert_allclose(cloud.residual_px, np.abs(answer.epipolar_um) / 2 / PARALLEL.pixel_size_um, atol=1e-9)


def test_pair_cloud_stands_in_the_view_frame_of_its_first_view() -> None:
    poses, xyz = poses_at([4, 10], 15), points()
    xy = sightings(xyz, poses, PARALLEL)
    relative = poses.rotations[1] @ poses.rotations[0].T
    t = poses.translations_um[1] - relative @ poses.translations_um[0]
    cloud = pair_cloud(xy[:, 0], xy[:, 1], relative, t[:2], PARALLEL)
    here = xyz @ view_from_world(poses.rotations[0]).T + poses.translations_um[0] * [1, -1, -1]
    np.testing.assert_allclose(cloud.xyz_um, here, atol=1e-9)
    np.testing.assert_allclose(cloud.xy_px, xy[:, 0])


def test_errors_along_the_epipolar_line_of_a_pair_leave_no_residual() -> None:
    poses, xyz = poses_at([0, 6]), points()
    xy = sightings(xyz, poses, PARALLEL)
    xy[:, 1, 0] += np.random.default_rng(4).uniform(-200, 200, 200)  # columns: along the lines
    cloud = triangulate(Tracks(xy), poses, PARALLEL)
    np.testing.assert_allclose(cloud.residual_px, 0, atol=1e-9)
    assert np.median(np.abs(cloud.xyz_um[:, 2] - xyz[:, 2])) > 50
    third = poses_at([0, 6, 12])
    three = np.concatenate([xy, sightings(xyz, third, PARALLEL)[:, 2:]], axis=1)
    three[:, :2] += sightings(xyz, third, PARALLEL)[:, :2] - sightings(xyz, poses, PARALLEL)
    assert np.median(triangulate(Tracks(three), third, PARALLEL).residual_px) > 10


def test_filter_keeps_what_reprojects_well_and_nothing_else() -> None:
    poses = poses_at([0, 6, 12])
    xy = sightings(points(), poses, PARALLEL)
    xy[::4, 1] += 12.0
    cloud = triangulate(Tracks(xy), poses, PARALLEL)
    good = cloud.residual_px <= 1.0
    np.testing.assert_array_equal(good, np.arange(200) % 4 != 0)
    kept = cloud.keep(good)
    np.testing.assert_array_equal(kept.xyz_um, cloud.xyz_um[good])


def test_residuals_are_sighting_minus_projection() -> None:
    poses, xyz = poses_at([0, 6]), points(5)
    xy = sightings(xyz, poses, PERSPECTIVE)
    xy[2, 1] += [1.5, -2.5]
    xy[3, 0] = np.nan
    residual = residuals_px(Tracks(xy), xyz, poses, PERSPECTIVE)
    np.testing.assert_allclose(residual[2], [[0, 0], [1.5, -2.5]], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(residual[3]), [[True, True], [False, False]])


def test_what_does_not_fit_is_refused_with_a_sentence() -> None:
    poses, tracks = poses_at([0, 6]), Tracks(np.zeros((5, 2, 2)))
    with pytest.raises(InputError, match="2 views, but there are 3 poses"):
        triangulate(tracks, poses_at([0, 6, 12]), PARALLEL)
    with pytest.raises(InputError, match="does not fit 5 tracks"):
        triangulate(tracks, poses, PARALLEL, sigma_px=np.ones(5))
    with pytest.raises(InputError, match="positive"):
        triangulate(tracks, poses, PARALLEL, sigma_px=0.0)
