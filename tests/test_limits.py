"""The limit is what it claims: closed forms, the simulator differenced numerically, and estimators that reach it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.judging.limits import (
    LimitOptions,
    Parallax,
    bound_summary,
    depth_information,
    gradient,
    median_abs_of_normals,
    motion_px_per_um,
    noise_free,
    parallaxes,
    windowed_sigma_um,
)
from semsim.capture import Surfaces, prepare
from semsim.detector import DetectorOptions
from semsim.imperfections import StageErrors
from semsim.microscope import TiltSchedule
from semsim.overrides import overridden
from semsim.scene import Scene, scaled
from semsim.scenes import scene
from semsim.spot import SpotOptions

SIZE, TRIALS = 24, 3500
INNER = (..., slice(4, -4), slice(4, -4))
"""What is used of a patch: its slope is exact there."""
KNOWN, UNKNOWN = LimitOptions(0, texture_known=True), LimitOptions(0)


def plane(tilts_deg: tuple[float, ...] = (0.0, 8.0)) -> Scene:
    return replace(scaled(scene("plane"), 0.5), schedule=TiltSchedule(tilts_deg))


@pytest.fixture(scope="module")
def surfaces() -> Surfaces:
    return prepare(plane((0.0, 4.0, 8.0)))


def texture(shift_px: np.ndarray | float = 0.0, dose_e: float = 400.0) -> np.ndarray:
    """Analytic patches of strong contrast, moved to the right: (trials or 1, rows, columns)."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    x = x - np.reshape(shift_px, (-1, 1, 1))
    waves = np.sin(0.45 * x + 0.2 * y) + np.sin(0.31 * x - 0.37 * y + 1) + np.sin(0.12 * x + 0.4 * y + 2)
    return dose_e * np.exp(0.6 * waves)


def parallax_of(image: np.ndarray, *, moves: bool) -> Parallax:
    """A view whose picture moves by one pixel to the right a um of height, or not at all."""
    return Parallax(image, gradient(image)[..., 0] / image * moves)


def ratio_estimate(counts: np.ndarray, *, weighted: bool) -> np.ndarray:
    """Fit the known patch to each trial by Fisher scoring (maximum likelihood), or by plain least squares."""
    found, step = np.zeros(len(counts)), 1e-4
    for _ in range(4):
        model = texture(found)[INNER]
        slope = (texture(found + step) - texture(found - step))[INNER] / (2 * step)
        weight = slope / model if weighted else slope
        found = found + ((counts - model) * weight).sum((1, 2)) / (slope * weight).sum((1, 2))
    return found


def test_maximum_likelihood_against_a_known_patch_reaches_the_limit() -> None:
    truth, image = 0.3, texture(0.3)[0]
    counts = np.random.default_rng(1).poisson(np.broadcast_to(image, (TRIALS, SIZE, SIZE)))[INNER]
    views = [parallax_of(image, moves=False), parallax_of(image, moves=True)]
    bound = depth_information(views, KNOWN)[INNER].sum() ** -0.5
    found = ratio_estimate(counts, weighted=True)
    assert np.std(found) == pytest.approx(bound, rel=0.05)
    assert abs(np.mean(found) - truth) < 4 * bound / np.sqrt(TRIALS)
    assert np.std(ratio_estimate(counts, weighted=False)) > 1.1 * bound  # so the claim above can fail


@pytest.mark.parametrize("truth", [0.0, 0.25])
def test_matching_two_noisy_patches_reaches_the_limit(truth: float) -> None:
    """Slopes and weights come from the patches themselves: nothing of the texture is given."""
    rng = np.random.default_rng(2)
    left, right = (
        rng.poisson(np.broadcast_to(texture(sign * truth / 2), (TRIALS, SIZE, SIZE))) for sign in (-1.0, 1.0)
    )
    mean = (left + right) / 2.0
    smooth = gaussian_filter(mean, (0, 1.0, 1.0))
    weight = (slope_of(smooth) / smooth)[INNER]
    found = (weight * (left - right)[INNER]).sum((1, 2)) / (weight * slope_of(mean)[INNER]).sum((1, 2))
    image = texture()[0]
    views = [parallax_of(image, moves=False), parallax_of(image, moves=True)]
    bound = depth_information(views, UNKNOWN)[INNER].sum() ** -0.5
    assert np.std(found) == pytest.approx(bound, rel=0.05)
    assert abs(np.mean(found) - truth) < 0.1 * bound + 4 * bound / np.sqrt(TRIALS)


def slope_of(images: np.ndarray) -> np.ndarray:
    """Five-point difference along the columns."""
    shifted = {by: np.roll(images, -by, axis=-1) for by in (-2, -1, 1, 2)}
    return (8 * (shifted[1] - shifted[-1]) - (shifted[2] - shifted[-2])) / 12


def test_two_like_patches_have_the_published_limit() -> None:
    """sigma_d >= sqrt(2) sigma_n / (g_rms sqrt(N)), for a contrast so weak that the noise is the same everywhere."""
    image = 1000 + 0.01 * texture()[0]
    information = depth_information([parallax_of(image, moves=False), parallax_of(image, moves=True)], UNKNOWN)
    slope_rms = np.sqrt(np.mean(gradient(image)[..., 0] ** 2))
    expected = np.sqrt(2) * np.sqrt(image.mean()) / (slope_rms * SIZE)
    assert information.sum() ** -0.5 == pytest.approx(expected, rel=0.01)


def test_a_known_texture_is_worth_a_factor_of_root_two_in_two_like_views() -> None:
    image = texture()[0]
    views = [parallax_of(image, moves=False), parallax_of(image, moves=True)]
    np.testing.assert_allclose(depth_information(views, KNOWN), 2 * depth_information(views, UNKNOWN), atol=1e-9)


