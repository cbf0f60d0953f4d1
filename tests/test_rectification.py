"""Claims on dense disparity: rectified rows match rows, sub-pixel shifts come back, and the surface with them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import ndimage

from semrecon.data import Array, Estimate, Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import project, rotations_from_tilts
from semrecon.matches.dense_pair import interpolated
from semrecon.matches.epipolar import epipolar_geometry
from semrecon.matches.rectification import disparity_of, inverted, rectify, resampled
from semrecon.matches.semiglobal import SemiGlobalOptions, match_rows
from semrecon.methods.disparity import Disparity, DisparityIcp

OPTICS = Optics(0.1, 200, 160)
AXES = pytest.mark.parametrize("axis_deg", [0.0, 90.0, 30.0, -120.0])


def height_um(x: Array, y: Array) -> Array:
    """A dome of 3 um with ripples, 20 um across; no slope beyond 0.8."""
    return 3 * np.exp(-(x**2 + 1.3 * y**2) / 40) + 0.2 * np.sin(1.1 * x + 0.4) * np.cos(0.9 * y) - 1.0


@lru_cache
def photographed(axis_deg: float = 0.0, tilts_deg: tuple[float, ...] = (0.0, 8.0), noise: float = 4.0) -> TiltSeries:
    """Pictures of a painted surface: every pixel's ray is followed to the surface, whose paint is a B-spline."""
    rng = np.random.default_rng(0)
    paint = ndimage.gaussian_filter(rng.normal(size=(400, 400)), 1.5)
    paint = 120 + 40 * paint / paint.std()
    pixels = np.stack(np.indices(OPTICS.shape)[::-1], axis=-1)
    views = []
    for i, rotation in enumerate(rotations_from_tilts(np.asarray(tilts_deg), axis_deg)):
        camera = (pixels - OPTICS.centre_px - np.array([4.25, -6.5]) * i) * OPTICS.pixel_size_um
        flat, z = np.linalg.inv(rotation[:2, :2]), np.zeros(OPTICS.shape)
        for _ in range(30):
            xy = (camera - z[..., None] * rotation[:2, 2]) @ flat.T
            z = height_um(xy[..., 0], xy[..., 1])
        image = ndimage.map_coordinates(paint, [xy[..., 1] / 0.08 + 200, xy[..., 0] / 0.08 + 200], order=5)
        views.append(View(image + rng.normal(0, noise, OPTICS.shape), tilts_deg[i], f"view_{i}.tif"))
    return TiltSeries(tuple(views), OPTICS, axis_deg)


def answer(method: Disparity | DisparityIcp, series: TiltSeries) -> Estimate:
    return method(series, rng=np.random.default_rng(1))


def depth_error(estimate: Estimate) -> Array:
    x, y, z = estimate.points.xyz_um.T
    error = z - height_um(x, y)
    return error - np.median(error)


@AXES
@pytest.mark.parametrize("tilts", [(0.0, 10.0), (12.0, 4.0)])
def test_matches_fall_on_one_row_and_their_disparity_is_the_depth(axis_deg: float, tilts: tuple[float, float]) -> None:
    rotations = rotations_from_tilts(np.array(tilts), axis_deg)
    xyz = np.random.default_rng(0).uniform(-6, 6, (300, 3))
    first = project(xyz, rotations[0], np.zeros(3), OPTICS)
    second = project(xyz, rotations[1], np.array([0.7, -0.4, 0.0]), OPTICS)
    epipolar = epipolar_geometry(*rotations, OPTICS.centre_px)
    across = epipolar.offsets_px(first, second)[:, 0]
    np.testing.assert_allclose(across, across[0], atol=1e-9)
    frames = rectify(epipolar, OPTICS.shape, float(across[0]), (-20.0, 30.0))
    np.testing.assert_allclose(frames.to_left(first)[:, 1], frames.to_right(second)[:, 1], atol=1e-9)
    depth_px = (xyz @ rotations[0].T)[:, 2] / OPTICS.pixel_size_um
    found = disparity_of(frames, first, second) + frames.depths_px * depth_px
    np.testing.assert_allclose(found, found[0], atol=1e-9)
    np.testing.assert_allclose(frames.to_second(frames.to_right(second)), second, atol=1e-9)


