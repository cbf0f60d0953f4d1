"""Claims on the dense method: known surfaces come back right side up and to scale, and nothing is invented."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.adapt import series_from_capture
from semrecon.data import Optics, PointCloud, Poses, TiltSeries, View
from semrecon.dense.confidence import ConfidenceOptions
from semrecon.dense.sightlines import sightlines
from semrecon.errors import MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.methods.dense_multiview import DenseMultiview, _span_px
from semrecon.pose.alignment import Alignment, align
from semsim.capture import simulate
from semsim.scenes import scene


@lru_cache
def captured(name):
    return simulate(scene(name), 20_001)


@lru_cache
def answer(name, *views):
    series = series_from_capture(captured(name))
    return DenseMultiview()(series.select(*views) if views else series, rng=np.random.default_rng(0))


def errors_um(name, estimate):
    """Estimated less true heights, the offset taken out, (rows, columns)."""
    error = estimate.heights.z_um - captured(name).truth.height_map(0)
    return error - np.nanmedian(error)


def again(series, **changes):
    return DenseMultiview()(replace(series, **changes), rng=np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "median_um", "share"), [("plane", 0.8, 0.8), ("step", 0.6, 0.75), ("sphere", 0.6, 0.35)]
)
def test_known_surfaces_come_back(name, median_um, share):
    estimate, truth = answer(name), captured(name).truth.height_map(0)
    error = errors_um(name, estimate)
    known = np.isfinite(error)
    assert known.mean() > share
    assert np.median(np.abs(error[known])) < median_um
    near = known & (np.abs(error) < 3)  # but for the rim, where the surface stands upright
    slope = np.polyfit(truth[near], estimate.heights.z_um[near], 1)[0]
    assert slope == pytest.approx(1.0, abs=0.05)  # right side up, and neither halved nor stretched


def test_the_standard_deviation_is_that_of_the_error():
    for name in ("plane", "sphere"):
        ratio = np.abs(errors_um(name, answer(name))) / answer(name).heights.sigma_um
        ratio = ratio[np.isfinite(ratio)]
        assert 0.4 < (ratio < 1).mean() < 0.98
        assert (ratio < 2).mean() > 0.75


def test_the_features_that_the_cameras_rest_on_are_told_beside_the_points():
    estimate = answer("plane")
    series = series_from_capture(captured("plane"))
    ties = estimate.ties
    assert len(estimate.points) == np.isfinite(estimate.heights.z_um).sum() > 20 * len(ties) > 400
    assert len(ties) == estimate.diagnostics["alignment"]["points"]
    assert np.isfinite(ties.residual_px).all()
    assert np.median(ties.residual_px) < 1
    seen = np.isfinite(ties.xy_px).all(axis=1)
    assert seen.mean() > 0.5
    x, y = np.rint(ties.xy_px[seen]).astype(int).T
    gap = -(ties.xyz_um[seen] @ estimate.poses.rotations[series.reference, 2]) - estimate.heights.z_um[y, x]
    off = np.abs(gap - np.nanmedian(gap)) / ties.sigma_um[seen]
    assert 0.3 < np.nanmedian(off) < 1.5  # one surface, told twice


@pytest.mark.slow
def test_heights_on_which_the_views_agree_well_stand_though_no_other_sweep_finds_them(monkeypatch):
    series, before = series_from_capture(captured("sphere")), answer("sphere").heights
    monkeypatch.setattr("semrecon.methods.dense_multiview.confirmed", lambda *_: np.zeros(before.z_um.shape, bool))
    after = again(series).heights
    kept, stood = np.isfinite(before.z_um), np.isfinite(after.z_um)
    assert 0.05 < (kept & stood).sum() / kept.sum() < 0.99
    ratio = (after.sigma_um / before.sigma_um)[kept & stood]
    assert np.median(ratio) == pytest.approx(ConfidenceOptions().doubt)  # and with less certainty
    strict = DenseMultiview(confidence=ConfidenceOptions(sure_score=1.1))
    with pytest.raises(MethodError, match="0 pixels"):
        strict(series, rng=np.random.default_rng(0))


def features_at(heights_px):
    """An alignment whose features lie at given heights, in 0.5 um pixels, one view tilted by 10 degrees."""
    optics, tilts = Optics(0.5, 300, 200), np.array([0.0, 10.0])
    xyz = np.zeros((len(heights_px), 3))
    xyz[:, 2] = 0.5 * np.asarray(heights_px)
    nan = np.full((len(xyz), 3), np.nan)
    points = PointCloud(xyz, np.full((len(xyz), 3, 3), np.nan), nan[:, 0], nan[:, :2])
    poses = Poses(rotations_from_tilts(tilts, 0.0), np.zeros((2, 3)))
    eye = np.tile(np.eye(2), (2, 1, 1))
    series = TiltSeries(tuple(View(np.zeros((200, 300)), tilt, f"{tilt:g}") for tilt in tilts), optics)
    aligned = Alignment(poses, eye, tilts, 0.0, (0, 1), points)
    return _span_px(series, aligned, sightlines(poses, eye, optics, 0))


def test_the_span_holds_all_features_but_not_those_that_matched_by_the_pitch_of_stripes():
    heights = np.random.default_rng(0).uniform(-30, 30, 1000)
    low, high = features_at(heights)
    assert low < heights.min()
    assert high > heights.max()
    wrong = heights.copy()
    wrong[:40] = np.repeat((-4000.0, 4000.0), 20)
    low, high = features_at(wrong)
    assert low < heights.min()
    assert high > heights.max()
    assert high - low < 20 * 60


def test_shading_is_an_option_that_changes_heights_and_off_is_without_it(monkeypatch):
    whole, part = series_from_capture(captured("sphere")), (slice(30, 150), slice(40, 200))
    views = tuple(replace(view, image=view.image[part].copy()) for view in whole.views)
    series = replace(whole, views=views, optics=replace(whole.optics, width_px=160, height_px=120))
    plain = DenseMultiview(shading="off")
    aligned = align(series, plain.correspondence, plain.refinement, np.random.default_rng(0))
    found = DenseMultiview(shading="everywhere").from_alignment(series, aligned)
    assert found.diagnostics["shading"]["share_by_shading"] == 1.0
    monkeypatch.setattr("semrecon.methods.dense_multiview.shaded", None)  # not to be called
    off = plain.from_alignment(series, aligned)
    assert "shading" not in off.diagnostics
    gap = found.heights.z_um - off.heights.z_um
    assert np.isfinite(gap).mean() > 0.2
    assert 1e-3 < np.nanmedian(np.abs(gap)) < 1.0  # detail, no other surface


def test_two_views_are_enough():
    error = errors_um("sphere", answer("sphere", 0, 2))
    assert np.isfinite(error).mean() > 0.25
    assert np.nanmedian(np.abs(error)) < 0.8


@pytest.mark.slow
def test_the_same_images_give_the_same_bits():
    series = series_from_capture(captured("step"))
    np.testing.assert_array_equal(answer("step").heights.z_um, again(series).heights.z_um)
    np.testing.assert_array_equal(answer("step").heights.sigma_um, again(series).heights.sigma_um)


@pytest.mark.slow
def test_pictures_turned_by_a_quarter_turn_with_the_tilt_axis_give_heights_turned():
    """Turned clockwise, image up becomes image right: an axis of 0 becomes one of 90 degrees."""
    series = series_from_capture(captured("sphere"))
    views = tuple(replace(view, image=np.rot90(view.image, -1).copy()) for view in series.views)
    optics = replace(series.optics, width_px=series.optics.height_px, height_px=series.optics.width_px)
    turned = again(series, views=views, optics=optics, tilt_axis_deg=90.0).heights.z_um
    gap = np.rot90(turned, 1) - answer("sphere").heights.z_um
    assert np.isfinite(gap).mean() > 0.35
    assert np.nanmedian(np.abs(gap - np.nanmedian(gap))) < 0.3


@pytest.mark.slow
def test_a_view_shifted_by_whole_pixels_changes_nothing():
    """Drift of the stage, across and along the parallax: the offset along it is the gauge."""
    series = series_from_capture(captured("plane"))
    first, second, third = series.views
    moved = replace(third, image=np.roll(third.image, (9, 0), axis=(0, 1)), mask=np.ones(third.image.shape, bool))
    mask = np.ones(third.image.shape, dtype=bool)
    mask[:9] = False
    shifted = again(series, views=(first, second, replace(moved, mask=mask)))
    gap = shifted.heights.z_um - answer("plane").heights.z_um
    assert np.isfinite(gap).mean() > 0.7
    assert np.nanmedian(np.abs(gap - np.nanmedian(gap))) < 0.25


@pytest.mark.slow
def test_masked_pixels_of_the_reference_view_have_no_height():
    series = series_from_capture(captured("plane"))
    mask = np.ones(series.optics.shape, dtype=bool)
    mask[60:120, 80:160] = False
    masked = again(series, views=(replace(series.views[0], mask=mask), *series.views[1:])).heights
    assert np.isnan(masked.z_um[60:120, 80:160]).all()
    assert np.isfinite(masked.z_um).mean() > 0.5


def test_nothing_is_invented_where_there_is_nothing_to_see():
    series = series_from_capture(captured("plane"))
    rng = np.random.default_rng(1)
    patch = (slice(50, 130), slice(70, 180))
    views = []
    for view in series.views:
        image = view.image.copy()
        image[patch] = np.clip(np.rint(rng.normal(float(image.mean()), 8.0, image[patch].shape)), 0, 255)
        views.append(replace(view, image=image))
    heights = again(series, views=tuple(views)).heights
    inner = heights.z_um[62:118, 90:160]
    assert np.isfinite(inner).mean() < 0.1
    assert np.isfinite(heights.z_um[140:, :]).mean() > 0.6


@pytest.mark.parametrize("kind", ["grey", "noise", "one tilt"])
def test_views_without_a_common_picture_or_parallax_are_refused_in_a_sentence(kind):
    series = series_from_capture(captured("plane"))
    shape, rng = series.optics.shape, np.random.default_rng(2)
    if kind == "one tilt":
        views = tuple(replace(view, tilt_deg=3.0) for view in series.views)
    elif kind == "noise":
        views = tuple(View(rng.normal(100, 10, shape), tilt, f"v{tilt:g}") for tilt in (0.0, 5.0))
    else:
        views = tuple(View(np.full(shape, 100, dtype=np.uint8), tilt, f"v{tilt:g}") for tilt in (0.0, 5.0))
    with pytest.raises(MethodError, match="v"):
        DenseMultiview()(TiltSeries(views, series.optics), rng=np.random.default_rng(0))
