"""The gauge of the median: a declared freedom never costs, and none can be used to flatten what is wrong."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semrecon.judging.gauge import GAUGES, SCALE_REACH, SPREAD_REACH, gauge_fit, gauge_residual
from semrecon.judging.metrics import depth_errors


def places(shape):
    rows, columns = np.indices(shape, dtype=float)
    return np.stack([columns, -rows], axis=-1)


def dome(shape=(60, 80)):
    """Half a ball on a carrier."""
    xy = places(shape) - places(shape).reshape(-1, 2).mean(axis=0)
    return np.sqrt(np.maximum(25.0**2 - (xy**2).sum(axis=-1), 0.0))


SUBSETS = [names for size in range(len(GAUGES) + 1) for names in combinations(GAUGES, size)]


@settings(max_examples=10)
@given(hnp.arrays(float, (5, 6), elements=st.floats(-9, 9)), st.sampled_from(SUBSETS))
def test_a_declared_freedom_never_costs_the_median(estimated, wide):
    rows, columns = np.indices((5, 6))
    true = np.sin(rows) + 0.3 * columns
    best = depth_errors(estimated, true, wide).median_abs_um
    for narrow in SUBSETS:
        if set(narrow) < set(wide) and ("offset" in narrow) == ("offset" in wide):
            assert best <= depth_errors(estimated, true, narrow).median_abs_um


def test_a_scale_does_not_follow_a_rim_that_is_flat_in_the_estimate():
    """Least absolute error alone takes a scale that suits the rim; the median of the errors was worse for it."""
    true = dome()
    estimated = true * np.where(true < 12, 0.55, 1.0) + np.random.default_rng(0).normal(0, 0.05, true.shape)
    plain = np.nanmedian(np.abs(gauge_residual(estimated, true, ("offset",), norm="absolute")))
    scaled = np.nanmedian(np.abs(gauge_residual(estimated, true, ("offset", "scale"), norm="absolute")))
    assert scaled <= plain


@pytest.mark.parametrize("factor", [0.05, 0.5, 3.0, 40.0])
def test_a_scale_comes_back_from_noisy_heights_with_outliers(factor):
    rng = np.random.default_rng(1)
    true = dome()
    noisy = true + rng.normal(0, 0.3, true.shape)
    noisy[rng.random(true.shape) < 0.1] += 30
    fit = gauge_fit(factor * noisy + 7, true, ("offset", "scale"), norm="absolute", narrower=False)
    assert fit.scale * factor == pytest.approx(1.0, abs=0.03)


def test_wrong_relief_is_not_flattened_where_most_of_the_scene_is_flat():
    """Four fifths of the truth are a level: a scale near zero would make the median vanish."""
    rng = np.random.default_rng(2)
    true = np.where(rng.random((50, 60)) < 0.2, 8.0, 0.0)
    wrong = rng.normal(0, 4.0, true.shape)
    fit = gauge_fit(wrong, true, ("offset", "scale"), norm="absolute", narrower=False)
    ratio = np.subtract(*np.percentile(true, [95, 5])) / np.subtract(*np.percentile(wrong, [95, 5]))
    assert fit.scale >= 0.999 * ratio / SPREAD_REACH / SCALE_REACH
    assert np.median(np.abs(fit.error(wrong, true))) > 0.1


def test_the_fit_says_what_the_residual_shows():
    rng = np.random.default_rng(3)
    true, xy = dome(), places((60, 80))
    estimated = -0.4 * true + 3 + 0.02 * xy[..., 0] + rng.normal(0, 0.1, true.shape)
    for norm in ("squares", "absolute"):
        fit = gauge_fit(estimated, true, GAUGES, xy, norm)
        np.testing.assert_allclose(fit.error(estimated, true, xy), gauge_residual(estimated, true, GAUGES, xy, norm))
        assert fit.scale < 0
        aligned = fit.error(estimated, np.zeros_like(true), xy)
        assert np.median(np.abs(aligned - true)) == pytest.approx(0.25 * 0.6745, rel=0.15)


def test_nothing_is_fitted_to_fewer_heights_than_freedoms():
    estimated = np.full((4, 5), np.nan)
    estimated[0, :3] = 1.0
    assert gauge_fit(estimated, np.zeros((4, 5)), ("offset", "plane")) is None
