"""Claims on shape from shading: the secant law inverted, and one view turned into a hill where its assumption holds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semrecon.data import Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.judging.gauge import gauge_residual
from semrecon.methods.shape_from_shading import ShapeFromShading
from semrecon.photometry.shading import first_relief, improve, misfit, steepness

PIXEL_UM, ROWS, COLUMNS = 0.1, 96, 120
EXACT = ShapeFromShading(blur_px=0.0, flat_percentile=0.0)


def dome(height_um=1.5):
    """A hill whose foot is level: heights and steepness, written out here on their own."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS].astype(float)
    x, y = (column - (COLUMNS - 1) / 2) * PIXEL_UM, -(row - (ROWS - 1) / 2) * PIXEL_UM
    z = height_um * np.exp(-((x - 0.5) ** 2 + 1.4 * (y - 0.4) ** 2) / 4)
    return z, z * np.hypot(2 * (x - 0.5) / 4, 2.8 * (y - 0.4) / 4)


def picture(exponent=1.0, flat=100.0):
    return flat * np.sqrt(1 + dome()[1] ** 2) ** exponent


def series_of(image, **view):
    return TiltSeries((View(image, 0.0, "top.tif", **view),), Optics(PIXEL_UM, image.shape[1], image.shape[0]))


def answer(method, image, **view):
    return method(series_of(image, **view), rng=np.random.default_rng(0))


def error_um(found, gauge=("offset",)):
    return np.abs(gauge_residual(found, dome()[0], gauge, norm="absolute"))


@given(st.floats(0.2, 500), st.floats(0.3, 3), st.floats(0, 2.9))
@settings(max_examples=50, deadline=None)
def test_the_secant_law_is_inverted(flat, exponent, slope):
    bright = np.full((2, 2), flat * np.hypot(1, slope) ** exponent)
    np.testing.assert_allclose(steepness(bright, flat, exponent, 3.0), slope, atol=1e-6)


def test_darker_than_flat_is_flat_and_glow_is_bounded():
    np.testing.assert_array_equal(steepness(np.array([[50.0, np.nan, 1e6]]), 100.0, 1.0, 3.0), [[0, 0, 3]])


def test_an_even_slope_makes_a_pyramid_above_the_frame():
    """The closed form of the eikonal equation on a rectangle: slope times the distance from the frame."""
    slope = np.full((21, 31), 0.5)
    row, column = np.mgrid[0:21, 0:31]
    nearest = np.minimum(np.minimum(row, 20 - row), np.minimum(column, 30 - column))
    found = first_relief(slope, PIXEL_UM)
    np.testing.assert_allclose(found, 0.5 * PIXEL_UM * nearest, atol=0.4 * 0.5 * PIXEL_UM)  # ridges are rounded
    np.testing.assert_allclose(found[10, :8], 0.5 * PIXEL_UM * np.arange(8), atol=1e-4)


def test_from_its_darkest_place_a_cone_falls_on_all_sides():
    row, column = np.mgrid[0:61, 0:61] - 30.0
    slope = np.where(np.hypot(row, column) > 0.5, 0.5, 0.0)
    found = first_relief(slope, PIXEL_UM, "bright")
    np.testing.assert_allclose(found, -0.5 * PIXEL_UM * np.hypot(row, column), atol=0.06)


@pytest.mark.parametrize("lowest", ["frame", "bright"])
def test_improvement_makes_the_picture_fit_better(lowest):
    true, slope = dome()
    start = first_relief(slope, PIXEL_UM, "frame")
    better = improve(start, slope, PIXEL_UM, 30, 1.0)
    assert misfit(better, slope, PIXEL_UM) < 0.3 * misfit(start, slope, PIXEL_UM)
    assert misfit(true, slope, PIXEL_UM) < misfit(better, slope, PIXEL_UM)
    if lowest == "bright":
        mirrored = improve(-start, slope, PIXEL_UM, 30, 1.0)  # nothing but the start tells up from down
        np.testing.assert_allclose(mirrored, -better, atol=1e-9)


