"""The spot: no electron lost, none moved, and a width that follows depth as the cone of the beam says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semsim.errors import InputError
from semsim.microscope import Microscope
from semsim.spot import SpotOptions, blur_by_spot, elliptic_kernel, focus_layers, spot_kernel, spot_variances

MICROSCOPE = Microscope(0.147, 64, 64)
CONE = SpotOptions(convergence_mrad=10.0)
EVERY_KIND = {
    "round": SpotOptions(),
    "elliptic": SpotOptions(astigmatism=0.6, astigmatism_angle_deg=25),
    "cone": CONE,
    "needle cone": SpotOptions(sigma_px=0.0, convergence_mrad=10),
    "elliptic cone": SpotOptions(astigmatism=0.6, astigmatism_angle_deg=25, convergence_mrad=10, focus_um=-9),
    "line foci": SpotOptions(sigma_px=1.0, astigmatism_angle_deg=25, convergence_mrad=10, line_foci_um=30),
}


def relief(shape=(64, 64)):
    """A ramp of 120 um from top to bottom with waves of 20 um."""
    return np.linspace(-60, 60, shape[0])[:, None] + 20 * np.sin(np.arange(shape[1]) / 9)[None]


def noise(shape=(64, 64)):
    return np.random.default_rng(0).normal(size=shape)


def moments(kernel):
    """Centroid (x, y) and covariance of a kernel, px, with y down."""
    r = kernel.shape[0] // 2
    y, x = np.mgrid[-r : r + 1, -r : r + 1]
    return (
        (kernel * x).sum(),
        (kernel * y).sum(),
        (kernel * x * x).sum(),
        (kernel * x * y).sum(),
        (kernel * y * y).sum(),
    )


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


@pytest.mark.parametrize(("sigma_px", "missing"), [(0.5, 0.142), (0.7, 0.0025)])
def test_a_narrow_spot_is_narrower_than_asked_for_as_documented(sigma_px, missing):
    kernel = spot_kernel(sigma_px)
    x = np.arange(len(kernel)) - len(kernel) // 2
    assert 1 - (x**2 * kernel).sum() / sigma_px**2 == pytest.approx(missing, rel=0.1)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 5.0), st.floats(0.0, 5.0), st.floats(-7.0, 7.0))
def test_an_elliptic_spot_keeps_every_electron_and_moves_none(along, across, angle_rad):
    kernel = elliptic_kernel(along, across, angle_rad)
    x, y, *_ = moments(kernel)
    assert abs(kernel.sum() - 1) < 1e-12
    assert max(abs(x), abs(y)) < 1e-6
    assert kernel.min() >= 0


@settings(max_examples=40, deadline=None)
@given(st.floats(0.8, 4.0), st.floats(0.8, 4.0), st.floats(-7.0, 7.0))
def test_an_elliptic_spot_has_the_widths_and_the_direction_asked_for(along, across, angle_rad):
    _, _, xx, xy, yy = moments(elliptic_kernel(along, across, angle_rad))
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    sizes = max(along, across) ** 2
    assert xx == pytest.approx((c * along) ** 2 + (s * across) ** 2, abs=2e-3 * sizes)
    assert yy == pytest.approx((s * along) ** 2 + (c * across) ** 2, abs=2e-3 * sizes)
    assert -xy == pytest.approx(c * s * (along**2 - across**2), abs=2e-3 * sizes)  # y is down, the angle goes up


def test_a_quarter_turn_turns_the_elliptic_spot():
    assert np.allclose(elliptic_kernel(2.0, 0.9, 0.3 + np.pi / 2), np.rot90(elliptic_kernel(2.0, 0.9, 0.3)), atol=1e-15)
    separable = np.outer(spot_kernel(2.0), np.pad(spot_kernel(0.9), 5))
    assert np.allclose(elliptic_kernel(2.0, 0.9, np.pi / 2), separable, atol=1e-5)


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 180.0, -90.0])
def test_separable_and_rotated_kernels_meet(angle_deg):
    near = SpotOptions(2.0, 0.7, angle_deg + 1e-7)
    exact = SpotOptions(2.0, 0.7, angle_deg)
    blurred = [blur_by_spot(noise(), relief(), options, MICROSCOPE) for options in (near, exact)]
    assert np.allclose(*blurred, atol=2e-5)


def test_a_needle_leaves_the_picture_as_it_is():
    rate = noise()
    assert blur_by_spot(rate, relief(), SpotOptions(sigma_px=0.0), MICROSCOPE) is rate
    assert np.array_equal(spot_kernel(0.0), [1.0])


def test_blurring_a_point_gives_the_spot():
    rate = np.zeros((31, 33))
    rate[15, 16] = 1.0
    x, y = np.arange(33) - 16, np.arange(31) - 15
    gauss = np.exp(-0.5 * (x[None] ** 2 + y[:, None] ** 2) / 1.3**2)
    blurred = blur_by_spot(rate, rate, SpotOptions(1.3), MICROSCOPE)
    assert blurred.sum() == pytest.approx(1, abs=1e-12)
    assert np.allclose(blurred, gauss / gauss.sum(), atol=2e-7)
    assert (blurred.sum(axis=0) * x).sum() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("kind", ["round", "elliptic"])
def test_blurring_commutes_with_shifting(kind):
    def blur(rate):
        return blur_by_spot(rate, rate, EVERY_KIND[kind], MICROSCOPE)

    shifted = blur(np.roll(noise(), (2, -3), (0, 1)))
    assert np.allclose(shifted[12:-12, 12:-12], np.roll(blur(noise()), (2, -3), (0, 1))[12:-12, 12:-12], atol=1e-12)


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_constants_and_ramps_stay_whatever_the_depth(kind):
    """The weights of every pixel add up to 1, and their centre of mass is the pixel."""
    depth = relief()
    depth[20:40, 30:50] = np.nan
    constant = blur_by_spot(np.full((64, 64), 3.0), depth, EVERY_KIND[kind], MICROSCOPE)
    assert np.allclose(constant, 3.0, atol=1e-12)
    ramp = np.add.outer(np.arange(64.0), 2 * np.arange(64.0))
    moved = blur_by_spot(ramp, depth, EVERY_KIND[kind], MICROSCOPE) - ramp
    assert np.abs(moved[20:-20, 20:-20]).max() < 1e-6


def test_without_convergence_depth_does_not_matter():
    options = SpotOptions(1.1, line_foci_um=50.0, focus_um=7.0)
    deep, flat = relief(), np.zeros((64, 64))
    assert np.array_equal(*(blur_by_spot(noise(), depth, options, MICROSCOPE) for depth in (deep, flat)))


def test_in_focus_the_cone_is_the_spot():
    flat = np.full((64, 64), 12.5)
    cone = blur_by_spot(noise(), flat, SpotOptions(1.1, convergence_mrad=50, focus_um=12.5), MICROSCOPE)
    assert np.allclose(cone, blur_by_spot(noise(), flat, SpotOptions(1.1), MICROSCOPE), atol=1e-14)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_flat_sheet_out_of_focus_is_blurred_by_the_cone(sign):
    """10 mrad, 58.8 um from focus: a disc of 0.588 um or 4 px radius, so 2 px of standard deviation."""
    flat = np.full((64, 64), sign * 58.8)
    cone = blur_by_spot(noise(), flat, CONE, MICROSCOPE)
    assert np.allclose(cone, blur_by_spot(noise(), flat, SpotOptions(np.hypot(0.7, 2.0)), MICROSCOPE), atol=1e-12)


def measured_variances(options, depth):
    """Local variances (xx, xy, yy) of the spot: what it adds to the pictures x^2, xy and y^2."""
    y, x = np.mgrid[:128, :128] - 63.5
    pairs = (x * x, x * y, y * y)
    return [blur_by_spot(f, depth, options, MICROSCOPE)[40:-40, 40:-40] - f[40:-40, 40:-40] for f in pairs]


def test_the_variance_grows_with_depth_as_stated_everywhere():
    """Mixtures of two layers have the exact variance; what is left (0.3 %) is the sampling of the narrowest kernels."""
    depth = relief((128, 128))
    xx, xy, yy = measured_variances(CONE, depth)
    stated = 0.7**2 + (0.010 / 2 * depth[40:-40, 40:-40] / 0.147) ** 2
    for measured in (xx, yy):
        assert np.abs(measured / stated - 1).max() < 0.003
    assert np.abs(xy).max() < 1e-9


def test_line_foci_stretch_the_spot_along_the_angle_above_focus_and_across_it_below():
    options = SpotOptions(1.0, astigmatism_angle_deg=30, convergence_mrad=10, line_foci_um=60)
    long, short = 1.0 + (0.010 / 2 * 60 / 0.147) ** 2, 1.0
    for defocus, along, across in ((-30.0, long, short), (30.0, short, long)):
        assert spot_variances(defocus, options, MICROSCOPE) == pytest.approx((along, across))
        xx, xy, yy = (float(m.mean()) for m in measured_variances(options, np.full((128, 128), defocus)))
        assert xx + yy == pytest.approx(along + across, rel=1e-3)
        assert xx - yy == pytest.approx((along - across) * np.cos(np.deg2rad(60)), rel=1e-3)
        assert -2 * xy == pytest.approx((along - across) * np.sin(np.deg2rad(60)), rel=1e-3)
    along, across = spot_variances(0.0, options, MICROSCOPE)
    assert along == across


def test_line_foci_have_at_most_2_percent_too_much_variance():
    options = SpotOptions(1.0, convergence_mrad=10, line_foci_um=30)
    depth = relief((128, 128))
    xx, _, yy = measured_variances(options, depth)
    along, across = spot_variances(depth[40:-40, 40:-40], options, MICROSCOPE)
    excess = (xx + yy) / (along + across) - 1
    assert excess.min() > -0.001
    assert excess.max() < 0.02
    assert np.abs((xx - yy) - (along - across)).max() < 0.001 * (along + across).max()


def brute_force(rate, depth, options):
    """Average each pixel with the kernel of its own depth."""
    reach = 60
    padded = np.pad(rate, reach, mode="reflect")
    answer = np.empty_like(rate)
    for row, column in np.ndindex(*rate.shape):
        along, across = np.sqrt(spot_variances(depth[row, column] - options.focus_um, options, MICROSCOPE))
        kernel = elliptic_kernel(along, across, np.deg2rad(options.astigmatism_angle_deg))
        if along == across:
            kernel = np.outer(spot_kernel(along), spot_kernel(along))
        r = kernel.shape[0] // 2
        there = padded[reach + row - r : reach + row + r + 1, reach + column - r : reach + column + r + 1]
        answer[row, column] = (kernel * there).sum()
    return answer


@pytest.mark.parametrize(
    ("kind", "rms", "most"),
    [("cone", 0.004, 0.02), ("needle cone", 0.013, 0.1), ("elliptic cone", 0.005, 0.03), ("line foci", 0.008, 0.06)],
)
def test_layers_agree_with_a_kernel_for_every_pixel(kind, rms, most):
    """On white noise of standard deviation 1, the hardest picture there is."""
    options, depth = EVERY_KIND[kind], relief()
    error = blur_by_spot(noise(), depth, options, MICROSCOPE) - brute_force(noise(), depth, options)
    assert error.std() < rms
    assert np.abs(error).max() < most


def test_layers_reach_from_end_to_end_and_a_flat_sheet_needs_one():
    layers = focus_layers(-40.0, 70.0, EVERY_KIND["line foci"], MICROSCOPE)
    assert (layers[0], layers[-1]) == (-40.0, 70.0)
    assert (np.diff(layers) > 0).all()
    assert list(focus_layers(5.0, 5.0, CONE, MICROSCOPE)) == [5.0]


def test_misses_take_the_depth_of_the_nearest_hit():
    depth = np.full((64, 64), 58.8)
    depth[:, 32:] = 0.0
    gaps = depth.copy()
    gaps[:, :20] = np.nan
    gaps[:, 50:] = np.nan
    blurred = [blur_by_spot(noise(), d, CONE, MICROSCOPE) for d in (depth, gaps)]
    assert np.allclose(*blurred, atol=1e-12)


def test_a_view_without_specimen_is_in_focus():
    nothing = np.full((64, 64), np.nan)
    blurred = blur_by_spot(noise(), nothing, SpotOptions(0.7, convergence_mrad=10, focus_um=30), MICROSCOPE)
    assert np.allclose(blurred, blur_by_spot(noise(), nothing, SpotOptions(0.7), MICROSCOPE), atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sigma_px", -1.0),
        ("astigmatism", 1.0),
        ("convergence_mrad", -1.0),
        ("line_foci_um", -1.0),
        ("focus_um", float("nan")),
        ("astigmatism_angle_deg", 400.0),
    ],
)
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        SpotOptions(**{key: value})
