"""Claims on cameras from grey values: exact elimination, honest errors, a stage that holds or yields."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from semrecon.adjustment.camera_model import LOCAL, Cameras, sightings_and_derivatives
from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.adjustment.tone_kernel import CAUCHY
from semrecon.adjustment.tones import Drawn, Stage, ToneEquations, combined, tone_equations
from semrecon.data import Optics, TiltSeries, View
from semrecon.dense.parallax import ParallaxOptions
from semrecon.dense.pictures import prepared
from semrecon.dense.sightlines import sightlines
from semrecon.dense.spline import spline_of
from semrecon.matches.correspondence import CorrespondenceOptions
from semrecon.methods.cameras_from_tones import moved_along, with_tones
from semrecon.pose.alignment import align

TILTS = np.deg2rad([0.0, 4.0, 8.0, 12.0])
ROWS, COLUMNS = 40, 70


def cameras(k=0.0):
    rng = np.random.default_rng(1)
    turns = np.append(0.0, rng.normal(0, 0.01, 3))
    logs, shifts = np.append(0.0, rng.normal(0, 0.01, 3)), np.vstack([[0.0, 0.0], rng.normal(0, 0.3, (3, 2))])
    return Cameras(TILTS, 0.2, logs, turns, shifts), Optics(0.2, COLUMNS, ROWS, k)


def pictures(seed=0):
    """Noise of one unit on nothing, with gradients as large as those of micrographs, and some places unseen."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(4, ROWS, COLUMNS)).astype(np.float32)
    values[3, :5], values[1:, -4:] = np.nan, np.nan
    gradient = rng.normal(0, 2.0, (2, ROWS, COLUMNS)).astype(np.float32)
    weight = rng.uniform(0.2, 1.0, (ROWS, COLUMNS)).astype(np.float32)
    return Drawn(values, gradient, weight, 3 * gaussian_filter(rng.normal(size=(ROWS, COLUMNS)), 2.0))


def by_least_squares(drawn, cams, optics):
    """Reduced matrix and right-hand side, pixel by pixel, by a full least squares with brightness and height free."""
    size, pixel = LOCAL * len(cams) + 1, optics.pixel_size_um
    matrix, right = np.zeros((size, size)), np.zeros(size)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    k, h = optics.inverse_working_distance, drawn.heights * pixel
    flat = np.stack([x - optics.centre_px[0], y - optics.centre_px[1]], axis=-1) * pixel * (1 - k * h)[..., None]
    poses = cams.poses
    beam = np.concatenate([flat, -h[..., None]], axis=-1) - poses.translations_um[0]
    xyz = (beam @ poses.rotations[0]).reshape(-1, 3)
    _, by_point, by_camera = sightings_and_derivatives(xyz, cams, k)
    gradient = drawn.gradient.reshape(2, -1).T / pixel
    for i in range(len(xyz)):
        seen = np.flatnonzero(np.isfinite(drawn.values.reshape(4, -1)[:, i]))
        if len(seen) < 3:
            continue
        value = drawn.values.reshape(4, -1)[seen, i].astype(float)
        weight = drawn.weight.ravel()[i] / (1 + ((value - value.mean()) / CAUCHY) ** 2)
        design = np.zeros((len(seen), size))
        for row, view in enumerate(seen):
            slope = gradient[i] @ by_camera[i, view]
            design[row, view * LOCAL : (view + 1) * LOCAL], design[row, -1] = slope[:LOCAL], slope[LOCAL]
        height = -(by_point[i, seen] @ poses.rotations[0, 2]) @ gradient[i]
        own = np.column_stack([np.ones(len(seen)), height])
        root = np.sqrt(weight)[:, None]
        left = np.eye(len(seen)) - (root * own) @ np.linalg.pinv(root * own)
        matrix += (root * design).T @ left @ (root * design)
        right += (root * design).T @ left @ (-root[:, 0] * value)
    return matrix, right


@pytest.mark.parametrize("k", [0.0, 2e-3])
def test_brightness_and_height_of_every_pixel_are_eliminated_exactly(k):
    cams, optics = cameras(k)
    found = tone_equations(pictures(), cams, 0, optics)
    matrix, right = by_least_squares(pictures(), cams, optics)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    np.testing.assert_allclose(found.matrix / np.outer(scale, scale), matrix / np.outer(scale, scale), atol=2e-5)
    np.testing.assert_allclose(found.right / scale, right / scale, atol=2e-3)


def test_brightness_in_proportion_to_parallax_tells_nothing():
    """What a pixel shows may be anything, and change with tilt as if it moved along: the equations ask for nothing."""
    cams, optics = cameras()
    cams = replace(cams, axis_rad=0.0, turns_rad=np.zeros(4), log_magnifications=np.zeros(4))
    rng = np.random.default_rng(2)
    level, change = rng.normal(size=(2, ROWS, COLUMNS))
    drawn = pictures()
    values = 0.1 * (level + change * np.sin(TILTS)[:, None, None])
    found = tone_equations(replace(drawn, values=values.astype(np.float32)), cams, 0, optics)
    noise = tone_equations(drawn, cams, 0, optics)
    assert np.abs(found.right).max() < 1e-3 * np.abs(noise.right).max()


