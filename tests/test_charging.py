"""Streaks against the closed form of their autoregression."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.charging import ChargingOptions, charged, line_charge
from semsim.errors import InputError

RATE = np.random.default_rng(1).uniform(0.5, 3.0, (12, 200))


def test_without_strength_nothing_changes():
    assert np.array_equal(charged(RATE, ChargingOptions()), RATE)


@given(st.floats(0.5, 100), st.floats(0, 3))
def test_charge_leaks_away_exponentially_after_a_bright_pixel(recovery_px, excess):
    rate = np.ones((1, 60))
    rate[0, 10] += excess
    charge = line_charge(rate, recovery_px, 1.0)[0]
    decay = np.exp(-1 / recovery_px)
    assert (charge[:11] == 0).all()  # nothing is charged before the beam was there
    assert np.allclose(charge[11:], excess * (1 - decay) * decay ** np.arange(49), atol=1e-12)


def test_on_a_wide_bright_region_the_charge_tends_to_the_excess():
    charge = line_charge(np.full((1, 400), 2.5), 20.0, 1.5)[0]
    assert charge[-1] == pytest.approx(1.0, abs=1e-6)
    assert charge[20] == pytest.approx(1 - np.exp(-1))  # after one recovery length


def test_streaks_run_along_the_line_they_began_on_and_are_dark_or_bright_by_sign():
    rate = np.ones((3, 100))
    rate[1, 20:30] = 3.0
    dark, bright = (charged(rate, ChargingOptions(strength, 30.0)) for strength in (0.5, -0.5))
    assert np.array_equal(dark[[0, 2]], rate[[0, 2]])
    assert (dark[1, 30:] < 1).all()
    assert (np.diff(dark[1, 30:]) > 0).all()
    assert np.allclose(dark * bright, rate**2)


def test_lines_are_independent():
    options = ChargingOptions(0.7, 15.0)
    assert np.array_equal(charged(RATE[::-1], options), charged(RATE, options)[::-1])


@pytest.mark.parametrize(("key", "value"), [("strength", 11.0), ("recovery_px", 0.0), ("threshold", float("nan"))])
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        ChargingOptions(**{key: value})
