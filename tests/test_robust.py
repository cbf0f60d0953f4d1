"""Claims on robust estimates: most of the values win, and wrong matches stand out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semrecon.numerics.robust import consistent_with_neighbours, fit_noise, fit_offset


def contaminated(rng, n=1000, share=0.4, sigma=0.5, offset=-7.25, spread=50.0):
    values = rng.normal(offset, sigma, n)
    wrong = rng.permutation(n) < share * n
    values[wrong] = rng.uniform(offset - spread, offset + spread, int(wrong.sum()))
    return values, wrong


def test_forty_percent_outliers_leave_the_offset_alone():
    fits = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        values, wrong = contaminated(rng)
        fit = fit_offset(values, 2.0, rng)
        assert fit.inliers[~wrong].mean() > 0.99
        assert fit.inliers[wrong].mean() < 0.1
        fits.append(fit)
    error = np.array([fit.offset for fit in fits]) + 7.25
    # 600 good values of 0.5: a standard error of 0.0204; a few uniform ones slip in
    assert 0.5 * 0.0204 < error.std() < 2.5 * 0.0204
    assert abs(error.mean()) < 4 * 0.0204 / np.sqrt(40) * 2.5


def test_sigma_is_that_of_the_noise():
    sigma = [fit_offset(np.random.default_rng(s).normal(3, 0.5, 400), 3.0, np.random.default_rng(0)).sigma
             for s in range(50)]  # fmt: skip
    assert np.mean(sigma) == pytest.approx(0.5, rel=0.02)


def test_the_score_counts_agreement():
    rng = np.random.default_rng(0)
    assert fit_offset(np.full(10, 4.0), 1.0, rng).score == 1.0
    alone = fit_offset(np.arange(10) * 100.0, 1.0, rng)
    assert alone.score == pytest.approx(0.1)
    assert alone.inliers.sum() == 1
    assert np.isnan(alone.sigma)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-1e3, 1e3), scale=st.floats(0.01, 100))
def test_offset_moves_and_scales_with_the_values(seed, shift, scale):
    values, _ = contaminated(np.random.default_rng(seed), n=80)
    plain = fit_offset(values, 2.0, np.random.default_rng(1))
    moved = fit_offset(values * scale + shift, 2.0 * scale, np.random.default_rng(1))
    assert moved.offset == pytest.approx(plain.offset * scale + shift, rel=1e-6, abs=1e-6)
    assert moved.score == pytest.approx(plain.score, abs=1e-6)


def test_many_values_are_sampled_from_the_generator_and_come_out_alike():
    values, _ = contaminated(np.random.default_rng(5), n=5000)
    fits = [fit_offset(values, 2.0, np.random.default_rng(seed), trials=50) for seed in (1, 1, 2)]
    assert fits[0].offset == fits[1].offset
    assert np.array_equal(fits[0].inliers, fits[1].inliers)
    assert fits[2].offset == pytest.approx(fits[0].offset, abs=0.05)


def test_wrong_disparities_stand_out_and_slopes_do_not():
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 500, (2000, 2))
    truth = 0.05 * xy[:, 0] + 10 * np.sin(xy[:, 1] / 60)
    disparity = truth + rng.normal(0, 0.4, 2000)
    wrong = rng.permutation(2000) < 200
    disparity[wrong] += rng.choice([-1, 1], 200) * rng.uniform(15, 60, 200)
    kept = consistent_with_neighbours(xy, disparity)
    assert kept[~wrong].mean() > 0.98
    assert kept[wrong].mean() < 0.02


def test_few_matches_are_all_kept():
    xy = np.arange(20.0).reshape(10, 2)
    assert consistent_with_neighbours(xy, np.arange(10) ** 3.0, neighbours=10).all()


def sighting_residuals(rng, views, sigma):
    """Residuals as least squares leaves them: noise projected off three directions of 2 V."""
    freedom = 2 * views - 3
    return np.sqrt(sigma**2 * rng.chisquare(freedom) / views)


@pytest.mark.parametrize("views", [2, 3, 7])
def test_recovered_noise_equals_injected_noise(views):
    rng = np.random.default_rng(7)
    n_views = np.full(20_000, views)
    residual = sighting_residuals(rng, n_views, 0.3)
    fit = fit_noise(residual, n_views)
    assert fit.sigma_px == pytest.approx(0.3, rel=0.02)
    assert fit.inliers.mean() == pytest.approx(1 - 4.65e-4, abs=4e-4)  # 3.5 sigma


def test_wrong_points_are_beyond_the_noise_and_do_not_raise_it():
    rng = np.random.default_rng(8)
    n_views = rng.integers(2, 6, 3000)
    residual = sighting_residuals(rng, n_views, 0.4)
    wrong = rng.random(3000) < 0.2
    residual[wrong] = rng.uniform(3, 20, int(wrong.sum()))
    fit = fit_noise(residual, n_views)
    assert not fit.inliers[wrong].any()
    assert fit.inliers[~wrong].mean() > 0.99
    assert fit.sigma_px == pytest.approx(0.4, rel=0.05)


def test_exact_points_have_the_least_noise_and_missing_ones_are_out():
    fit = fit_noise(np.array([0.0, 1e-12, np.nan]), np.array([2, 2, 2]))
    assert fit.sigma_px == 1e-6
    assert fit.inliers.tolist() == [True, True, False]
    assert not fit_noise(np.array([np.nan]), np.array([2])).inliers.any()