@AXES
def test_the_first_view_is_turned_and_not_stretched(axis_deg: float) -> None:
    rotations = rotations_from_tilts(np.array([0.0, 20.0]), axis_deg)
    frames = rectify(epipolar_geometry(*rotations, OPTICS.centre_px), OPTICS.shape, 0.0, (0.0, 16.0))
    linear = frames.left_from_first[:, :2]
    np.testing.assert_allclose(linear @ linear.T, np.eye(2), atol=1e-12)
    assert np.linalg.det(linear) == pytest.approx(1)
    corners = frames.to_left(np.array([[0, 0], [199, 0], [0, 159], [199, 159]], dtype=float))
    assert corners[:, 0].min() > 16 - 1e-6  # columns to spare for the search
    assert (corners > -1e-6).all()
    assert (corners.max(axis=0) < np.array(frames.shape[::-1]) - 1 + 1e-6).all()


def test_resampling_keeps_whole_pixels_and_says_where_there_is_nothing() -> None:
    image = np.random.default_rng(3).normal(100, 20, (40, 50)).astype(np.float32)
    mask = np.ones(image.shape, dtype=bool)
    mask[10:14, 20:25] = False
    shift = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, -3.0]])
    got = resampled(View(image, 0.0, mask=mask), shift, (40, 60))
    expected = np.full((40, 60), np.nan, dtype=np.float32)
    expected[:37, 7:57] = np.where(mask, image, np.nan)[3:]
    np.testing.assert_allclose(got, expected, atol=2e-2)
    np.testing.assert_allclose(inverted(inverted(shift)), shift)


@pytest.mark.parametrize("shift", [3.0, 4.25, 5.5, 6.8])
def test_a_shift_by_part_of_a_pixel_comes_back(shift: float) -> None:
    """Without noise: to a thousandth of a pixel in the mean, and without crowding about whole pixels."""
    texture = ndimage.gaussian_filter(np.random.default_rng(4).normal(size=(120, 220)), 1.5)
    left = texture[:, 20:200].astype(np.float32)
    right = ndimage.shift(texture, (0, -shift), order=5, mode="mirror")[:, 20:200].astype(np.float32)
    values = match_rows(left, right, 12, SemiGlobalOptions()).values_px[10:-10, 30:-10]
    assert np.isfinite(values).mean() > 0.95
    assert np.nanmean(values) == pytest.approx(shift, abs=3e-3)
    assert np.nanstd(values) < 0.02
    rough = match_rows(left, right, 12, SemiGlobalOptions(window_px=0)).values_px[10:-10, 30:-10]
    assert np.nanstd(values - shift) < np.nanstd(rough - shift) + 1e-3


def test_stated_sigma_follows_the_noise() -> None:
    """Two-sided on a fronto-parallel texture, at two levels of noise; it is part of the scatter, never all of it."""
    rng = np.random.default_rng(5)
    texture = ndimage.gaussian_filter(rng.normal(size=(200, 260)), 1.5)
    texture /= texture.std()
    for noise in (0.2, 0.5):
        left, right = (
            (texture[:, a : a + 220] + rng.normal(0, noise, (200, 220))).astype(np.float32) for a in (20, 24)
        )
        found = match_rows(left, right, 12, SemiGlobalOptions())
        inner = np.s_[20:-20, 40:-20]
        ratio = np.nanstd(found.values_px[inner] - 4) / np.nanmedian(found.sigma_px[inner])
        assert 0.7 < ratio < 2.5


@AXES
def test_dense_heights_follow_the_surface_about_any_axis(axis_deg: float) -> None:
    dense = answer(Disparity("boyde", "dense"), photographed(axis_deg))
    sparse = answer(Disparity("boyde"), photographed(axis_deg))
    assert len(dense.points) > 0.8 * OPTICS.width_px * OPTICS.height_px
    assert np.median(np.abs(depth_error(dense))) < 0.05  # 0.07 px of disparity
    assert np.median(np.abs(depth_error(dense))) < 0.7 * np.median(np.abs(depth_error(sparse)))
    x, y = (np.arange(200) - 99.5) * 0.1, -(np.arange(160) - 79.5) * 0.1
    gap = dense.heights.z_um - height_um(*np.meshgrid(x, y))
    assert np.nanmedian(np.abs(gap - np.nanmedian(gap))) < 0.05
    assert dense.pairs == sparse.pairs
    np.testing.assert_array_equal(dense.clouds[0].xyz_um, sparse.clouds[0].xyz_um)


