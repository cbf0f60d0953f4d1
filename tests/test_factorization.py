"""Claims on factorization: exact where the data are, honest about what is open, and the method on pictures."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semrecon.data import Tracks
from semrecon.errors import MethodError
from semrecon.geometry import CAM_FROM_VIEW, rotations_from_tilts
from semrecon.judging.gauge import gauge_residual
from semrecon.methods.affine_factorization import AffineFactorization
from semrecon.uncalibrated.affine_cameras import AffineCameras, intersect, misses_px, reduced_equations, weights_of
from semrecon.uncalibrated.affine_cameras import loss as loss_of
from semrecon.uncalibrated.factorization import factorize, in_frame_of
from semrecon.uncalibrated.metric_upgrade import linear_upgrade, mirrored, tilts_of, upgrade, with_sign
from tests.known_surface import bump_series, bump_um, grid_um

WIDE = Rotation.from_rotvec(0.4 * np.random.default_rng(3).normal(size=(6, 3))).as_matrix()
WIDE[0] = np.eye(3)
SCALES = np.array([1.0, 1.01, 0.99, 1.02, 1.0, 1.05])


def tilted(*tilts_deg, axis_deg=0.0):
    """Rotations from the camera axes of an untilted view."""
    return rotations_from_tilts(np.array(tilts_deg, float), axis_deg) @ CAM_FROM_VIEW


def seen(rotations, *, points=300, noise=0.0, gaps=0.0, wrong=0.0, scales=None, seed=0):
    """Points of an uneven slab and their positions in px, about the centre; the first view is the reference."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1, 1, (points, 3)) * [300, 250, 60]
    shifts = rng.uniform(-20, 20, (len(rotations), 2))
    shifts[0] = 0
    xy = np.einsum("vab,nb->nva", rotations[:, :2], xyz)
    xy = xy * (np.ones(len(rotations)) if scales is None else scales)[:, None] + shifts
    xy += noise * rng.normal(size=xy.shape)
    astray = rng.random(points) < wrong
    xy[astray, 1] += 15 * rng.normal(size=(astray.sum(), 2))
    xy[rng.random(xy.shape[:2]) < gaps] = np.nan
    return xyz, Tracks(xy), astray


def calibrated(tracks, *, scaled=True):
    return with_sign(upgrade(tracks, factorize(tracks), scaled=scaled))


def depth_errors(adjusted, xyz):
    ok = np.isfinite(adjusted.points).all(axis=1)
    return gauge_residual(adjusted.points[ok, 2], xyz[ok, 2], ("offset", "mirror"))


@pytest.mark.parametrize("gaps", [0.0, 0.3])
@pytest.mark.parametrize("scales", [None, SCALES])
def test_general_views_without_noise_come_back_to_rounding(gaps, scales):
    """The scene made for it: wide turns about all axes, parallel, no noise. The relief is 120 px."""
    xyz, tracks, _ = seen(WIDE, gaps=gaps, scales=scales)
    found = calibrated(tracks)
    assert np.abs(depth_errors(found, xyz)).max() < 1e-9
    assert found.inliers.sum() >= 295


@pytest.mark.parametrize("tilts", [(0, 3, 6, 9), (0, 15, 30), (0, -10, 10)])
def test_three_views_about_one_axis_are_enough_without_noise(tilts):
    xyz, tracks, _ = seen(tilted(*tilts, axis_deg=30.0))
    found = calibrated(tracks)
    named = tilts_of(found)
    assert np.abs(depth_errors(found, xyz)).max() < 1e-6
    assert np.abs(named.tilts_deg) == pytest.approx(np.abs(tilts), abs=1e-7)
    assert named.axis_deg == pytest.approx(30.0, abs=1e-5)
    assert np.abs(named.off_axis_deg).max() < 1e-6


def test_two_views_are_refused():
    _, tracks, _ = seen(tilted(0, 10))
    with pytest.raises(MethodError, match="bas-relief"):
        upgrade(tracks, factorize(tracks))


def test_linear_constraints_are_met_by_the_true_frame():
    """With P_v from true rotations the metric frame is the identity: q = (0, 0, 1)."""
    cameras = AffineCameras(WIDE[:, :2], np.zeros((6, 2)))
    assert linear_upgrade(cameras, 0, scaled=False) == pytest.approx([0, 0, 1], abs=1e-12)
    assert linear_upgrade(cameras, 0, scaled=True) == pytest.approx([0, 0, 1], abs=1e-12)


