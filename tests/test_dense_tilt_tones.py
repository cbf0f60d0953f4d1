"""Brightness that changes with tilt: what differences between views say of heights and slopes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from semrecon.data import Array, Optics, Poses
from semrecon.dense.parallax import ParallaxOptions, drawn, refined, shared
from semrecon.dense.reflectance import slopes, slopes_transposed
from semrecon.dense.sightlines import Sightlines, sightlines
from semrecon.dense.spline import Spline
from semrecon.dense.tilt_tones import Differences, Windows, differences, gentle, misfit, show_mean_tone
from semrecon.geometry import rotations_from_tilts

SHAPE = (80, 112)
BLACK = 20.0
TILTS = np.array([0.0, 4.0, 8.0])


def lines_of(tilts: Array = TILTS) -> Sightlines:
    poses = Poses(rotations_from_tilts(tilts, 0.0), np.zeros((len(tilts), 3)))
    return sightlines(poses, np.tile(np.eye(2), (len(tilts), 1, 1)), Optics(1.0, SHAPE[1], SHAPE[0]), 0)


def relief(seed: int, *, height: float = 1.0, reach: float = 4.0) -> Array:
    rough = shared(np.random.default_rng(seed).standard_normal(SHAPE), reach).astype(np.float64)
    return np.asarray(rough * height / rough.std())


def secant_tone(heights: Array, turn: Array) -> Array:
    """Half the logarithm of the secant of the angle between beam and normal, by its definition."""
    across, down = (each.astype(np.float64) for each in slopes(heights))
    normal = np.stack([across, down, np.ones_like(across)]) / np.sqrt(1 + across**2 + down**2)
    return np.asarray(-0.5 * np.log(np.tensordot(turn[2], normal, axes=1)))


def photographs(heights: Array, paint: Array, lines: Sightlines) -> list[Spline]:
    """Views without noise of a painted surface that follows the secant law."""
    from scipy.ndimage import map_coordinates, spline_filter

    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    middle, answer = (SHAPE[1] - 1) / 2, []
    for tilt, matrix in zip(np.deg2rad(TILTS), lines.matrices, strict=True):
        shown = 28 * np.exp(paint + secant_tone(heights, matrix[:, :3])) - BLACK
        source = x.copy()
        for _ in range(40):  # the column of the reference view that lands on this one
            height = map_coordinates(heights, [y, source], order=3, mode="nearest")
            source = middle + (x - middle - np.sin(tilt) * height) / np.cos(tilt)
        seen = map_coordinates(shown, [y, source], order=3, mode="nearest")
        coefficients = spline_filter(seen, order=3, output=np.float32, mode="mirror")
        answer.append(Spline(coefficients, np.ones(SHAPE, dtype=np.bool_)))
    return answer


def some_differences(heights: Array) -> Differences:
    lines = lines_of()
    views = photographs(relief(1), relief(2, height=0.1, reach=2.0), lines)
    return differences(*drawn(views, lines, heights), lines, heights, BLACK, ParallaxOptions(), Windows())


def test_the_transpose_of_slopes_is_the_transpose() -> None:
    inner = np.zeros(SHAPE, np.float32)
    inner[8:-8, 8:-8] = 1
    z, across, down = relief(3) * inner, (relief(4) * inner).astype(np.float32), (relief(5) * inner).astype(np.float32)
    forth = np.vdot(slopes(z)[0], across) + np.vdot(slopes(z)[1], down)
    assert forth == pytest.approx(np.vdot(z, slopes_transposed(across, down)), rel=1e-4)


def test_the_normal_equations_are_symmetric() -> None:
    found, inner = some_differences(relief(6)), np.zeros(SHAPE)
    inner[8:-8, 8:-8] = 1
    one, other = relief(7) * inner, relief(8) * inner
    assert np.vdot(one, found.by_slopes(other)) == pytest.approx(np.vdot(found.by_slopes(one), other), rel=1e-3)


def test_the_normal_equations_are_nowhere_negative() -> None:
    found = some_differences(relief(6))
    for seed in range(8):
        z = relief(20 + seed, reach=1.0 + seed)
        assert np.vdot(z, found.heights * z + found.by_slopes(z)) > 0


def test_all_views_show_the_mean_tone_of_the_secant_law() -> None:
    heights, lines = relief(9, height=0.5), lines_of()
    exact = [28 * np.exp(secant_tone(heights, matrix[:, :3])) - BLACK for matrix in lines.matrices]
    values = np.stack(exact).astype(np.float32)
    before = float(np.ptp(values, axis=0).mean())
    show_mean_tone(values, heights, lines, BLACK)
    assert float(np.ptp(values, axis=0).mean()) < 0.05 * before


def test_a_level_surface_keeps_its_grey_values() -> None:
    values = np.stack([relief(seed) for seed in range(3)]).astype(np.float32)
    again = values.copy()
    show_mean_tone(again, np.zeros(SHAPE), lines_of(np.array([0.0, 0.0, 0.0])), BLACK)
    assert_allclose(again, values, atol=1e-5)


def test_steep_places_count_nothing_and_level_ones_in_full() -> None:
    ramp = np.tile(np.arange(SHAPE[1], dtype=np.float64), (SHAPE[0], 1))
    for slope, weight in ((0.0, 1.0), (2.0, 0.5), (8.0, 0.0)):
        assert gentle(slope * ramp)[40, 56] == pytest.approx(weight, abs=0.01)
        assert gentle(slope / 2 * ramp, 1.0)[40, 56] == pytest.approx(weight, abs=0.01)


def test_true_heights_ask_for_no_change() -> None:
    lines, true = lines_of(), relief(1)
    views = photographs(true, relief(2, height=0.1, reach=2.0), lines)
    asked = [
        np.abs(differences(*drawn(views, lines, heights), lines, heights, BLACK, ParallaxOptions(), Windows()).asked())[
            16:-16, 16:-16
        ].mean()
        for heights in (true, true + relief(10, height=0.5))
    ]
    assert asked[0] < 0.15 * asked[1]


def test_true_heights_fit_best_and_parallax_alone_leads_away_from_them() -> None:
    lines, true = lines_of(), relief(1)
    views = photographs(true, relief(2, height=0.02, reach=2.0), lines)
    by_parallax = refined(views, lines, true, 1.0, ParallaxOptions())
    inner = np.s_[16:-16, 16:-16]
    assert np.abs(by_parallax - true)[inner].mean() > 0.1
    fits = [
        misfit(drawn(views, lines, z)[0], lines, z, BLACK, ParallaxOptions())[inner].mean() for z in (true, by_parallax)
    ]
    assert fits[0] < fits[1]


def test_the_misfit_of_equal_views_is_nothing_and_of_one_view_unknown() -> None:
    lines = lines_of(np.array([0.0, 0.0, 0.0]))
    view = photographs(np.zeros(SHAPE), relief(2, height=0.1), lines_of())[0]
    level = np.zeros(SHAPE)
    assert_allclose(
        misfit(drawn([view] * 3, lines, level)[0], lines, level, None, ParallaxOptions())[4:-4, 4:-4], 0.0, atol=1e-6
    )
    blind = Spline(view.coefficients, np.zeros(SHAPE, dtype=np.bool_))
    assert np.isnan(misfit(drawn([view, blind, blind], lines, level)[0], lines, level, None, ParallaxOptions())).all()