@pytest.mark.parametrize("exponent", [0.8, 1.0, 1.2])
def test_the_secant_law_without_noise_gives_absolute_heights(exponent):
    """0.003 um in the median and 0.015 um at worst, of 1.5 um; neither scale nor sign is taken away."""
    found = answer(ShapeFromShading(exponent=exponent, blur_px=0.0, flat_percentile=0.0), picture(exponent))
    assert np.median(error_um(found.heights.z_um)) < 0.003
    assert error_um(found.heights.z_um).max() < 0.015


def test_a_wrong_exponent_is_little_more_than_a_scale():
    found = answer(EXACT, picture(1.2)).heights.z_um
    raised = dome()[0] > 0.15
    scaled = np.median(error_um(found, ShapeFromShading.gauge)[raised])
    assert np.median(error_um(found)[raised]) > 5 * scaled
    assert scaled < 0.02


def test_the_unit_of_brightness_does_not_matter_and_that_of_the_pixel_does():
    one = answer(EXACT, picture())
    np.testing.assert_allclose(answer(EXACT, picture() * 7).heights.z_um, one.heights.z_um, atol=1e-9)
    optics = Optics(3 * PIXEL_UM, COLUMNS, ROWS)
    larger = EXACT(TiltSeries((View(picture(), 0.0),), optics), rng=np.random.default_rng(0))
    np.testing.assert_allclose(larger.heights.z_um, 3 * one.heights.z_um, atol=1e-7)


def test_turning_the_picture_turns_the_surface():
    straight = answer(EXACT, picture()).heights.z_um
    turned = answer(EXACT, np.rot90(picture())).heights.z_um
    np.testing.assert_allclose(turned, np.rot90(straight), atol=1e-6)


def test_noise_and_grey_levels_cost_a_little():
    noisy = np.random.default_rng(4).poisson(picture()).clip(0, 255).astype(np.uint8)
    found = answer(ShapeFromShading(blur_px=2.0, flat_percentile=50.0), noisy).heights.z_um
    assert 0.005 < np.median(error_um(found, ShapeFromShading.gauge)) < 0.1


def test_missing_rows_and_masks_stay_missing_and_the_picture_is_not_touched():
    image = picture()
    image[50] = np.nan
    mask = np.ones(image.shape, bool)
    mask[:, :4] = False
    before = image.copy()
    one = answer(ShapeFromShading(), image, mask=mask)
    missing = ~mask
    missing[50] = True
    np.testing.assert_array_equal(np.isnan(one.heights.z_um), missing)
    np.testing.assert_array_equal(image, before)
    again = answer(ShapeFromShading(), image, mask=mask)
    np.testing.assert_array_equal(one.heights.z_um, again.heights.z_um)


@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_view_is_told_in_a_sentence(level):
    with pytest.raises(MethodError, match=r"top.tif is nearly all black, white or missing"):
        answer(ShapeFromShading(), np.full((64, 64), level, np.uint8))


def test_an_even_view_is_told_in_a_sentence():
    with pytest.raises(MethodError, match=r"top.tif shows no shading"):
        answer(ShapeFromShading(), np.full((64, 64), 90, np.uint8))


def test_a_view_below_the_black_level_is_told_in_a_sentence():
    with pytest.raises(MethodError, match=r"top.tif is darker than the black level 300"):
        answer(ShapeFromShading(black_level=300.0), picture())


def test_an_image_of_64_by_64_pixels_of_noise_is_survived():
    noise = (np.random.default_rng(6).random((64, 64)) * 200 + 20).astype(np.uint8)
    found = answer(ShapeFromShading(), noise).heights.z_um
    assert found.shape == (64, 64)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("options", [{"lowest": "left"}, {"exponent": 0.0}, {"flat_percentile": 99.0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        ShapeFromShading(**options)
