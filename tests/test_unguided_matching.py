"""Claims on matching without known tilts: the right pairs, the right lines, and a sentence where there are none."""

from dataclasses import replace

import numpy as np
import pytest

from semrecon.data import Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.matches.features import FeatureOptions, detect_features
from semrecon.matches.matching import MatchOptions, match_exhaustively
from semrecon.matches.tracks import join_matches
from semrecon.matches.unguided_matching import UnguidedOptions, match_all, match_unguided
from tests.known_surface import PIXEL_UM, bump_series, bump_um

SERIES = bump_series((0.0, 8.0, 16.0))


def matched(series, seed=0, **options):
    return match_unguided(series, replace(UnguidedOptions(), **options), np.random.default_rng(seed))


@pytest.mark.parametrize("ratio", [0.7, 0.85])
def test_blocks_find_what_a_full_table_finds(ratio):
    first, second = (detect_features(view) for view in SERIES.views[:2])
    options = MatchOptions(ratio=ratio)
    one, two = match_all(first, second, options), match_exhaustively(first, second, options)
    assert np.array_equal(one.index1, two.index1)
    assert np.array_equal(one.index2, two.index2)
    assert one.distance == pytest.approx(two.distance, abs=1e-3)  # the root magnifies the rounding of float32


def test_matches_lie_where_the_surface_puts_them():
    """A match at (x, y) of the untilted view belongs to column x cos t + z sin t of the tilted one, in its own row."""
    for one in matched(SERIES)[:2]:
        tilt = np.deg2rad(SERIES.views[one.pair[1]].tilt_deg)
        x, y = ((one.matches.xy1_px - SERIES.optics.centre_px) * [PIXEL_UM, -PIXEL_UM]).T
        expected = (x * np.cos(tilt) + bump_um(x, y) * np.sin(tilt)) / PIXEL_UM
        misses = one.matches.xy2_px - SERIES.optics.centre_px - np.column_stack([expected, -y / PIXEL_UM])
        assert np.median(np.linalg.norm(misses, axis=1)) < 0.35
        assert np.mean(np.linalg.norm(misses, axis=1) > 3) < 0.02
        assert np.abs(one.skew).max() < 0.02
        assert len(one.matches) <= one.candidates


def test_the_answer_depends_on_the_seed_alone():
    one, two = matched(SERIES, seed=3), matched(SERIES, seed=3)
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.matches.xy1_px, b.matches.xy1_px)
        assert np.array_equal(a.epipolar.normal, b.epipolar.normal)


def test_tilts_and_axis_do_not_matter():
    lied = replace(SERIES, views=tuple(replace(view, tilt_deg=-5.0) for view in SERIES.views), tilt_axis_deg=77.0)
    for a, b in zip(matched(SERIES), matched(lied), strict=True):
        assert np.array_equal(a.matches.xy2_px, b.matches.xy2_px)


def test_a_turned_picture_is_matched_where_features_have_their_own_direction():
    """The second view turned by a right angle: upright descriptors fail, oriented ones find the turn."""
    first, second = SERIES.views[0].image[:, 20:140], np.rot90(SERIES.views[2].image[:, 20:140])
    turned = TiltSeries((View(first, 0.0, "a"), View(second, 0.0, "b")), Optics(PIXEL_UM, 120, 120))
    own = UnguidedOptions(features=FeatureOptions(upright=False))
    wide = replace(own, epipolar=replace(own.epipolar, most_turn_deg=180.0))
    (found,) = match_unguided(turned, wide, np.random.default_rng(0))
    assert np.rad2deg(found.skew[0]) == pytest.approx(-90, abs=2)
    with pytest.raises(MethodError):
        matched(turned)


def test_a_pair_that_fails_is_left_out_while_the_others_connect_all_views():
    """Two equal views have no parallax; the third connects them."""
    series = SERIES.select(0, 0, 2)
    found = matched(series)
    assert [one.pair for one in found] == [(0, 2), (1, 2)]
    assert join_matches(found, 3).seen.all(axis=1).any()


@pytest.mark.parametrize("views", [(0, 0), (1, 1, 1)])
def test_equal_views_are_refused(views):
    with pytest.raises(MethodError, match="bump_"):
        matched(SERIES.select(*views))


def test_unrelated_pictures_are_refused():
    noise = np.random.default_rng(0).integers(0, 255, (2, 120, 160)).astype(np.uint8)
    views = tuple(View(image, 0.0, f"noise_{i}") for i, image in enumerate(noise))
    with pytest.raises(MethodError):
        matched(replace(SERIES, views=views))


def test_one_view_is_no_series():
    with pytest.raises(InputError, match="two views"):
        matched(SERIES.select(0))
