"""Claims on heights from slopes: exact where slopes are, right in sign, and unmoved by holes, steps and bad pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semrecon.photometry.integration import IntegrationOptions, integrate_freely, integrate_slopes

PIXEL_UM = 0.2


def grid(rows=48, columns=64):
    row, column = np.mgrid[0:rows, 0:columns].astype(float)
    return (column - (columns - 1) / 2) * PIXEL_UM, -(row - (rows - 1) / 2) * PIXEL_UM


def bump(x, y):
    """Height and its slopes to the right and up."""
    z = 2 * np.exp(-(x**2 + 2 * (y - 1) ** 2) / 18)
    return z, -x / 9 * z, -2 * (y - 1) / 9 * z


def off(found, true):
    gap = found - true
    return gap - np.nanmedian(gap)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(max_examples=15, deadline=None)
def test_a_quadric_comes_back_exactly_with_up_as_up(a, b, c, d):
    """The trapezoid rule is exact for it."""
    x, y = grid(20, 24)
    found = integrate_slopes(a + 2 * c * x + d * y, b + d * x, PIXEL_UM, options=IntegrationOptions(rounds=1))
    np.testing.assert_allclose(off(found, a * x + b * y + c * x**2 + d * x * y), 0, atol=1e-9)


def test_a_smooth_bump_comes_back_to_the_square_of_the_pixel():
    x, y = grid()
    z, p, q = bump(x, y)
    error = np.abs(off(integrate_slopes(p, q, PIXEL_UM), z)).max()
    fine_x, fine_y = np.meshgrid(np.linspace(x.min(), x.max(), 127), np.linspace(y.max(), y.min(), 95))
    fine_z, p, q = bump(fine_x, fine_y)
    finer = np.abs(off(integrate_slopes(p, q, PIXEL_UM / 2), fine_z)).max()
    assert error < 0.004
    assert 3 < error / finer < 5


def test_the_free_solution_is_that_of_the_weighted_one():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(13, 17))
    np.testing.assert_allclose(integrate_freely(np.diff(z, axis=1), np.diff(z, axis=0)), z - z.mean(), atol=1e-12)


def test_heights_go_round_a_hole_and_leave_it_missing():
    x, y = grid()
    z, p, q = bump(x, y)
    hole = np.hypot(x - 1, y) < 1.5
    weight = np.where(x > 3, 0.1, 1.0)
    found = integrate_slopes(np.where(hole, np.nan, p), q, PIXEL_UM, weight, IntegrationOptions(iterations=300))
    np.testing.assert_array_equal(np.isnan(found), hole)
    assert np.nanmax(np.abs(off(found, z))) < 0.01


def test_a_patch_of_wrong_slopes_does_not_bend_the_rest():
    """As at a wall, where slopes belong to no surface; a plain solution spreads the damage."""
    x, y = grid()
    z, p, q = bump(x, y)
    wrong = np.hypot(x - 2, y) < 0.5
    spoilt = p + np.where(wrong, 6.0, 0.0)
    plain, robust = (
        np.abs(off(integrate_slopes(spoilt, q, PIXEL_UM, options=IntegrationOptions(rounds=n)), z))[~wrong]
        for n in (1, 3)
    )
    assert np.percentile(plain, 90) > 0.1
    assert np.percentile(robust, 90) < 0.02 * np.percentile(plain, 90)


def test_nothing_known_is_nothing_answered():
    assert np.isnan(integrate_slopes(np.full((8, 9), np.nan), np.zeros((8, 9)), PIXEL_UM)).all()


@pytest.mark.parametrize("weight", [None, 0.0])
def test_a_pixel_without_weight_does_not_count(weight):
    x, y = grid()
    z, p, q = bump(x, y)
    p = p.copy()
    p[20, 30] = 500.0
    trust = np.ones_like(p)
    trust[20, 30] = 1.0 if weight is None else weight
    once = IntegrationOptions(rounds=1, iterations=200)
    error = np.abs(off(integrate_slopes(p, q, PIXEL_UM, trust, once), z))
    error[19:22, 29:32] = 0
    assert (error.max() > 1) if weight is None else (error.max() < 0.05)
