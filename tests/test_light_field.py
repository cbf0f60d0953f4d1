"""Claims on the light field: a sliding specimen is measured with perspective, refused without."""

from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.adapt import series_from_capture
from semrecon.data import Optics, TiltSeries, View
from semrecon.dense.epipolar_plane import SlopeOptions, stage_sightlines
from semrecon.dense.slope_trust import found_again, off_centre, stated_sigma
from semrecon.errors import MethodError
from semrecon.geometry import project
from semrecon.judging.gauge import gauge_residual
from semrecon.methods.light_field import LightField
from semsim.capture import simulate
from semsim.scene import scaled
from semsim.scenes import scene

OPTICS = Optics(1.0, 200, 150, 1 / 1500)
STEPS = np.array([[-40.0, 0.0], [-20.0, 0.0], [0.0, 0.0], [20.0, 0.0], [40.0, 0.0]])
SLOPE, NOISE = (0.25, -0.15), 4.0


def rendered(stage_um, *, optics=OPTICS, noise=NOISE, seed=0, bump_um=0.0):
    """Pictures of a painted surface ``z = a x + b y + bump`` in perspective: each pixel's beam is followed to it."""
    rng = np.random.default_rng(seed)
    paint = ndimage.gaussian_filter(rng.normal(size=(500, 500)), 1.3)
    paint = ndimage.spline_filter(120 + 35 * paint / paint.std())
    columns, rows = np.meshgrid(np.arange(optics.width_px), np.arange(optics.height_px))
    away = (np.stack([columns, rows], axis=-1) - optics.centre_px) * optics.pixel_size_um
    views = []
    for i, stage in enumerate(stage_um):
        z = np.zeros(optics.shape)
        for _ in range(40):
            x, down = np.moveaxis(away * (1 - optics.inverse_working_distance * z)[..., None] - stage, 2, 0)
            z = height_um(x, -down, bump_um)
        at = np.stack([down, x]) / optics.pixel_size_um + 250
        image = ndimage.map_coordinates(paint, at, order=3, prefilter=False) + rng.normal(0, noise, optics.shape)
        views.append(View(image, 0.0, f"slide_{i}.tif", stage_um=tuple(stage)))
    return TiltSeries(tuple(views), optics)


def height_um(x, y, bump_um=0.0):
    return SLOPE[0] * x + SLOPE[1] * y + bump_um * np.exp(-(x**2 + y**2) / (2 * 25.0**2))


@lru_cache
def slid():
    return rendered(STEPS)


def answer(series, **options):
    return LightField(**options)(series, rng=np.random.default_rng(0))


@lru_cache
def found():
    return answer(slid())


def errors_um(points, bump_um=0.0):
    """Errors with the median taken off; the frame is that of the reference view, the first, 40 um along the path."""
    error = points.xyz_um[:, 2] - height_um(points.xyz_um[:, 0] - STEPS[0, 0], points.xyz_um[:, 1], bump_um)
    return error - np.median(error)


def test_a_speckled_plane_comes_back():
    """Median error of 0.01 to 0.05 px of motion over the path, slopes to 0.005, sigma that of the errors."""
    points, um_a_px = found().points, found().diagnostics["um_a_px"]
    error = errors_um(points)
    assert len(points) > 0.6 * 200 * 150
    assert 0.01 < np.median(np.abs(error)) / um_a_px < 0.05
    assert 0.6 < 1.4826 * np.median(np.abs(error) / points.sigma_um) < 1.3
    design = np.column_stack([points.xyz_um[:, :2], np.ones(len(points))])
    fitted = np.linalg.lstsq(design, points.xyz_um[:, 2], rcond=None)[0]
    np.testing.assert_allclose(fitted[:2], SLOPE, atol=0.005)


def test_a_pixel_of_motion_is_worth_what_the_formula_says():
    """A path of 80 um at 1.5 mm: ``pixel / (k * path)`` = 1 um * 1500 / 80."""
    assert found().diagnostics["um_a_px"] == pytest.approx(1500 / 80, rel=1e-3)


def test_without_noise_little_is_left():
    estimate = answer(rendered(STEPS, noise=0.0, bump_um=25.0))
    error = errors_um(estimate.points, 25.0)
    assert np.median(np.abs(error)) < 0.03 * estimate.diagnostics["um_a_px"]
    assert len(estimate.points) > 0.6 * 200 * 150


@pytest.mark.parametrize(
    "turn", [np.array([[0, 1], [1, 0]]), np.array([[-1, 0], [0, -1]]), np.array([[0.8, 0.6], [0.6, -0.8]])]
)
def test_the_direction_of_the_path_does_not_matter(turn):
    estimate = answer(rendered(STEPS @ turn.T))
    error = np.median(np.abs(errors_um(estimate.points)))
    assert error == pytest.approx(np.median(np.abs(errors_um(found().points))), rel=0.35)


