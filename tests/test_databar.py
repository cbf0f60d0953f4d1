"""The data bar: the picture above it untouched, and a scale bar from which the pixel size can be measured."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semrecon.input.calibration import pixel_size_from_bar
from semsim.databar import DataBarOptions, round_length, scale_bar, with_data_bar
from semsim.errors import InputError
from semsim.microscope import Microscope

POLLEN = Microscope.from_data_bar(5, 34, 854, 640)


def noise(microscope, kind=np.uint8):
    rng = np.random.default_rng(0)
    return rng.integers(0, np.iinfo(kind).max, microscope.shape, dtype=kind, endpoint=True)


def measured_px(picture, rows):
    """Length of the last run of ink in the middle of the bar's rows, in px; the last pixel may be grey."""
    line = picture[(rows[0] + rows[1]) // 2].astype(float) / np.iinfo(picture.dtype).max
    inked = np.flatnonzero(line > 0)
    gaps = np.flatnonzero(np.diff(inked) > 1)
    return line[inked[gaps[-1] + 1] if len(gaps) else inked[0] :].sum()


def test_without_height_there_is_no_data_bar():
    picture = noise(POLLEN)
    assert with_data_bar(picture, DataBarOptions(), POLLEN) is picture


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_the_picture_above_the_data_bar_stays_as_it_is(kind):
    picture = noise(POLLEN, kind)
    barred = with_data_bar(picture, DataBarOptions(48), POLLEN, "pollen")
    assert barred.shape == (640 + 48, 854)
    assert barred.dtype == kind
    assert np.array_equal(barred[:640], picture)
    assert barred[640:].max() == np.iinfo(kind).max
    assert np.median(barred[640:]) == 0


@settings(max_examples=40, deadline=None)
@given(
    size_um=st.floats(1e-3, 50),
    width=st.integers(64, 1500),
    height=st.integers(24, 90),
    kind=st.sampled_from([np.uint8, np.uint16]),
)
def test_the_pixel_size_can_be_measured_from_the_bar(size_um, width, height, kind):
    """To half a grey level of the bar's last pixel (and rounding)."""
    microscope = Microscope(size_um, width, 20)
    options = DataBarOptions(height)
    bar = scale_bar(options, microscope)
    barred = with_data_bar(np.zeros(microscope.shape, kind), options, microscope, "x")
    length_px = measured_px(barred, bar.rows)
    assert abs(length_px - bar.length_px) <= 0.5001 / np.iinfo(kind).max
    error = 0.51 / np.iinfo(kind).max / bar.length_px
    assert pixel_size_from_bar(bar.length_um, length_px) == pytest.approx(size_um, rel=error)


def test_the_seeds_pollen_gets_a_bar_of_20_um_that_covers_136_px():
    bar = scale_bar(DataBarOptions(48), POLLEN)
    assert bar.length_um == 20.0
    assert bar.length_px == pytest.approx(136.0, abs=1e-9)


@given(st.floats(1e-6, 1e6))
def test_round_lengths_are_1_2_or_5_and_fill_at_least_two_fifths(longest):
    length = round_length(longest)
    assert 0.4 * longest * (1 - 1e-12) <= length <= longest
    assert f"{length:e}"[0] in "125"
    assert float(f"{length:.0e}") == length


@pytest.mark.parametrize("longest", [0.01, 0.2, 5.0, 1.0, 1000.0])
def test_a_round_length_is_its_own(longest):
    assert round_length(longest) == longest


def test_text_leaves_the_scale_bar_alone():
    """Whatever there is to print, columns from the bar's left end on look the same."""
    for width in (64, 256, 854):
        microscope = Microscope(0.5, width, 20)
        column = scale_bar(DataBarOptions(32), microscope).column
        black = np.zeros(microscope.shape, np.uint8)
        little = with_data_bar(black, DataBarOptions(32, detector=""), microscope)
        for options, label in ((DataBarOptions(32), "a long label " * 9), (DataBarOptions(32, detector="g" * 99), "")):
            assert np.array_equal(with_data_bar(black, options, microscope, label)[:, column:], little[:, column:])


def test_label_and_settings_are_printed():
    plain = with_data_bar(noise(POLLEN), DataBarOptions(48), POLLEN)
    for other, label in (
        (DataBarOptions(48, voltage_kv=1.0), ""),
        (DataBarOptions(48, detector="BSE"), ""),
        (DataBarOptions(48), "x"),
    ):
        assert not np.array_equal(with_data_bar(noise(POLLEN), other, POLLEN, label), plain)


@pytest.mark.parametrize(("key", "value"), [("height_px", 10), ("voltage_kv", 0.0), ("print_width_um", -1.0)])
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        DataBarOptions(**{key: value})