def test_views_in_which_nothing_moves_against_the_others_say_nothing() -> None:
    view = parallax_of(texture()[0], moves=True)
    np.testing.assert_allclose(depth_information([view, view, view], UNKNOWN), 0, atol=1e-9)


def test_the_slope_of_a_wave_is_right_to_a_thousandth() -> None:
    y, x = np.mgrid[0:60, 0:60].astype(float)
    found = gradient(np.sin(0.4 * x + 0.3 * y))[10:-10, 10:-10]
    true = np.cos(0.4 * x + 0.3 * y)[10:-10, 10:-10, None] * [0.4, 0.3]
    np.testing.assert_allclose(found, true, atol=1e-3)


@pytest.mark.parametrize("window_px", [1.5, 3.0])
def test_a_gaussian_window_over_even_information_has_its_number_of_pixels(window_px: float) -> None:
    middle = windowed_sigma_um(np.full((80, 80), 0.25), window_px)[40, 40]
    assert middle == pytest.approx((4 * np.pi * window_px**2 * 0.25) ** -0.5, rel=1e-3)


def test_median_of_normal_errors() -> None:
    assert median_abs_of_normals(np.full(5, 2.0)) == pytest.approx(2 * 0.67449, rel=1e-4)
    mixed = np.array([0.1, 1.0, 5.0])
    drawn = np.abs(np.random.default_rng(3).normal(size=(200_000, 3)) * mixed)
    assert median_abs_of_normals(mixed) == pytest.approx(np.median(drawn), rel=0.02)


def test_the_information_is_that_of_the_simulator_differenced_numerically() -> None:
    """Raise the specimen a little, photograph it again without noise, and add up (d lambda / dz)^2 / lambda."""
    settings = {"specimen.grain_um": 4.0, "specimen.edge_um": 0.2}  # finer grain than pixels would be aliased
    usual = overridden(plane(), {"microscope.pixel_size_um": 0.5, "specimen.extent_um": 90.0} | settings)
    surfaces, rise, moved = prepare(usual), 0.1, []
    for sign in (1, -1):  # an axis below the specimen by `rise` swings it as raising it would
        stage = StageErrors(axis_point_um=(0.0, 0.0, -sign * rise))
        moved.append(noise_free(prepare(replace(usual, stage_errors=stage)), 1))
    inner = (slice(8, -8), slice(8, -8))
    image = noise_free(surfaces, 1)
    expected = (((moved[0] - moved[1]) / (2 * rise)) ** 2 / image)[inner].mean()
    seen = parallaxes(surfaces)
    size = seen[1].electrons[inner].sum() / image[inner].sum()
    found = depth_information(seen, KNOWN)[inner].mean() / size  # a pixel of view 1, not of the reference
    assert found == pytest.approx(expected, rel=0.03)


def test_motion_is_the_sine_of_the_tilt(surfaces: Surfaces) -> None:
    motion = motion_px_per_um(surfaces, 0, 2)
    size_um = surfaces.scene.microscope.pixel_size_um
    np.testing.assert_allclose(
        motion[~surfaces.truth.buffers[0].miss][:, 0], np.sin(np.deg2rad(8)) / size_um, rtol=1e-9
    )


def test_motion_under_perspective_is_that_of_a_raised_point() -> None:
    near = plane()
    near = replace(near, microscope=replace(near.microscope, working_distance_um=500.0))
    surfaces = prepare(near)
    motion = motion_px_per_um(surfaces, 0, 0)
    assert np.nanmax(np.abs(motion)) < 1e-9  # along its own beam a point does not move
    assert np.nanmax(np.abs(motion_px_per_um(surfaces, 0, 1)[..., 1])) > 1e-5


def test_dose_views_spot_and_noise_move_the_limit_as_they_must(surfaces: Surfaces) -> None:
    options = LimitOptions(3.0)
    best = bound_summary(surfaces, options).median_sigma_um
    pair = bound_summary(surfaces, options, views=[2]).median_sigma_um
    assert best < pair

    def sigma(detector: DetectorOptions | None = None, spot: SpotOptions | None = None) -> float:
        seen = parallaxes(surfaces, None, detector, spot)
        return float(np.nanmedian(windowed_sigma_um(depth_information(seen, options), options.window_px)))

    usual = sigma()
    assert sigma(DetectorOptions(dose_e=800)) == pytest.approx(usual / 2, rel=1e-6)
    assert sigma(DetectorOptions(read_noise_e=20)) > 1.2 * usual
    assert sigma(spot=SpotOptions(sigma_px=2.0)) > 1.2 * usual


def test_the_map_is_missing_where_nothing_is_seen(surfaces: Surfaces) -> None:
    bound = windowed_sigma_um(depth_information(parallaxes(surfaces, None), LimitOptions(3.0)), 3.0)
    assert bound.shape == surfaces.scene.microscope.shape
    nowhere = ~np.isfinite(surfaces.truth.correspondence(0, 1)[..., 0]) & ~np.isfinite(
        surfaces.truth.correspondence(0, 2)[..., 0]
    )
    assert np.isnan(bound[nowhere]).all()
    assert np.isfinite(bound[~nowhere]).mean() > 0.99


def test_efficiency_compares_medians_of_like_kind(surfaces: Surfaces) -> None:
    summary = bound_summary(surfaces)
    assert summary.efficiency(2 * summary.median_abs_um) == pytest.approx(2)
    assert 0.6 * summary.median_sigma_um < summary.median_abs_um < summary.rms_um
    assert 0.8 < summary.share <= 1