def test_a_wrong_stage_position_is_noticed_and_put_right():
    series = slid()
    lied = replace(series.views[3], stage_um=(21.4, -0.9))
    estimate = answer(replace(series, views=(*series.views[:3], lied, *series.views[4:])))
    correction = estimate.diagnostics["stage_correction_px"] - found().diagnostics["stage_correction_px"]
    true = np.zeros((5, 2))
    true[3] = [-1.4, 0.9]
    path = np.column_stack([np.ones(5), STEPS[:, 0]])  # what grows along the path is the offset of the heights
    left = [one - path @ np.linalg.lstsq(path, one, rcond=None)[0] for one in (correction, true)]
    np.testing.assert_allclose(*left, atol=0.08)
    assert np.median(np.abs(errors_um(estimate.points))) < 0.05 * estimate.diagnostics["um_a_px"]


def test_points_and_poses_belong_together():
    """A point is seen by every view where the painted surface at the same pixel of the reference view is."""
    estimate, view = found(), 4
    points, poses = estimate.points, estimate.poses
    back = project(points.xyz_um, poses.rotations[0], poses.translations_um[0], OPTICS)
    np.testing.assert_allclose(back, points.xy_px, atol=1e-9)
    # where the beam of the reference pixel truly meets the plane
    away = (points.xy_px - OPTICS.centre_px) * [1.0, -1.0]
    shift = STEPS[0] * [1.0, -1.0]
    z = (away @ SLOPE - shift @ SLOPE) / (1 + away @ SLOPE / 1500)
    true = np.column_stack([away * (1 - z / 1500)[:, None] - shift, z])
    stage = np.append(STEPS[view], 0.0)
    expected = project(true, poses.rotations[0], stage, OPTICS)
    got = project(points.xyz_um, poses.rotations[view], poses.translations_um[view], OPTICS)
    assert np.median(np.linalg.norm(got - expected, axis=1)) < 0.1


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: replace(s, optics=replace(s.optics, inverse_working_distance=0.0)), "no parallax"),
        (
            lambda s: replace(s, views=(replace(s.views[0], stage_um=None), *s.views[1:])),
            "stage position of every view",
        ),
        (lambda s: replace(s, views=(replace(s.views[0], tilt_deg=3.0), *s.views[1:])), "one tilt"),
        (lambda s: replace(s, views=tuple(replace(v, stage_um=(7.0, 7.0)) for v in s.views)), "does not move"),
        (lambda s: s.select(0, 1), "three views"),
    ],
)
def test_what_cannot_be_is_said(change, sentence):
    with pytest.raises(MethodError, match=sentence):
        answer(change(slid()))


def test_the_answer_is_the_same_again_and_the_input_stays():
    before = [view.image.copy() for view in slid().views]
    again = answer(slid())
    assert np.array_equal(again.heights.z_um, found().heights.z_um, equal_nan=True)
    assert all(np.array_equal(a, view.image) for a, view in zip(before, slid().views, strict=True))


@pytest.mark.parametrize("spoiled", ["black", "saturated", "equal", "small", "rows"])
def test_bad_views_are_answered_or_refused_in_a_sentence(spoiled):
    series = slid()
    images = [view.image.copy() for view in series.views]
    if spoiled in {"black", "saturated"}:
        images[1] = np.full_like(images[1], 0 if spoiled == "black" else 255)
    elif spoiled == "equal":
        images = [images[0].copy() for _ in images]
    elif spoiled == "small":
        images = [np.ascontiguousarray(image[43:107, 68:132]) for image in images]
    else:
        images[1][30] = np.nan
    views = tuple(replace(view, image=image) for image, view in zip(images, series.views, strict=True))
    optics = replace(series.optics, height_px=images[0].shape[0], width_px=images[0].shape[1])
    with suppress(MethodError) if spoiled in {"equal", "small"} else nullcontext():
        estimate = answer(replace(series, views=views, optics=optics))
        assert np.isfinite(estimate.points.xyz_um).all()
        if spoiled != "equal":
            assert np.median(np.abs(errors_um(estimate.points))) < 0.1 * estimate.diagnostics["um_a_px"]


def test_beside_a_lone_edge_the_height_is_that_of_the_edge():
    """Closed form: all information in one column lies as far aside as the column is; evenly spread, nowhere."""
    weight = np.full((60, 60), 1e-9)
    weight[:, 30] = 1.0
    aside = off_centre(weight, 3.0)
    np.testing.assert_allclose(aside[20:40, 24:37], np.abs(np.arange(24, 37) - 30.0)[None] * np.ones((20, 1)), atol=0.1)
    assert off_centre(np.ones((60, 60)), 3.0)[20:40, 20:40].max() < 1e-6