def test_the_three_formulas_differ_densely_as_they_do_sparsely() -> None:
    boyde, symmetric, printed = (
        answer(Disparity(variant, "dense"), photographed()).heights.z_um
        for variant in ("boyde", "symmetric", "printed")
    )
    gap = (boyde - symmetric)[np.isfinite(boyde)]
    np.testing.assert_allclose(gap, gap[0], atol=1e-9)  # one surface; the gauge is each frame's own
    x, y = np.meshgrid((np.arange(200) - 99.5) * 0.1, -(np.arange(160) - 79.5) * 0.1)
    known = np.isfinite(boyde) & np.isfinite(printed)
    # the printed heights belong midway between the views: level them along x
    design = np.stack([height_um(x, y)[known], x[known], np.ones(known.sum())], axis=1)
    slopes = [np.linalg.lstsq(design, z[known], rcond=None)[0][0] for z in (boyde, printed)]
    assert slopes[0] == pytest.approx(1, abs=0.03)
    assert slopes[1] == pytest.approx(0.5, abs=0.02)


def test_a_reference_view_that_comes_second_gives_the_same_surface() -> None:
    series = photographed(0.0, (-8.0, 0.0))
    estimate = answer(Disparity("boyde", "dense"), series)
    shift = np.array([4.25, 6.5]) * OPTICS.pixel_size_um  # the second view was shifted, and its centre is the origin
    x, y, z = estimate.points.xyz_um.T
    error = z - height_um(x - shift[0], y - shift[1])
    assert np.median(np.abs(error - np.median(error))) < 0.05


def test_what_one_view_lacks_has_no_height() -> None:
    series = photographed()
    mask = np.ones(OPTICS.shape, dtype=bool)
    mask[60:90, 80:120] = False
    first = replace(series, views=(replace(series.views[0], mask=mask), series.views[1]))
    z = answer(Disparity("boyde", "dense"), first).heights.z_um
    assert np.isnan(z[60:90, 80:120]).all()
    assert np.isfinite(z[:55]).mean() > 0.8
    sigma = answer(Disparity("boyde", "dense"), first).heights.sigma_um
    np.testing.assert_array_equal(np.isnan(z), np.isnan(sigma))


def test_dense_clouds_are_registered() -> None:
    series = photographed(0.0, (0.0, 6.0, 12.0))
    dense, sparse = (answer(DisparityIcp("boyde", density), series) for density in ("dense", "sparse"))
    assert all(3000 < len(cloud) <= 10_000 for cloud in dense.clouds)
    assert np.median(np.abs(depth_error(dense))) < np.median(np.abs(depth_error(sparse)))


def test_interpolation_of_a_grid_with_holes() -> None:
    grid = np.arange(12.0).reshape(3, 4)
    grid[1, 1] = np.nan
    places = np.array([[0, 0], [3, 2], [2.5, 0], [1, 1], [1.5, 1], [2, 1 + 1e-9], [3.5, 0], [-1, 0]])
    np.testing.assert_allclose(interpolated(grid, places), [0, 11, 2.5, np.nan, np.nan, 6, np.nan, np.nan])


def test_options_and_series_that_cannot_be_matched_are_refused_with_a_sentence() -> None:
    with pytest.raises(InputError, match="block_px must be an odd"):
        SemiGlobalOptions(block_px=4)
    with pytest.raises(InputError, match="smooth must be two rising"):
        SemiGlobalOptions(smooth=(8.0, 8.0))
    with pytest.raises(InputError, match="density must be one of sparse, dense"):
        Disparity(density="thick")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="variant must be one of printed"):
        DisparityIcp(variant="prined")  # type: ignore[arg-type]
    with pytest.raises(MethodError, match="same tilt"):
        answer(Disparity(density="dense"), photographed(0.0, (0.0, 0.0)))