def test_the_right_hand_side_scatters_by_the_information():
    """Noise of one unit: variance of the right-hand side is the matrix, and the tiles see it so."""
    cams, optics = cameras()
    tilts = np.arange(LOCAL + 2, LOCAL * 4, LOCAL)
    ratio, excess = [], []
    for seed in range(150):
        drawn = pictures(seed)
        found = tone_equations(replace(drawn, weight=np.ones((ROWS, COLUMNS), np.float32)), cams, 0, optics)
        ratio.append(found.right[tilts] ** 2 / np.diag(found.matrix)[tilts])
        excess.append(np.diag(found.scatter)[tilts] / np.diag(found.matrix)[tilts])
    assert 0.7 < np.mean(ratio) < 1.2  # robust weights take some 10 % off
    assert 0.5 < np.mean(excess) < 1.4


def test_a_step_over_every_other_pixel_stands_for_all_of_them():
    cams, optics = cameras()
    every, other = (tone_equations(replace(pictures(), step=step), cams, 0, optics) for step in (1, 2))
    tilts = np.arange(LOCAL + 2, LOCAL * 4, LOCAL)
    np.testing.assert_allclose(other.matrix[tilts, tilts], every.matrix[tilts, tilts], rtol=0.15)


def far_off(information, stated_deg=0.25, sigma_deg=0.1):
    """Tilt of one view, deg, that the images put at 0 with so much information (rad^-2), and the stage elsewhere."""
    cams = Cameras(np.zeros(2), 0.0, np.zeros(2), np.zeros(2), np.zeros((2, 2)))
    matrix, variance = np.zeros((11, 11)), np.zeros((11, 11))
    matrix[7, 7], variance[7, 7] = information, np.deg2rad(1.0) ** 2
    stage = Stage(np.deg2rad([0.0, stated_deg]), np.deg2rad(sigma_deg))
    found = cams
    for _ in range(50):
        equations = ToneEquations(matrix, matrix @ (cams.vector - found.vector), matrix)
        found, spread = combined(equations, stage, found, cams, variance)
    assert np.count_nonzero(found.vector) <= 1  # what is held stays
    assert np.count_nonzero(spread) == 1
    return np.rad2deg(found.tilts_rad[1])


def test_the_stage_holds_where_images_say_little_and_yields_where_they_are_sure():
    sure, unsure = 1 / np.deg2rad(0.03) ** 2, 1 / np.deg2rad(0.5) ** 2
    assert 0.0 < far_off(sure) < 0.01
    assert 0.2 < far_off(unsure) < 0.25
    assert far_off(0.0, sigma_deg=0.05) == pytest.approx(0.25, abs=0.01)


@cache
def rugged(tilts_deg=(0.0, 5.0, 10.0, 15.0), rows=200, columns=260):
    """A painted relief photographed in parallel projection, noise of one grey level, and its heights, px."""
    rng = np.random.default_rng(8)
    wide = (rows + 80, columns + 80)
    relief = 8 * gaussian_filter(rng.normal(size=wide), 12.0) * 12
    paint = gaussian_filter(rng.normal(size=wide), 1.5)
    paint = 110 + 25 * paint / paint.std()
    y, x = np.mgrid[:rows, :columns].astype(float)
    middle = (columns - 1) / 2
    views = []
    for number, tilt in enumerate(np.deg2rad(tilts_deg)):
        here = x.copy()
        for _ in range(60):  # fixed point of (x - middle) cos + z sin = seen
            z = map_coordinates(relief, [y + 40, here + 40], order=3)
            here = middle + ((x - middle) - z * np.sin(tilt)) / np.cos(tilt)
        image = map_coordinates(paint, [y + 40, here + 40], order=5)
        noisy = image + rng.normal(size=image.shape)
        views.append(View(noisy.round().clip(0, 255), float(np.rad2deg(tilt)), f"view {number}"))
    return TiltSeries(tuple(views), Optics(0.2, columns, rows)), relief[40:-40, 40:-40]


def refined_tilts(stated_deg, options=None):
    series, relief = rugged()
    series = replace(series, views=tuple(replace(v, tilt_deg=t) for v, t in zip(series.views, stated_deg, strict=True)))
    options = options or RefinementOptions()
    aligned = align(series, CorrespondenceOptions(), options, np.random.default_rng(0))
    splines = [spline_of(prepared(view)) for view in series.views]
    return aligned, *with_tones(series, aligned, splines, relief, ParallaxOptions(), options.tilt_sigma_deg)


@pytest.mark.parametrize("off_deg", [(0, -0.25, 0.25, -0.25), (0, 0.083, 0.167, 0.25)])
def test_tilts_come_back_within_their_standard_deviations(off_deg):
    true = np.array([0.0, 5.0, 10.0, 15.0])
    _, found, _ = refined_tilts(tuple(true + off_deg))
    error = found.tilts_deg - found.tilts_deg[0] - true
    assert np.abs(error).max() < 0.03
    np.testing.assert_allclose(found.diagnostics["tilts_deg"], found.tilts_deg)
    assert found.points is not None
    assert np.median(found.points.residual_px) < 0.5