def test_sigma_is_that_of_noise_on_a_plane_and_more_on_relief():
    """Averaged noise on any plane is stated as it is, to a third; a ridge as high as the window is wide is not."""
    rng = np.random.default_rng(8)
    rough = ndimage.gaussian_filter(rng.normal(size=(200, 200)), 3.0)
    noise = np.full(rough.shape, rough.std())
    column = np.arange(200.0)
    even = {"window_px": 3.0, "relief": 3.5, "aside": 2.8}
    plane = stated_sigma(rough + 0.4 * column, noise, np.full(rough.shape, 0.5), **even)
    level = stated_sigma(rough, noise, np.full(rough.shape, 0.5), **even)
    inner = np.s_[40:-40, 40:-40]
    assert np.sqrt(np.mean(plane[inner] ** 2)) == pytest.approx(np.sqrt(np.mean(level[inner] ** 2)), rel=0.05)
    assert 1.0 <= np.sqrt(np.mean(level[inner] ** 2)) / rough.std() < 1.5
    ridge = stated_sigma(rough + 3.0 * np.exp(-((column - 100) ** 2) / 18), noise, np.zeros(rough.shape), **even)
    assert np.median(ridge[:, 100]) > 1.0


def test_a_height_that_the_other_end_does_not_find_is_refuted():
    """What is 1 px of motion away is; half of that is not; what the other view has no picture of is not judged."""
    lines = stage_sightlines(slid(), STEPS)
    heights = np.zeros(OPTICS.shape)
    a_px = 1500 / 80  # um of height, and px, for a pixel of motion over the path
    for apart, agreed in ((0.5 * a_px, True), (1.5 * a_px, False), (-1.5 * a_px, False)):
        again = found_again(heights, heights + apart, lines, 4, 1.0)
        assert again[:, :115].all() == agreed
        assert again[:, 121:].all()  # moved by 80 px, these have left the picture


def test_paint_of_its_own_in_one_view_is_left_out_of_it():
    """A speck of dust that lies in front of the middle view alone: the others still measure what is behind."""
    series = rendered(STEPS)
    images = [view.image.copy() for view in series.views]
    images[2][60:80, 100:120] = 250 + np.random.default_rng(3).normal(0, NOISE, (20, 20))
    views = tuple(replace(view, image=image) for view, image in zip(series.views, images, strict=True))
    dusty = replace(series, views=views)
    hidden, believed = (answer(dusty, slopes=SlopeOptions(occluded=o)) for o in (3.0, 1e9))
    behind = np.s_[62:78, 63:77]  # the reference, 40 um along the path, has the place 40 px to the left, less parallax

    def wrong(estimate):
        error = estimate.heights.z_um - found().heights.z_um
        return float(np.nanmean(np.abs(error[behind]))), float(np.isfinite(error[behind]).mean())

    (error, share), (error_believed, share_believed) = wrong(hidden), wrong(believed)
    assert share == 1.0
    assert error < 0.1 * error_believed
    assert share_believed < 0.95


@pytest.mark.slow
@pytest.mark.parametrize("grains", [21, 22, 23])
def test_sigma_is_right_on_grains(grains):
    """Two-sided: of the heights 0.55 to 0.8 lie within one sigma of the truth and 0.8 to 0.96 within two."""
    named = scaled(scene("translation"), 0.5)
    capture = simulate(replace(named, specimen_seed=grains), np.random.default_rng(grains))
    series, truth = series_from_capture(capture), capture.truth
    estimate = answer(series).heights
    others = sum(truth.visible(v, truth.buffers[0].position_um).astype(int) for v in range(1, len(series)))
    true = np.where(others >= 2, truth.height_map(0), np.nan)
    error = gauge_residual(estimate.z_um, true, ("offset",), None, "absolute")
    ratio = (np.abs(error) / estimate.sigma_um)[np.isfinite(error)]
    assert 0.55 < np.mean(ratio <= 1) < 0.8
    assert 0.8 < np.mean(ratio <= 2) < 0.96


@pytest.mark.slow
def test_the_sliding_scene_is_measured():
    """Sand grains at half size, path 250 px, 20 um of height a px: shading that travels with the beam leaves 0.4 px."""
    capture = simulate(scaled(scene("translation"), 0.5), np.random.default_rng(11))
    series, truth = series_from_capture(capture), capture.truth
    heights = answer(series).heights.z_um
    others = sum(truth.visible(v, truth.buffers[0].position_um).astype(int) for v in range(1, len(series)))
    error = gauge_residual(np.where(others >= 2, heights, np.nan), truth.height_map(0), ("offset",), None, "absolute")
    assert 3.0 < np.nanmedian(np.abs(error)) < 12.0
    assert np.isfinite(error).sum() > 0.65 * (others >= 2).sum()
