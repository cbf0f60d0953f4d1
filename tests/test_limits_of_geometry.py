"""Claims about what geometry allows: noise in depth from noise in matching, calibration of the stated covariance,
and what errors of tilt, magnification and rotation do.

Depth noise, analytically. For a tilt about the vertical axis with known translations, view v measures
``u_v = X cos(a_v) + h sin(a_v)``, so with ``S_cc = sum cos^2, S_ss = sum sin^2, S_cs = sum cos sin`` the height along
the beam at zero tilt has the variance ``sigma^2 S_cc / (S_cc S_ss - S_cs^2)``. For two views this is Boyde's
``sigma^2 (1 + cos^2 theta) / sin^2 theta`` in the frame of view 1.
"""

from __future__ import annotations

import numpy as np
import pytest

from semrecon.data import Array, Optics, PointCloud, Poses, Tracks
from semrecon.geometry import centred_um, project, rotations_from_tilts
from semrecon.points.translation import global_translations, solve_closed_form
from semrecon.points.triangulation import pair_cloud, triangulate

OPTICS = Optics(5 / 34, 854, 640)
SIGMA_PX = 0.3

TABLE = [  # tilts in degrees, depth noise in px per px of matching noise
    ((0.0, 3.0), 27.0),
    ((0.0, 5.0), 16.2),
    ((0.0, 10.0), 8.1),
    ((0.0, 15.0), 5.4),
    ((0.0, 3.0, 6.0, 9.0), 8.5),
    ((-10.0, 0.0, 10.0), 4.1),
    ((0.0, 15.0, 30.0), 2.6),
    (tuple(np.linspace(-30, 30, 37).tolist()), 0.545),
]
EVERY_ROW = pytest.mark.parametrize(("tilts", "gain"), TABLE, ids=[f"{len(t)} views to {t[-1]:g}" for t, _ in TABLE])


def analytic_gain(tilts_deg: tuple[float, ...]) -> float:
    a = np.deg2rad(tilts_deg)
    cc, ss, cs = (np.cos(a) ** 2).sum(), (np.sin(a) ** 2).sum(), (np.cos(a) * np.sin(a)).sum()
    return float(np.sqrt(cc / (cc * ss - cs**2)))


