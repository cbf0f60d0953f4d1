"""Claims on the alignment: features where there are enough, the likeness of whole pictures where there are not."""

import numpy as np
import pytest
from scipy import ndimage

from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.data import Estimate, HeightMap, Optics, SurfaceMesh, TiltSeries, View
from semrecon.errors import MethodError
from semrecon.matches.correspondence import CorrespondenceOptions
from semrecon.matches.features import FeatureOptions
from semrecon.matches.phase_correlation import phase_shift
from semrecon.numerics.history import histories
from semrecon.output.glance import noise_px, pair_matrices, view_tilts
from semrecon.pose.alignment import align, connected_views
from semrecon.reconstruction import Reconstruction

SHAPE = (150, 180)


def paint(seed=0, sigma=1.5):
    picture = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(260, 300)), sigma)
    return 120 + 40 * picture / picture.std()


def flat_series(shifts_px, tilts_deg=(0.0, 6.0, 12.0)):
    """A flat painted specimen, drifting: columns shrink by the cosine of the tilt about an upright axis."""
    rows, columns = np.indices(SHAPE).astype(float)
    views = []
    for (dx, dy), tilt in zip(shifts_px, tilts_deg, strict=True):
        x = (columns - 89.5 - dx) / np.cos(np.deg2rad(tilt)) + 150
        y = rows - 74.5 - dy + 130
        noise = np.random.default_rng(round(tilt)).normal(0, 4, SHAPE)
        views.append(View(ndimage.map_coordinates(paint(), [y, x], order=3) + noise, tilt, f"view_{tilt:g}.tif"))
    return TiltSeries(tuple(views), Optics(0.5, SHAPE[1], SHAPE[0]))


SHIFTS = ((0.0, 0.0), (5.25, -8.5), (-11.0, 6.75))


def aligned(series, features=8000):
    options = CorrespondenceOptions(features=FeatureOptions(max_features=features))
    return align(series, options, RefinementOptions(), np.random.default_rng(0))


def test_features_give_shift_and_tilt_of_every_view():
    found = aligned(flat_series(SHIFTS))
    assert found.by_features == (0, 1, 2)
    assert found.warnings == ()
    np.testing.assert_allclose(found.poses.translations_um[:, :2] / 0.5, SHIFTS, atol=0.15)
    np.testing.assert_allclose(found.tilts_deg, (0, 6, 12), atol=0.3)
    assert len(found.points) > 100


def test_what_is_known_of_the_cameras_is_told_in_the_shape_that_the_summary_page_reads():
    series = flat_series(SHIFTS)
    found = aligned(series)
    told = found.diagnostics
    heights = HeightMap(np.zeros(SHAPE), np.zeros(SHAPE), 0.5)
    mesh = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    estimate = Estimate(poses=found.poses, diagnostics={"alignment": told})
    (history,) = histories(estimate.diagnostics)
    assert history["stage"] == "bundle adjustment of the cameras"
    assert history["residual_px"][-1] == pytest.approx(told["sigma_px"], rel=0.5)  # less what is fitted
    result = Reconstruction(series, "dense_multiview", {}, estimate, found.points, heights, mesh)
    tilts = view_tilts(result)
    np.testing.assert_array_equal(tilts.sigma_deg, told["tilt_sigma_deg"])
    np.testing.assert_allclose(tilts.found_deg, told["tilts_deg"], atol=1e-6)
    assert tilts.axis_found_deg == pytest.approx(found.tilt_axis_deg)
    assert 0 < tilts.axis_sigma_deg < 10
    matches, across = pair_matrices(result)
    assert np.isfinite(matches).sum() == np.isfinite(across).sum() == len(told["pairs"]) == 3
    assert noise_px(result) == pytest.approx(found.refinement.sigma_px)
    assert sum(told["tracks_by_views"].values()) == told["tracks"] >= told["points"] == len(found.points)


def test_without_features_the_shift_comes_from_the_whole_picture_and_a_sentence_says_so():
    found = aligned(flat_series(SHIFTS), features=1)
    assert found.by_features == ()
    assert found.points is None
    np.testing.assert_allclose(found.poses.translations_um[:, :2] / 0.5, SHIFTS, atol=0.2)
    np.testing.assert_array_equal(found.tilts_deg, (0, 6, 12))
    (warning,) = found.warnings
    assert all(name in warning for name in ("view_0.tif", "view_6.tif", "view_12.tif"))


def test_views_that_show_something_else_are_refused():
    series = flat_series(SHIFTS)
    other = View(paint(9)[:150, :180], 12.0, "other.tif")
    with pytest.raises(MethodError, match=r"other\.tif and view_0\.tif have nothing recognisable in common"):
        aligned(TiltSeries((*series.views[:2], other), series.optics))


def test_equal_tilts_are_refused():
    with pytest.raises(MethodError, match="no parallax"):
        aligned(flat_series(SHIFTS, (6.0, 6.0, 6.0)))


def test_shift_is_found_to_a_tenth_of_a_pixel_with_its_sign():
    rows, columns = np.indices(SHAPE).astype(float)
    first = View(paint()[50:200, 60:240], 0.0)
    moved = ndimage.map_coordinates(paint(), [rows + 50 - 7.3, columns + 60 + 12.6], order=3)
    found = phase_shift(first, View(moved, 3.0), np.eye(2), np.zeros(2))
    np.testing.assert_allclose(found, (-12.6, 7.3), atol=0.1)


def test_chance_has_no_shift():
    rng = np.random.default_rng(4)
    for _ in range(20):
        first, second = (View(rng.normal(size=SHAPE), 0.0) for _ in range(2))
        assert phase_shift(first, second, np.eye(2), np.zeros(2)) is None


def test_views_hang_together_by_chains():
    class Match:
        def __init__(self, *pair):
            self.pair = pair

    assert connected_views([Match(0, 1), Match(1, 3)], 5, 3) == (0, 1, 3)
    assert connected_views([], 3, 1) == (1,)
