"""Dose, counting statistics and grey levels."""

import subprocess
import sys

import numpy as np
import pytest

from semsim.detector import (
    DetectorOptions,
    contrasts,
    count_electrons,
    digitise,
    expected_electrons,
    incident_electrons,
    random_children,
    saturation,
)
from semsim.errors import InputError


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


def drawn(options, seed, rate=1.0, size=400):
    """Electrons of a flat sheet."""
    expected = expected_electrons(np.full((size, size), rate), options)
    return count_electrons(expected, options.summed_read_noise_e, np.random.default_rng(seed))


def assert_noise(electrons, mean, variance):
    """Mean and variance within 4 sigma of a model whose fourth moment is near enough a Gaussian's, from both sides."""
    n = electrons.size
    assert abs(electrons.mean() - mean) < 4 * np.sqrt(variance / n)
    assert abs(electrons.var(ddof=1) - variance) < 4 * np.sqrt((variance + 2 * variance**2) / n)


def test_a_picoampere_for_a_microsecond_is_6_24_electrons():
    assert incident_electrons(1.0, 1.0) == pytest.approx(6.241509, rel=1e-6)
    assert incident_electrons(216.0, 12.85) == pytest.approx(17_324, rel=1e-4)


def test_current_and_dwell_time_state_the_same_dose_as_electrons_do():
    stated = DetectorOptions(beam_current_pa=10.0, dwell_us=2.0)
    assert stated.frame_dose_e == pytest.approx(124.83, rel=1e-4)
    assert np.array_equal(drawn(stated, 1), drawn(DetectorOptions(stated.frame_dose_e), 1))


@pytest.mark.parametrize(
    "options", [{"beam_current_pa": 10.0}, {"dwell_us": 1.0}, {"beam_current_pa": 1.0, "dwell_us": 1.0, "dose_e": 9.0}]
)
def test_a_dose_stated_in_part_or_twice_is_refused(options):
    with pytest.raises(InputError, match="dose"):
        DetectorOptions(**options)


def test_one_frame_and_a_perfect_detector_change_nothing():
    rate = np.random.default_rng(0).uniform(size=(8, 9))
    assert np.array_equal(expected_electrons(rate, DetectorOptions(dose_e=1.0)), rate)
    assert np.array_equal(expected_electrons(rate, DetectorOptions(dose_e=70.0)), 70.0 * rate)


def test_an_inefficient_detector_thins_the_electrons_and_they_stay_poisson():
    """As many as a coin thrown for each electron keeps, and with their scatter."""
    assert_noise(drawn(DetectorOptions(dose_e=200.0, dqe=0.3), 2), 60.0, 60.0)
    tossed = np.random.default_rng(3).binomial(drawn(DetectorOptions(dose_e=200.0), 4).astype(int), 0.3)
    assert_noise(tossed, 60.0, 60.0)


def test_frames_add_up_in_signal_counting_noise_and_read_noise():
    """Eight frames drawn at once have the mean and variance of eight drawn apart and added."""
    eight = DetectorOptions(dose_e=10.0, frames=8, read_noise_e=2.0)
    single = DetectorOptions(dose_e=10.0, read_noise_e=2.0)
    assert_noise(drawn(eight, 5), 80.0, 80.0 + 8 * 4.0)
    assert_noise(sum(drawn(single, seed) for seed in range(10, 18)), 80.0, 80.0 + 8 * 4.0)


def test_everything_together_has_the_variance_of_the_model():
    """Grey variance: gain^2 (dose frames dqe rate + frames read_noise^2), plus 1/12 for the rounding."""
    options = DetectorOptions(dose_e=50.0, frames=4, dqe=0.5, read_noise_e=3.0, bits=16, gain_per_e=20.0)
    (contrast,) = contrasts([np.ones((2, 2))], options)
    grey = digitise(drawn(options, 6, rate=0.8), contrast, 16).astype(float)
    assert_noise(grey / 20.0, 80.0, 80.0 + 4 * 9.0 + 1 / 12 / 400)


def test_auto_contrast_knows_frames_and_efficiency():
    rate = np.random.default_rng(7).uniform(0.2, 2.0, (300, 300))
    noisy = DetectorOptions(dose_e=50.0, frames=8, dqe=0.4, read_noise_e=30.0)
    for options in (DetectorOptions(), noisy):
        expected = expected_electrons(rate, options)
        (contrast,) = contrasts([expected], options)
        electrons = count_electrons(expected, options.summed_read_noise_e, np.random.default_rng(8))
        black, white = saturation(digitise(electrons, contrast, 8))
        assert black < 0.01
        assert 0 < white < 0.02


def test_views_and_channels_draw_from_children_that_do_not_depend_on_the_others():
    few = random_children(np.random.default_rng(9), 2)
    many = random_children(np.random.default_rng(9), 3, 4)
    draws = {child.integers(2**62) for view in many for child in view}
    assert len(draws) == 12
    assert {child.integers(2**62) for view in few for child in view} < draws


def test_the_same_seed_gives_the_same_bits_in_another_process():
    script = """
import numpy as np
from semsim.detector import count_electrons, random_children
child = random_children(np.random.default_rng(11), 2, 2)[1][1]
print(count_electrons(np.full((30, 40), 50.0), 2.0, child).tobytes().hex())
"""
    answers = [subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True) for _ in "ab"]
    child = random_children(np.random.default_rng(11), 2, 2)[1][1]
    here = count_electrons(np.full((30, 40), 50.0), 2.0, child).tobytes().hex()
    assert [answer.stdout.strip() for answer in answers] == [here, here]


def test_saturation_is_the_share_at_either_end():
    assert saturation(np.array([[0, 0, 255, 7]], dtype=np.uint8)) == (0.5, 0.25)
    assert saturation(np.array([[0, 255, 65535, 65535]], dtype=np.uint16)) == (0.25, 0.5)


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
        ("beam_current_pa", 0.0),
        ("dwell_us", -1.0),
        ("frames", 0),
        ("dqe", 1.5),
        ("dqe", 0.0),
        ("read_noise_e", -1.0),
        ("bits", 12),
        ("contrast", "x"),
        ("gain_per_e", 0),
    ],
)
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        DetectorOptions(**{key: value})