def scene(tilts_deg: tuple[float, ...], n: int, seed: int) -> tuple[Array, Poses, Array]:
    """Exact positions, poses with stage shifts, points of median height zero; the view at zero tilt stands still."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-40, 40, (n, 3)) * [1, 1, 0.4]
    xyz[:, 2] -= np.median(xyz[:, 2])
    rotations = rotations_from_tilts(np.array(tilts_deg))
    t = np.column_stack([rng.uniform(-5, 5, (len(tilts_deg), 2)), np.zeros(len(tilts_deg))])
    t[reference(tilts_deg)] = 0
    xy = np.stack([project(xyz, r, s, OPTICS) for r, s in zip(rotations, t, strict=True)], axis=1)
    return xy, Poses(rotations, t), xyz


def reference(tilts_deg: tuple[float, ...]) -> int:
    return int(np.argmin(np.abs(tilts_deg)))


def reconstruct(xy: Array, tilts_deg: tuple[float, ...]) -> PointCloud:
    """As a user would: nothing known but the rotations."""
    rotations, tracks, middle = rotations_from_tilts(np.array(tilts_deg)), Tracks(xy), reference(tilts_deg)
    poses = global_translations(tracks, rotations, OPTICS, reference=middle)
    return triangulate(tracks, poses, OPTICS, sigma_px=SIGMA_PX, reference=middle)


@EVERY_ROW
def test_analytic_depth_noise_is_the_published_one(tilts: tuple[float, ...], gain: float) -> None:
    assert analytic_gain(tilts) == pytest.approx(gain, abs=0.05 if gain > 1 else 0.0005)


@EVERY_ROW
def test_matching_noise_comes_out_as_the_depth_noise_it_implies(tilts: tuple[float, ...], gain: float) -> None:
    """30 seeds of 200 points, translations estimated: 6,000 depths pin a standard deviation to 0.9 %."""
    errors = []
    for seed in range(30):
        xy, _, xyz = scene(tilts, 200, seed)
        noisy = xy + np.random.default_rng(1000 + seed).normal(0, SIGMA_PX, xy.shape)
        error = reconstruct(noisy, tilts).xyz_um[:, 2] - xyz[:, 2]
        errors.append(error - error.mean())  # the gauge
    measured = np.std(errors) / (SIGMA_PX * OPTICS.pixel_size_um)
    assert 0.95 < measured / gain < 1.05
    assert 0.96 < measured / analytic_gain(tilts) < 1.04


@pytest.mark.parametrize(("tilts", "gain"), TABLE[:4])
def test_the_pair_solution_has_the_same_depth_noise(tilts: tuple[float, ...], gain: float) -> None:
    errors = []
    for seed in range(30):
        xy, poses, xyz = scene(tilts, 200, seed)
        noisy = xy + np.random.default_rng(2000 + seed).normal(0, SIGMA_PX, xy.shape)
        m, relative = centred_um(noisy, OPTICS), poses.rotations[1] @ poses.rotations[0].T
        answer = solve_closed_form(m[:, 0], m[:, 1], relative)
        cloud = pair_cloud(noisy[:, 0], noisy[:, 1], relative, answer.translation_um, OPTICS)
        error = cloud.xyz_um[:, 2] - xyz[:, 2]
        errors.append(error - error.mean())
    assert 0.95 < np.std(errors) / (SIGMA_PX * OPTICS.pixel_size_um) / gain < 1.05


@EVERY_ROW
def test_exact_matches_give_exact_depth(tilts: tuple[float, ...], gain: float) -> None:
    xy, _, xyz = scene(tilts, 301, 5)
    error = np.abs(reconstruct(xy, tilts).xyz_um - xyz).max()
    assert error < 1e-9 * np.ptp(xyz[:, 2])


@EVERY_ROW
def test_stated_sigma_is_the_analytic_one(tilts: tuple[float, ...], gain: float) -> None:
    xy, poses, _ = scene(tilts, 5, 0)
    cloud = triangulate(Tracks(xy), poses, OPTICS, sigma_px=SIGMA_PX)
    np.testing.assert_allclose(cloud.sigma_um, analytic_gain(tilts) * SIGMA_PX * OPTICS.pixel_size_um, rtol=1e-9)


@pytest.mark.parametrize("k", [0.0, 1 / 3000])
@pytest.mark.parametrize("tilts", [(0.0, 3.0), (0.0, 3.0, 6.0, 9.0), (-10.0, 0.0, 10.0)])
def test_covariance_is_calibrated(tilts: tuple[float, ...], k: float) -> None:
    """Normalised squared error averages the three coordinates, and the residuals the 2 V - 3 numbers left over.

    With poses known, unequal noise and missing views; 6,000 points pin each mean to about 1 %.
    """
    n, optics, rng = 6000, Optics(5 / 34, 854, 640, inverse_working_distance=k), np.random.default_rng(7)
    _, poses, xyz = scene(tilts, n, 7)
    views = zip(poses.rotations, poses.translations_um, strict=True)
    xy = np.stack([project(xyz, r, t, optics) for r, t in views], axis=1)
    sigma = rng.uniform(0.1, 0.6, xy.shape[:2])
    xy += rng.normal(size=xy.shape) * sigma[..., None]
    if len(tilts) > 2:
        xy[np.arange(0, n, 2), rng.integers(0, len(tilts), n // 2)] = np.nan
    cloud = triangulate(Tracks(xy), poses, optics, sigma_px=sigma)
    error = cloud.xyz_um - xyz
    squared = np.einsum("ia,iab,ib->i", error, np.linalg.inv(cloud.covariance_um2), error)
    assert 0.95 < squared.mean() / 3 < 1.05
    z_scores = error[:, 2] / cloud.sigma_um
    assert 0.95 < (z_scores**2).mean() < 1.05
    assert 0.662 < (np.abs(z_scores) < 1).mean() < 0.703  # 68.3 %


@pytest.mark.parametrize("tilts", [t for t, _ in TABLE[:7]])
def test_residuals_hold_what_the_points_did_not_absorb(tilts: tuple[float, ...]) -> None:
    xy, poses, _ = scene(tilts, 6000, 8)
    noisy = xy + np.random.default_rng(8).normal(0, SIGMA_PX, xy.shape)
    cloud = triangulate(Tracks(noisy), poses, OPTICS)
    views = len(tilts)
    assert 0.95 < (cloud.residual_px**2).mean() * views / ((2 * views - 3) * SIGMA_PX**2) < 1.05


def test_two_views_leave_the_residual_along_the_epipolar_line_identically_zero() -> None:
    xy, _, _ = scene((0.0, 6.0), 300, 9)
    rng = np.random.default_rng(9)
    wrong = xy + rng.normal(0, 40, xy.shape) * [1.0, 0.0]
    np.testing.assert_allclose(reconstruct(wrong, (0.0, 6.0)).residual_px, 0, atol=1e-9)
    third, _, _ = scene((0.0, 6.0, 12.0), 300, 9)
    wrong = third + rng.normal(0, 40, third.shape) * [1.0, 0.0]
    assert np.median(reconstruct(wrong, (0.0, 6.0, 12.0)).residual_px) > 5


def pair_depth_plane(xy: Array, xyz: Array, step_deg: float) -> Array:
    """Fit ``h = offset + a X + b Y + c h_true`` to the heights that a nominal tilt step gives; (offset, a, b, c)."""
    first, second = rotations_from_tilts(np.array([0.0, step_deg]))
    m = centred_um(xy, OPTICS)
    height = -solve_closed_form(m[:, 0], m[:, 1], second @ first.T).depth_um
    return np.linalg.lstsq(np.column_stack([np.ones(len(xyz)), xyz]), height, rcond=None)[0]


@pytest.mark.parametrize(("step", "scale"), [(3.0, 0.033), (15.0, 0.0067)])
def test_a_tilt_error_scales_depth_and_tips_the_plane(step: float, scale: float) -> None:
    """0.1 degree: the scale is ``sin(theta) / sin(theta + e)``, the slope e itself, in radians."""
    xy, _, xyz = scene((0.0, step), 500, 10)
    _, slope_x, slope_y, stretch = pair_depth_plane(xy, xyz, step + 0.1)
    assert 1 - stretch == pytest.approx(scale, rel=0.05)
    assert slope_x == pytest.approx(np.deg2rad(0.1), rel=0.02)
    assert abs(slope_y) < 1e-9


def test_mismatch_of_magnification_and_rotation_makes_the_published_ramps() -> None:
    """At 3 degrees, 63 um from the centre: 0.1 % of magnification 1.2 um, 1 degree in the plane 20.9 um."""
    xy, _, xyz = scene((0.0, 3.0), 500, 11)
    centred, edge_um = xy[:, 1] - OPTICS.centre_px, 854 / 2 * OPTICS.pixel_size_um
    larger, turned = xy.copy(), xy.copy()
    larger[:, 1] = OPTICS.centre_px + 1.001 * centred
    c, s = np.cos(np.deg2rad(1)), np.sin(np.deg2rad(1))
    turned[:, 1] = OPTICS.centre_px + centred @ np.array([[c, s], [-s, c]])
    assert pair_depth_plane(larger, xyz, 3.0)[1] * edge_um == pytest.approx(1.2, rel=0.02)
    assert abs(pair_depth_plane(turned, xyz, 3.0)[2]) * edge_um == pytest.approx(20.9, rel=0.01)
