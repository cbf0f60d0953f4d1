"""Shading in the dense method: tones, coarse grids, and heights that get better or stay."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Optics, Poses, TiltSeries, View
from semrecon.dense.coarse_grids import block_sums, corrected, spread
from semrecon.dense.parallax import ParallaxOptions, refined, shared
from semrecon.dense.pictures import prepared
from semrecon.dense.reflectance import Reflectance, brightness, calibrated, less_surroundings, slopes, tones
from semrecon.dense.shading import ShadingOptions, black_level, change_at_half, shaded, stepped
from semrecon.dense.sightlines import sightlines
from semrecon.dense.smoothness import applied, edge_weights
from semrecon.dense.spline import spline_of
from semrecon.dense.synthesis import Linearised, SynthesisOptions, linearised
from semrecon.geometry import rotations_from_tilts

UPRIGHT = np.eye(3)[None]
SHAPE = (96, 128)


def relief(seed: int = 0, *, height: float = 2.0, reach: float = 5.0) -> Array:
    """A rough surface, px."""
    rough = shared(np.random.default_rng(seed).standard_normal(SHAPE), reach).astype(np.float64)
    return np.asarray(rough * height / rough.std())


def plane(across: float, down: float) -> Array:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    return np.asarray(across * x + down * y)


def test_slopes_of_a_plane() -> None:
    across, down = slopes(plane(0.3, -0.2))
    assert_allclose(across[4:-4, 4:-4], 0.3, atol=1e-4)
    assert_allclose(down[4:-4, 4:-4], -0.2, atol=1e-4)


def test_a_plane_has_the_tone_of_the_secant_law() -> None:
    value = tones(plane(0.75, 0.0), UPRIGHT, Reflectance(secant=1.0)).value[30:-30, 30:-30]
    assert_allclose(value, 0.5 * np.log(1.25), atol=1e-4)


def test_a_plane_turned_upright_by_the_stage_has_no_tone() -> None:
    tilt = np.rad2deg(np.arctan(0.2))
    turns = [rotations_from_tilts(np.array([sign * tilt]), 0.0) @ np.diag([1.0, -1, -1]) for sign in (-1, 1)]
    law = Reflectance(secant=1.0)
    centre = [tones(plane(0.2, 0.0), turn, law).value[48, 64] for turn in turns]
    assert min(centre) == pytest.approx(0.0, abs=1e-4)
    assert max(centre) == pytest.approx(-0.5 * np.log(np.cos(2 * np.deg2rad(tilt))), rel=1e-3)


def test_a_steep_place_is_no_brighter_than_the_bound() -> None:
    centre = [tones(plane(slope, 0.0), UPRIGHT, Reflectance(1.0)).value[48, 64] for slope in (4.0, 8.0)]
    assert centre[0] == pytest.approx(centre[1])


def test_the_derivatives_of_the_tone_are_those_of_its_values() -> None:
    law, step = Reflectance(0.6, side=(0.2, -0.3)), 0.01
    turns = Rotation.from_euler("y", [[-12.0], [0.0], [9.0]], degrees=True).as_matrix()

    def value(p: float, q: float) -> float:
        return float(tones(plane(p, q), turns, law).value[48, 64])

    for p, q in ((0.0, 0.0), (0.7, -0.4), (-1.2, 0.9)):
        found = tones(plane(p, q), turns, law)
        across = (value(p + step, q) - value(p - step, q)) / (2 * step)
        down = (value(p, q + step) - value(p, q - step)) / (2 * step)
        assert found.across[48, 64] == pytest.approx(across, abs=2e-4)
        assert found.down[48, 64] == pytest.approx(down, abs=2e-4)


def test_block_sums_keep_the_sum_and_spread_a_constant() -> None:
    picture = relief()[:90, :125]
    assert block_sums(picture, 8).sum() == pytest.approx(picture.sum())
    assert_allclose(spread(np.full((12, 16), 3.0), 8, (90, 125)), 3.0)


def test_spread_is_centred_on_blocks() -> None:
    ramp = plane(1.0, 2.0)
    again = spread(block_sums(ramp, 8) / 64, 8, SHAPE)
    assert_allclose(again[8:-8, 8:-8], ramp[8:-8, 8:-8], atol=1e-9)


def test_coarse_grids_solve_what_fine_steps_alone_do_not() -> None:
    information, weights = np.full(SHAPE, 0.01), edge_weights(np.zeros(SHAPE), 1.0)
    true, room = plane(0.05, 0.1) + relief(reach=12.0), np.zeros((2, *SHAPE))

    def system(z: Array) -> Array:
        return applied(information, weights, z, room)

    right, diagonal = system(true), information + 6 * weights.sum(axis=0)
    errors = []
    for blocks in ((), (32, 16, 8, 4, 2)):
        z = corrected(system, right, information, weights, diagonal, steps=10, blocks_px=blocks)
        errors.append(float(np.abs(z - true).mean() / np.abs(true).mean()))
    assert errors[1] < 0.1
    assert errors[1] < 0.3 * errors[0]


def near(heights: Array, mean: Array, reflectance: Reflectance) -> Linearised:
    everywhere = np.ones(SHAPE, dtype=np.bool_)
    return linearised(mean.astype(np.float32), everywhere, 28.0, heights, reflectance, UPRIGHT, SynthesisOptions())


def test_the_transpose_is_the_transpose() -> None:
    shading = near(relief(1), np.zeros(SHAPE), Reflectance(side=(0.1, -0.05)))
    inner = np.zeros(SHAPE, np.float32)
    inner[24:-24, 24:-24] = 1  # away from the edges of the picture
    z, picture = relief(2) * inner, (relief(3) * inner).astype(np.float32)
    forth, back = np.vdot(shading.change(z), picture), np.vdot(z, shading.transposed(picture))
    assert forth == pytest.approx(back, rel=1e-3)


def test_the_change_is_the_derivative_of_the_residual() -> None:
    law, mean, heights, bump = Reflectance(side=(0.1, -0.05)), np.zeros(SHAPE), relief(1, height=1.0), relief(4)
    step = 1e-2
    residuals = [near(heights + sign * step * bump, mean, law).residual for sign in (-1, 1)]
    numeric = -(residuals[1] - residuals[0]) / (2 * step)
    linear = near(heights, mean, law).change(bump)
    assert np.abs(numeric - linear).mean() < 0.03 * np.abs(linear).mean()


def test_the_side_of_the_detector_is_found() -> None:
    heights = relief(5, height=4.0, reach=9.0)
    bright = np.full(SHAPE, 28.0, np.float32)
    picture = bright * tones(heights, UPRIGHT, Reflectance(side=(-0.08, 0.12))).value
    found = calibrated(picture, bright, np.ones(SHAPE, dtype=np.bool_), heights, UPRIGHT)
    assert found.side == pytest.approx((-0.08, 0.12), abs=0.02)


def photographs(heights: Array, paint: Array, law: Reflectance, dose: float = 200.0) -> TiltSeries:
    """A surface in three views, painted, and shaded as each sees it, with counting noise."""
    from scipy.ndimage import map_coordinates

    turns = rotations_from_tilts(np.array([0.0, 6.0, 12.0]), 0.0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    rng, views = np.random.default_rng(7), []
    for tilt, turn in zip((0.0, 6.0, 12.0), turns, strict=True):
        bright = 2 * np.sqrt(dose) * np.exp(tones(heights, (turn @ turns[0].T)[None], law).value + paint)
        c, s = np.cos(np.deg2rad(tilt)), np.sin(np.deg2rad(tilt))
        middle, source = (SHAPE[1] - 1) / 2, x.copy()
        for _ in range(30):  # the column of the reference view that lands on this one
            source = middle + (x - middle - s * map_coordinates(heights, [y, source], order=1, mode="nearest")) / c
        seen = map_coordinates(bright, [y, source], order=3, mode="nearest")
        views.append(View(rng.poisson(seen**2 / 4).astype(np.uint16), tilt, f"view{tilt:g}"))
    return TiltSeries(tuple(views), Optics(1.0, SHAPE[1], SHAPE[0]), 0.0)


def median_errors(heights: Array, paint: Array, law: Reflectance) -> tuple[float, float]:
    """Median error by parallax alone and with shading, from heights that lack their detail."""
    series = photographs(heights, paint, law)
    poses = Poses(rotations_from_tilts(series.tilts_deg, 0.0), np.zeros((3, 3)))
    lines = sightlines(poses, np.tile(np.eye(2), (3, 1, 1)), series.optics, 0)
    pictures = [prepared(view) for view in series.views]
    splines = [spline_of(picture) for picture in pictures]
    start = shared(heights, 3.0).astype(np.float64) + relief(9, height=0.5)
    plain = refined(splines, lines, start, 1.0, ParallaxOptions())
    found = shaded(series, pictures, lines, plain, ParallaxOptions(), ShadingOptions()).heights
    errors = [(each - heights)[16:-16, 16:-16] for each in (plain, found)]
    first, second = (float(np.median(np.abs(error - np.median(error)))) for error in errors)
    return first, second


def test_shading_brings_out_detail() -> None:
    plain, found = median_errors(relief(1, height=2.0, reach=2.5), np.zeros(SHAPE), Reflectance(side=(0.05, 0.1)))
    assert found < 0.8 * plain


def test_a_tone_does_not_depend_on_the_size_of_the_picture() -> None:
    heights, law = relief(4, height=4.0, reach=12.0), Reflectance(side=(0.1, -0.05))
    half = tones(shared(heights, 0.5).astype(np.float64)[::2, ::2] / 2, UPRIGHT, law.at_level(1)).value
    whole = tones(heights, UPRIGHT, law).value[::2, ::2]
    assert_allclose(half[8:-8, 8:-8], whole[8:-8, 8:-8], atol=0.1 * whole.std())


def test_steps_at_half_the_size_find_what_is_wide() -> None:
    heights = relief(1, height=0.5, reach=5.0)
    series = photographs(heights, relief(8, height=0.1, reach=1.5), Reflectance(secant=1.0))
    poses = Poses(rotations_from_tilts(series.tilts_deg, 0.0), np.zeros((3, 3)))
    lines = sightlines(poses, np.tile(np.eye(2), (3, 1, 1)), series.optics, 0)
    pictures, black = [prepared(view) for view in series.views], black_level(series)
    assert black is not None
    start = heights + relief(3, height=1.5, reach=10.0)
    change = change_at_half(
        pictures, lines, start, Reflectance(), black, ParallaxOptions(), ShadingOptions(rounds_at_half=8)
    )
    before, after = ((one - heights)[16:-16, 16:-16].std() for one in (start, start + change))
    assert after < 0.5 * before


def test_steps_with_momentum_arrive_sooner() -> None:
    lines = sightlines(
        Poses(rotations_from_tilts(np.array([0.0, 6.0]), 0.0), np.zeros((2, 3))),
        np.tile(np.eye(2), (2, 1, 1)),
        Optics(1.0, SHAPE[1], SHAPE[0]),
        0,
    )
    goal = relief(2, height=0.5)
    left = [
        np.abs(stepped(lambda z: 0.1 * (goal - z), lines, np.zeros(SHAPE), 10, momentum) - goal).mean()
        for momentum in (0.0, 0.5)
    ]
    assert left[1] < 0.6 * left[0]


def test_paint_is_not_taken_for_relief() -> None:
    plain, found = median_errors(0.2 * plane(1.0, 0.5), relief(8, height=0.1, reach=2.0), Reflectance())
    assert found < 1.1 * plain


def test_the_black_level_makes_counts_of_grey_values() -> None:
    ramp = np.tile(np.linspace(50.0, 400.0, 512), (384, 1))
    counts = np.random.default_rng(3).poisson(ramp)
    grey = np.rint(20.0 + 3.0 * counts).astype(np.uint16)
    series = TiltSeries((View(grey, 0.0), View(grey, 5.0)), Optics(1.0, 512, 384), 0.0)
    level = black_level(series)
    assert level is not None
    stabilised = prepared(series.views[0]).values[:, 250:260].mean() + level
    assert stabilised == pytest.approx(2 * np.sqrt(ramp[0, 255]), rel=0.06)


def test_noise_that_does_not_grow_leaves_the_heights_alone() -> None:
    rng, ramp = np.random.default_rng(0), np.tile(np.linspace(0.0, 1.0, SHAPE[1]), (SHAPE[0], 1))
    pictures = [np.rint(1000 + 400 * ramp + rng.normal(0, 9 - 6 * ramp)).astype(np.uint16) for _ in range(2)]
    series = TiltSeries(tuple(View(p, t) for p, t in zip(pictures, (0.0, 5.0), strict=True)), Optics(1.0, 128, 96), 0.0)
    assert black_level(series) is None
    poses = Poses(rotations_from_tilts(series.tilts_deg, 0.0), np.zeros((2, 3)))
    lines = sightlines(poses, np.tile(np.eye(2), (2, 1, 1)), series.optics, 0)
    start = relief(0)
    found = shaded(series, [prepared(view) for view in series.views], lines, start, ParallaxOptions(), ShadingOptions())
    assert_allclose(found.heights, start)
    assert not found.trust.any()


def test_surroundings_of_a_constant_are_itself() -> None:
    seen = relief(2) > 0
    assert_allclose(less_surroundings(np.full(SHAPE, 7.0, np.float32), seen, 4.0), 0.0, atol=1e-4)


def test_brightness_is_never_zero() -> None:
    assert (brightness(np.full(SHAPE, -50.0, np.float32), 28.0, 8.0) > 0).all()
