"""Claims on the tilt axis of a reconstruction: stated ones stand, missing ones are found, contradictions are said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_surface import bump_series

from semrecon.data import TiltSeries, View
from semrecon.pipeline import reconstruct
from semrecon.pose.orientation import oriented


@pytest.fixture(scope="module")
def series() -> TiltSeries:
    return bump_series((-8.0, 0.0, 8.0))


def turned(series: TiltSeries) -> TiltSeries:
    """Turn all images by a quarter, clockwise: the axis, once image up, then points right."""
    optics = replace(series.optics, width_px=series.optics.height_px, height_px=series.optics.width_px)
    views = tuple(replace(view, image=np.ascontiguousarray(np.rot90(view.image, -1))) for view in series.views)
    return TiltSeries(views, optics, 90.0)


def test_a_missing_axis_is_found_and_said(series: TiltSeries) -> None:
    found, said = oriented(replace(series, tilt_axis_deg=33.0), False, np.random.default_rng(0))
    assert found.tilt_axis_deg == pytest.approx(0.0, abs=2.0)
    assert "nobody states the tilt axis" in said[0]
    assert any("sign" in sentence for sentence in said)


def test_the_axis_turns_with_the_images(series: TiltSeries) -> None:
    found, _ = oriented(replace(turned(series), tilt_axis_deg=0.0), False, np.random.default_rng(0))
    assert abs(found.tilt_axis_deg) == pytest.approx(90.0, abs=2.0)


def test_a_stated_axis_stands_and_a_wrong_one_is_contradicted(series: TiltSeries) -> None:
    right, silence = oriented(series, True, np.random.default_rng(0))
    assert (right.tilt_axis_deg, silence) == (0.0, ())
    wrong, said = oriented(replace(series, tilt_axis_deg=40.0), True, np.random.default_rng(0))
    assert wrong.tilt_axis_deg == 40.0
    assert "is given as 40 degrees, but the images say" in said[0]


def test_images_that_show_no_axis_leave_it_to_convention() -> None:
    noise = np.random.default_rng(0)
    series = bump_series((0.0, 6.0))
    views = tuple(View(noise.integers(0, 255, view.image.shape, np.uint8), view.tilt_deg) for view in series.views)
    found, said = oriented(replace(series, views=views), False, np.random.default_rng(0))
    assert found.tilt_axis_deg == 0.0
    assert "taken to be image up" in said[0]


def test_the_recipe_finds_a_missing_axis(series: TiltSeries) -> None:
    result = reconstruct(replace(series, tilt_axis_deg=70.0), "known_rotation", axis_stated=False)
    assert result.series.tilt_axis_deg == pytest.approx(0.0, abs=2.0)
    assert "nobody states the tilt axis" in result.warnings[0]
    assert "tilt axis" in result.seconds
