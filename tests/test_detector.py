"""Spot, counting statistics and grey levels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.detector import DetectorOptions, blur_by_spot, contrasts, count_electrons, digitise, spot_kernel
from semsim.errors import InputError


@given(st.floats(0.05, 6.0))
def test_the_spot_keeps_every_electron_and_moves_none(sigma_px):
    kernel = spot_kernel(sigma_px)
    x = np.arange(len(kernel)) - len(kernel) // 2
    assert abs(kernel.sum() - 1) < 1e-12
    assert abs((x * kernel).sum()) < 1e-12
    assert np.array_equal(kernel, kernel[::-1])


@given(st.floats(0.8, 6.0))
def test_the_spot_has_the_width_asked_for(sigma_px):
    kernel = spot_kernel(sigma_px)
    x = np.arange(len(kernel)) - len(kernel) // 2
    assert np.sqrt((x**2 * kernel).sum()) == pytest.approx(sigma_px, rel=1e-3)


def test_a_needle_leaves_the_picture_as_it_is():
    rate = np.random.default_rng(0).uniform(size=(9, 11))
    assert blur_by_spot(rate, 0.0) is rate
    assert np.array_equal(spot_kernel(0.0), [1.0])


def test_blurring_a_point_gives_the_spot():
    rate = np.zeros((31, 33))
    rate[15, 16] = 1.0
    x, y = np.arange(33) - 16, np.arange(31) - 15
    gauss = np.exp(-0.5 * (x[None] ** 2 + y[:, None] ** 2) / 1.3**2)
    blurred = blur_by_spot(rate, 1.3)
    assert blurred.sum() == pytest.approx(1, abs=1e-12)
    assert np.allclose(blurred, gauss / gauss.sum(), atol=2e-7)
    assert (blurred.sum(axis=0) * x).sum() == pytest.approx(0, abs=1e-12)


def test_blurring_commutes_with_shifting_and_keeps_ramps():
    rate = np.random.default_rng(1).uniform(size=(40, 40))
    shifted = blur_by_spot(np.roll(rate, (2, -3), (0, 1)), 0.9)
    assert np.allclose(shifted[8:-8, 8:-8], np.roll(blur_by_spot(rate, 0.9), (2, -3), (0, 1))[8:-8, 8:-8], atol=1e-12)
    ramp = np.add.outer(np.arange(40.0), 2 * np.arange(40.0))
    assert np.allclose(blur_by_spot(ramp, 0.9)[6:-6, 6:-6], ramp[6:-6, 6:-6], atol=1e-12)
    assert np.allclose(blur_by_spot(np.full((9, 9), 3.0), 2.0), 3.0, atol=1e-12)


@pytest.mark.parametrize("dose", [3.0, 200.0])
def test_electrons_are_poisson(dose):
    """Mean and variance both equal the dose, within 4 sigma of what 400 x 400 draws allow, from both sides."""
    n = 400 * 400
    electrons = count_electrons(np.full((400, 400), dose), 0.0, np.random.default_rng(5))
    assert abs(electrons.mean() - dose) < 4 * np.sqrt(dose / n)
    # Var(s^2) = (mu4 - sigma^4)/n = (dose + 2 dose^2)/n for Poisson.
    assert abs(electrons.var(ddof=1) - dose) < 4 * np.sqrt((dose + 2 * dose**2) / n)
    skew = ((electrons - dose) ** 3).mean() / dose**1.5
    assert abs(skew - dose**-0.5) < 4 * np.sqrt(15 / n) * (1 + 3 / dose)
    assert np.array_equal(electrons, np.rint(electrons))


def test_read_noise_adds_its_variance():
    n = 400 * 400
    electrons = count_electrons(np.full((400, 400), 50.0), 6.0, np.random.default_rng(6))
    assert abs(electrons.var(ddof=1) - 86.0) < 4 * np.sqrt((50 + 2 * 86.0**2) / n)
    assert abs(electrons.mean() - 50.0) < 4 * np.sqrt(86 / n)


def test_read_noise_does_not_disturb_the_counting():
    expected = np.full((50, 50), 100.0)
    without = count_electrons(expected, 0.0, np.random.default_rng(7))
    almost = count_electrons(expected, 1e-9, np.random.default_rng(7))
    assert np.allclose(without, almost, atol=1e-6)


def test_neighbouring_pixels_draw_independently():
    electrons = count_electrons(np.full((300, 300), 100.0), 0.0, np.random.default_rng(8)) - 100.0
    for a, b in ((electrons[:, :-1], electrons[:, 1:]), (electrons[:-1], electrons[1:])):
        assert abs((a * b).mean() / 100.0) < 4 / np.sqrt(a.size)


def test_grey_levels_are_linear_rounded_and_clipped():
    options = DetectorOptions(gain_per_e=0.5, offset_grey=10.0)
    (contrast,) = contrasts([np.ones((2, 2))], options)
    grey = digitise(np.array([[0.0, 3.2, 100.0, 1e6]]), contrast, 8)
    assert grey.dtype == np.uint8
    assert grey.tolist() == [[10, 12, 60, 255]]
    assert digitise(np.array([[-1e6, 1e6]]), contrast, 16).tolist() == [[0, 65535]]


@pytest.mark.parametrize("bits", [8, 16])
def test_auto_contrast_fills_the_range_and_clips_little(bits):
    expected = [np.random.default_rng(i).uniform(40, 400, (200, 200)) for i in range(2)]
    options = DetectorOptions(bits=bits)
    chosen = contrasts(expected, options)
    assert chosen[0] == chosen[1]
    grey = digitise(count_electrons(expected[0], 0.0, np.random.default_rng(0)), chosen[0], bits) / options.white
    assert grey.min() < 0.1
    assert grey.max() > 0.9
    assert ((grey == 0) | (grey == 1)).mean() < 0.02


def test_contrast_is_one_for_the_series_unless_asked():
    expected = [np.full((20, 20), 100.0), np.full((20, 20), 300.0)]
    series = contrasts(expected, DetectorOptions())
    single = contrasts(expected, DetectorOptions(contrast="view"))
    assert series[0] == series[1]
    assert single[0] != single[1]
    assert single[0] == contrasts(expected[:1], DetectorOptions())[0]


def test_a_blank_view_still_has_a_contrast():
    (contrast,) = contrasts([np.zeros((5, 5))], DetectorOptions())
    assert np.isfinite([contrast.gain_per_e, contrast.offset_grey]).all()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dose_e", 0.0),
        ("spot_sigma_px", -1.0),
        ("read_noise_e", -1.0),
        ("bits", 12),
        ("contrast", "x"),
        ("gain_per_e", 0),
    ],
)
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        DetectorOptions(**{key: value})