def test_the_spread_of_tilts_is_what_their_sigma_says():
    """Fifteen draws of the noise: the squares over the variance are chi-square with 15 degrees of freedom (1e-3)."""
    found = []
    for seed in range(15):
        _, tracks, _ = seen(tilted(0, 10, 20), points=150, noise=0.3, seed=seed)
        named = tilts_of(calibrated(tracks, scaled=False))
        found.append((named.tilts_deg[2] - 20) / named.sigma_deg[2])
    assert 3.5 < np.square(found).sum() < 37.7


def test_wrong_matches_are_left_out():
    xyz, tracks, astray = seen(tilted(0, 10, 20, -10), points=500, noise=0.3, wrong=0.1)
    found = calibrated(tracks)
    assert found.inliers[astray].mean() < 0.15
    assert found.inliers[~astray].mean() > 0.97
    assert 0.27 < found.sigma_px < 0.33
    assert np.median(np.abs(depth_errors(found, xyz))) < 1.0


def test_reduced_equations_are_the_gradient_of_the_loss():
    _, tracks, _ = seen(WIDE, noise=1.0, gaps=0.2)
    cameras, weights, step = AffineCameras(WIDE[:, :2], np.zeros((6, 2))), weights_of(tracks), 1e-6
    _, right = reduced_equations(tracks.xy_px, weights, cameras)
    for k in (0, 5, 19, 47):
        moved = [cameras.vector.copy() for _ in range(2)]
        moved[0][k] -= step
        moved[1][k] += step
        low, high = (loss_of(tracks.xy_px, weights, AffineCameras.from_vector(one)) for one in moved)
        assert (high - low) / (2 * step) == pytest.approx(-2 * right[k], rel=1e-4)


def test_a_change_of_frame_changes_no_image():
    _, tracks, _ = seen(WIDE, noise=0.5)
    cameras = AffineCameras(WIDE[:, :2], np.random.default_rng(0).normal(size=(6, 2)))
    other, weights = in_frame_of(cameras, 2), weights_of(tracks)
    one, two = (misses_px(tracks.xy_px, intersect(tracks.xy_px, weights, c)[0], c) for c in (cameras, other))
    assert np.abs(one - two).max() < 1e-9
    assert np.array_equal(other.matrices[2], np.eye(2, 3))
    assert np.array_equal(other.offsets[2], np.zeros(2))


def test_turning_the_relief_inside_out_changes_no_image():
    _, tracks, _ = seen(tilted(0, 10, 20), noise=0.3)
    found = calibrated(tracks)
    other = mirrored(found)
    one, two = (misses_px(tracks.xy_px, f.points, f.model.cameras) for f in (found, other))
    assert np.nanmax(np.abs(one - two)) < 1e-9
    assert tilts_of(other).tilts_deg == pytest.approx(-tilts_of(found).tilts_deg)
    assert tilts_of(other).sigma_deg == pytest.approx(tilts_of(found).sigma_deg)
    assert np.array_equal(with_sign(other).points, found.points, equal_nan=True)


@lru_cache
def pictured():
    return bump_series((0.0, -7.0, 10.0, 20.0))


def answer(series, **options):
    return replace(AffineFactorization(), **options)(series, rng=np.random.default_rng(0))


def test_a_painted_bump_comes_back_without_its_tilts():
    """Pictures of a hill of 3 um and 0.1 um a pixel; tilts are found, heights hold, sigma is of the errors' size."""
    found = answer(pictured())
    assert found.diagnostics["tilts_deg"] == pytest.approx([0, -7, 10, 20], abs=0.5)
    assert found.diagnostics["tilt_axis_deg"] == pytest.approx(0, abs=2)
    errors = gauge_residual(found.heights.z_um, bump_um(*grid_um()), ("offset", "mirror"), None, "absolute")
    assert np.nanmedian(np.abs(errors)) < 0.08
    assert np.isfinite(found.heights.z_um).mean() > 0.7
    assert len(found.points) == np.isfinite(found.heights.z_um).sum()


def test_stated_tilts_are_not_used():
    series = pictured()
    told = [0.0, 1.0, -40.0, 3.0]
    lied = replace(series, views=tuple(replace(v, tilt_deg=t) for v, t in zip(series.views, told, strict=True)))
    one, two = answer(series), answer(lied)
    assert np.array_equal(one.heights.z_um, two.heights.z_um, equal_nan=True)
    assert np.array_equal(one.poses.rotations, two.poses.rotations)


def test_views_that_do_not_tell_the_tilts_are_refused_in_a_sentence():
    series = pictured()
    with pytest.raises(MethodError, match="three views"):
        answer(series.select(0, 1))
    with pytest.raises(MethodError, match="bump_0"):
        answer(series.select(0, 0, 0))
    with pytest.raises(MethodError, match="by how much the views are tilted"):
        answer(series.select(0, 0, 3))