def test_nothing_changes_where_tilts_are_held_or_two_views_are_all():
    aligned, found, heights = refined_tilts((0.0, 5.1, 10.0, 15.0), RefinementOptions(tilts=False))
    assert found is aligned
    np.testing.assert_array_equal(heights, rugged()[1])
    pair = rugged()[0].select(0, 3)
    aligned = align(pair, CorrespondenceOptions(), RefinementOptions(), np.random.default_rng(0))
    splines = [spline_of(prepared(view)) for view in pair.views]
    assert with_tones(pair, aligned, splines, rugged()[1], ParallaxOptions(), 0.1)[0] is aligned


def test_tiles_that_contradict_one_another_are_told_from_noise():
    """Every other tile has bent pictures one way, its neighbours the other way: no tilt is as uncertain as that."""
    cams, optics = cameras()
    drawn, bend = pictures(), np.array([1.0, -1.0, -1.0, 1.0])
    sign = np.where((np.arange(ROWS)[:, None] // 32 + np.arange(COLUMNS) // 32) % 2, 0.3, -0.3)
    bent = drawn.values + bend[:, None, None] * sign * drawn.gradient[0]
    assert tone_equations(drawn, cams, 0, optics).excess < 2
    assert tone_equations(replace(drawn, values=bent.astype(np.float32)), cams, 0, optics).excess > 5


def test_silent_equations_leave_what_was_known():
    cams, optics = cameras()
    equations = tone_equations(pictures(), cams, 0, optics)
    silent = equations.silent()
    assert silent.excess == 1
    covariance = np.diag(np.r_[np.tile([0.01, 0.01, 1e-6, 1e-6, 1e-6], 4), 1e-6])
    found, spread = combined(silent, Stage(TILTS, 1e3), cams, cams, covariance)
    np.testing.assert_allclose(found.vector, cams.vector, atol=1e-12)
    np.testing.assert_allclose(spread, covariance, rtol=1e-6)


def test_where_the_tiles_contradict_one_another_stage_and_features_share_the_say(monkeypatch):
    """The features know better than the stage here, but nobody can tell: 0.2 degrees against 0.1, with a long tail."""
    monkeypatch.setattr("semrecon.methods.cameras_from_tones.MOST_EXCESS", 0.5)
    stated = np.array([0.0, 5.1, 10.0, 15.0])
    aligned, kept, _ = refined_tilts(tuple(stated))
    assert kept.diagnostics["tone_excess"] >= 1
    apart = [each.tilts_deg[1] - each.tilts_deg[[0, 2]].mean() for each in (aligned, kept)]
    assert 0.03 < apart[1] < 0.1
    assert apart[0] < apart[1] - 0.02
    assert kept.diagnostics["tilt_sigma_deg"][1] > 0.05


def test_places_that_views_show_differently_have_no_say(monkeypatch):
    """A third of the middle views is stretched, as wrong tilts would have it but by pixels: it lies somewhere else."""
    series, relief = rugged()
    aligned = align(series, CorrespondenceOptions(), RefinementOptions(), np.random.default_rng(0))
    views = list(series.views)
    for number in (1, 2):
        image = views[number].image.astype(float)
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        middle = (image.shape[1] - 1) / 2
        stretched = map_coordinates(image, [y, x - 4 * (x - middle) / middle], order=3, mode="nearest")
        image[: len(image) // 3] = stretched[: len(image) // 3]
        views[number] = replace(views[number], image=image.round().clip(0, 255))
    spoiled = [spline_of(prepared(view)) for view in views]

    def refined_again():
        return with_tones(series, aligned, spoiled, relief, ParallaxOptions(), 0.1)[0]

    found = refined_again()
    assert found.diagnostics["tone_excess"] < 2
    assert np.abs(found.tilts_deg - found.tilts_deg[0] - [0, 5, 10, 15]).max() < 0.06
    monkeypatch.setattr("semrecon.methods.cameras_from_tones.APART", 1e9)
    assert refined_again().diagnostics["tone_excess"] > 10


def test_heights_move_along_with_the_cameras():
    """Tilts that were a hundredth too large made depth a hundredth too small: the pictures of the surface stay."""
    relief, optics = rugged()[1], rugged()[0].optics
    none = np.zeros(4)
    right = Cameras(TILTS, 0.0, none, none, np.zeros((4, 2)))
    wrong = replace(right, tilts_rad=1.01 * TILTS)
    lines = [sightlines(each.poses, each.distortions, optics, 0) for each in (wrong, right)]
    moved = moved_along(relief, *lines)
    x, y = np.meshgrid(np.arange(relief.shape[1]), np.arange(relief.shape[0]))
    design = np.stack([relief, x, y, np.ones_like(relief)], axis=-1).reshape(-1, 4)  # the plane tips as well
    assert np.linalg.lstsq(design, moved.ravel(), rcond=None)[0][0] == pytest.approx(1.01, abs=0.002)
    np.testing.assert_allclose(moved_along(moved, *lines[::-1]), relief, atol=0.02)
