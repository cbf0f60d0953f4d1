"""Claims on features and matches: the band finds what brute force finds, and a known motion comes back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from semrecon.data import Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.matches.correspondence import CorrespondenceOptions, match_adjacent_pairs, match_pairs
from semrecon.matches.epipolar import Window, epipolar_geometry
from semrecon.matches.features import FeatureOptions, Features, detect_features, usable_pixels
from semrecon.matches.matching import MatchOptions, match_exhaustively, match_features

CENTRE = np.array([199.5, 149.5])
ANYWHERE = Window()


def random_features(rng, n, *, places=None):
    """n features; with `places` fewer than n, several share a position."""
    xy = rng.uniform(0, [400, 300], (n, 2))
    if places is not None:
        xy = xy[np.sort(rng.integers(0, places, n))]
    histogram = rng.gamma(0.5, size=(n, 128))
    descriptors = np.sqrt(histogram / histogram.sum(axis=1, keepdims=True)).astype(np.float32)
    _, first, inverse = np.unique(xy, axis=0, return_index=True, return_inverse=True)
    return Features(xy, np.full(n, 4.0), descriptors, first[inverse.reshape(-1)])


def noisy_copy(features, rng, xy_px, noise):
    descriptors = np.abs(features.descriptors + rng.normal(0, noise, features.descriptors.shape))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(xy_px, features.scale_px, descriptors.astype(np.float32), np.arange(len(xy_px)))


def geometry(axis_deg=0.0, step_deg=5.0):
    return epipolar_geometry(*rotations_from_tilts(np.array([0.0, step_deg]), axis_deg), CENTRE)


def same(a, b):
    return np.array_equal(a.index1, b.index1) and np.array_equal(a.index2, b.index2)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), n=st.integers(1, 120), m=st.integers(1, 120), axis=st.floats(0, 180),
    mutual=st.booleans(),
)  # fmt: skip
def test_an_infinite_band_finds_exactly_what_brute_force_finds(seed, n, m, axis, mutual):
    rng = np.random.default_rng(seed)
    first, second = random_features(rng, n), random_features(rng, m)
    # a tiny tilt, so that the distance of neighbours in the first view is the same in pixels and in predicted places
    options = MatchOptions(ratio=0.98, max_distance=2.0, mutual=mutual)
    banded = match_features(first, second, geometry(axis, 1e-3), ANYWHERE, options)
    brute = match_exhaustively(first, second, options)
    assert same(banded, brute)
    np.testing.assert_allclose(banded.distance, brute.distance, atol=1e-5)
    assert n < 60 or m < 60 or len(brute) > 0


def test_the_band_keeps_to_the_band_and_gains_matches():
    rng = np.random.default_rng(1)
    first = random_features(rng, 1500)
    epipolar = geometry(30.0)
    places = np.column_stack([np.full(1500, 7.0), rng.uniform(-20, 20, 1500)])  # shift across; relief along
    xy2 = (epipolar.from_first(first.xy_px) + places) @ epipolar.basis + CENTRE
    second = noisy_copy(first, rng, xy2, noise=0.07)
    options = MatchOptions(ratio=0.8, max_distance=2.0)
    band = match_features(first, second, epipolar, Window((6.0, 8.0), (-21.0, 21.0)), options)
    brute = match_exhaustively(first, second, options)
    offsets = epipolar.offsets_px(band.xy1_px, band.xy2_px)
    assert np.all((offsets >= [6, -21]) & (offsets <= [8, 21]))
    correct = [int((matches.index1 == matches.index2).sum()) for matches in (band, brute)]
    assert correct[0] > 1.1 * correct[1] > 0


def test_nothing_in_the_window_is_no_match():
    rng = np.random.default_rng(2)
    first, second = random_features(rng, 30), random_features(rng, 30)
    assert len(match_features(first, second, geometry(), Window(across=(1e4, 2e4)), MatchOptions())) == 0
    empty = random_features(rng, 0)
    for pair in ((empty, second), (first, empty), (empty, empty)):
        assert len(match_features(*pair, geometry(), ANYWHERE, MatchOptions())) == 0
        assert len(match_exhaustively(*pair, MatchOptions())) == 0


def test_several_orientations_at_a_place_are_no_rivals_and_one_match():
    rng = np.random.default_rng(3)
    single = random_features(rng, 40)
    twice = Features(
        np.repeat(single.xy_px, 2, axis=0), np.repeat(single.scale_px, 2), np.repeat(single.descriptors, 2, axis=0),
        np.repeat(np.arange(40) * 2, 2),
    )  # fmt: skip
    matches = match_features(twice, twice, geometry(step_deg=1e-3), ANYWHERE, MatchOptions())
    assert np.array_equal(matches.index1, np.arange(40) * 2)
    assert np.array_equal(matches.index2, matches.index1)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), places=st.integers(1, 30))
def test_each_place_is_used_at_most_once(seed, places):
    rng = np.random.default_rng(seed)
    first, second = random_features(rng, 50, places=places), random_features(rng, 60, places=places)
    matches = match_exhaustively(first, second, MatchOptions(ratio=1.0, max_distance=2.0, mutual=False))
    for index, place in ((matches.index1, first.place), (matches.index2, second.place)):
        assert len(np.unique(index)) == len(index)
        assert np.isin(index, place).all()


@given(axis=st.floats(0, 360), tilt=st.floats(-40, 40), step=st.floats(1, 40), depth=st.floats(-50, 50))
def test_epipolar_geometry_is_the_projection(axis, tilt, step, depth):
    rotations = rotations_from_tilts(np.array([tilt, tilt + step]), axis)
    epipolar = epipolar_geometry(*rotations, CENTRE)
    camera1 = np.array([31.0, -12.0, depth])
    camera2 = rotations[1] @ rotations[0].T @ camera1
    offset = epipolar.offsets_px((camera1[:2] + CENTRE)[None], (camera2[:2] + CENTRE)[None])[0]
    np.testing.assert_allclose(offset, [0, epipolar.parallax * depth], atol=1e-9)
    assert epipolar.parallax == pytest.approx(np.sin(np.deg2rad(step)))


def test_equal_tilts_have_no_parallax():
    with pytest.raises(MethodError, match="same tilt"):
        geometry(step_deg=0.0)


# --- pictures ---------------------------------------------------------------------------------------------------


def texture(rng, shape=(240, 320)):
    noise = ndimage.gaussian_filter(rng.normal(size=shape), 1.5) + 2 * ndimage.gaussian_filter(
        rng.normal(size=shape), 4
    )
    return 128 + 40 * noise / noise.std()


def tilted_plane(image, step_deg, axis_deg, shift_px=(0.0, 0.0)):
    """The picture of a flat textured plane after a tilt: the exact affine map, by a quintic B-spline."""
    rotations = rotations_from_tilts(np.array([0.0, step_deg]), axis_deg)
    relative = rotations[1] @ rotations[0].T
    to_first = np.linalg.inv(relative[:2, :2])[::-1, ::-1]  # (row, column)
    centre = (np.array(image.shape) - 1) / 2
    offset = centre - to_first @ (centre + np.array(shift_px)[::-1])
    return ndimage.affine_transform(image, to_first, offset, order=5, mode="mirror")


def series_of(images, tilts_deg, axis_deg=0.0, names=("first.tif", "second.tif", "third.tif")):
    rows, columns = images[0].shape
    views = tuple(View(image, tilt, name) for image, tilt, name in zip(images, tilts_deg, names, strict=False))
    return TiltSeries(views, Optics(0.1, columns, rows), axis_deg)


@pytest.mark.parametrize(("axis_deg", "shift_px"), [(0.0, (3.0, -21.25)), (90.0, (17.5, 2.0)), (30.0, (0.0, 0.0))])
def test_a_tilted_plane_has_no_disparity_and_its_shift_comes_back(axis_deg, shift_px):
    image = texture(np.random.default_rng(4))
    series = series_of([image, tilted_plane(image, 10.0, axis_deg, shift_px)], [0.0, 10.0], axis_deg)
    (pair,) = match_adjacent_pairs(series, CorrespondenceOptions(), np.random.default_rng(0))
    epipolar = epipolar_geometry(*rotations_from_tilts(series.tilts_deg, axis_deg), series.optics.centre_px)
    offsets = epipolar.offsets_px(pair.matches.xy1_px, pair.matches.xy2_px)
    expected = epipolar.basis @ shift_px
    assert len(pair.matches) > 200
    assert pair.shift_px == pytest.approx(expected[0], abs=0.03)
    np.testing.assert_allclose(np.median(offsets, axis=0), expected, atol=0.03)
    assert np.percentile(np.abs(offsets - expected), 90) < 0.5
    np.testing.assert_allclose(pair.skew, 0, atol=1e-3)


def test_a_wrong_magnification_shows_as_skew():
    image = texture(np.random.default_rng(5))
    centre = (np.array(image.shape) - 1) / 2
    larger = ndimage.affine_transform(image, np.eye(2) / 1.01, centre - centre / 1.01, order=5, mode="mirror")
    series = series_of([image, tilted_plane(larger, 5.0, 0.0)], [0.0, 5.0])
    (pair,) = match_adjacent_pairs(series, CorrespondenceOptions(), np.random.default_rng(0))
    assert abs(pair.skew[1]) == pytest.approx(0.01, rel=0.1)
    assert abs(pair.skew[0]) < 1e-3


def test_features_sit_where_blobs_are():
    rng = np.random.default_rng(6)
    rows, columns = np.mgrid[:200, :200]
    image = np.zeros((200, 200))
    centres = np.stack(np.meshgrid(np.arange(20, 200, 20), np.arange(20, 200, 20)), -1).reshape(-1, 2)
    centres = centres + rng.uniform(-0.5, 0.5, centres.shape)
    for x, y in centres:
        image += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)
    found = detect_features(View(image, 0.0)).xy_px
    error = found[np.argmin(np.linalg.norm(found[None] - centres[:, None], axis=2), axis=1)] - centres
    assert np.abs(error).max() < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.02  # OpenCV's default scale space is off by 0.25 px


def test_features_ignore_grey_scale_and_keep_from_what_is_masked():
    image = texture(np.random.default_rng(7))
    plain = detect_features(View(image, 0.0))
    stretched = detect_features(View(image * 37.0 + 5000.0, 0.0))
    np.testing.assert_allclose(plain.xy_px, stretched.xy_px, atol=1e-3)
    mask = np.ones(image.shape, dtype=bool)
    mask[:, :150] = False
    broken = image.copy()
    broken[100] = np.nan
    broken[200:] = 0.0
    found = detect_features(View(broken, 0.0, mask=mask))
    assert found.xy_px[:, 0].min() >= 150 + FeatureOptions().mask_margin_px - 0.5
    assert np.abs(found.xy_px[:, 1] - 100).min() >= FeatureOptions().mask_margin_px - 0.5
    assert found.xy_px[:, 1].max() < 200 - FeatureOptions().mask_margin_px
    assert not usable_pixels(View(broken, 0.0))[[100, 220]].any()
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)


def test_the_strongest_places_are_kept_in_reading_order():
    view = View(texture(np.random.default_rng(8)), 0.0)
    for upright in (True, False):
        some = detect_features(view, FeatureOptions(max_features=50, upright=upright))
        assert len(np.unique(some.place)) == 50
        assert np.all(np.diff(some.xy_px[:, 1]) >= 0)


@pytest.mark.parametrize("image", [np.zeros((64, 64)), np.full((64, 64), 255, np.uint8), np.full((64, 64), np.nan)])
def test_a_blank_view_is_named(image):
    with pytest.raises(MethodError, match=r"a\.tif is blank"):
        detect_features(View(image, 0.0, "a.tif"))


def test_unrelated_pictures_give_a_sentence_not_chance_matches():
    rng = np.random.default_rng(9)
    series = series_of([texture(rng), texture(rng)], [0.0, 5.0])
    with pytest.raises(MethodError, match=r"matches between first\.tif and second\.tif, which have \d+ and \d+"):
        match_adjacent_pairs(series, CorrespondenceOptions(), np.random.default_rng(0))
    with pytest.raises(MethodError, match="between first"):
        match_pairs(series, [(0, 1)], CorrespondenceOptions(), np.random.default_rng(0), optional=True)


def test_an_optional_pair_may_fail_where_others_connect_the_views():
    image = texture(np.random.default_rng(11))
    images = [image, tilted_plane(image, 5.0, 0.0), tilted_plane(image, 5.0, 0.0)]
    series = series_of(images, [0.0, 5.0, 5.0])
    pairs = [(0, 1), (0, 2), (1, 2)]  # the last has no parallax
    found = match_pairs(series, pairs, CorrespondenceOptions(), np.random.default_rng(0), optional=True)
    assert [one.pair for one in found] == [(0, 1), (0, 2)]
    with pytest.raises(MethodError, match=r"second\.tif and third\.tif: .* same tilt"):
        match_pairs(series, pairs, CorrespondenceOptions(), np.random.default_rng(0))


def test_one_view_is_not_a_series():
    series = series_of([texture(np.random.default_rng(9))], [0.0])
    with pytest.raises(InputError, match="at least two views"):
        match_adjacent_pairs(series, CorrespondenceOptions(), np.random.default_rng(0))


def test_the_same_seed_gives_the_same_bits_in_any_order_of_pairs():
    image = texture(np.random.default_rng(10))
    images = [image, *(tilted_plane(image, tilt, 0.0) for tilt in (5.0, 10.0))]
    before = [one.copy() for one in images]
    series = series_of(images, [0.0, 5.0, 10.0])
    options = replace(CorrespondenceOptions(), check_neighbours=False)
    runs = [match_pairs(series, [(0, 1), (1, 2)], options, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    for one, other in zip(runs[0], runs[1], strict=True):
        assert same(one.matches, other.matches)
        assert np.array_equal(one.matches.xy2_px, other.matches.xy2_px)
    assert same(runs[0][1].matches, runs[2][1].matches)  # few enough matches: every hypothesis is tried
    for one, other in zip(images, before, strict=True):
        assert np.array_equal(one, other)
