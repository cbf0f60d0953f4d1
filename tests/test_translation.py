"""Claims about translation: what the linear system says, what it cannot say, and who decides then."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Optics, Poses, Tracks
from semrecon.errors import InputError, MethodError
from semrecon.geometry import CAM_FROM_VIEW, centred_um, project, rotations_from_tilts
from semrecon.points.translation import (
    global_translations,
    linear_system,
    solve_closed_form,
    solve_generalised_inverse,
    solve_series,
)

OPTICS = Optics(0.147, 854, 640)
LITERAL = {"gauge": "minimum_norm", "perpendicular": "mean"}


def pair(rng: np.random.Generator, n: int, rotation: Array, noise_um: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Matches of random points: m1, m2, depths and the translation."""
    xyz = rng.uniform(-40, 40, (n, 3))
    translation = rng.uniform(-10, 10, 2)
    m2 = xyz @ rotation[:2].T + translation + rng.normal(0, noise_um, (n, 2))
    return xyz[:, :2], m2, xyz[:, 2], translation


def tilt_pair(step_deg: float, axis_deg: float = 0.0) -> Array:
    first, second = rotations_from_tilts(np.array([2.0, 2.0 + step_deg]), axis_deg)
    return second @ first.T


seeds = st.integers(0, 2**32 - 1)
counts = st.integers(2, 40)


@st.composite
def rotations(draw: st.DrawFn) -> Array:
    """Any rotation whose beams are between 1.5 and 88 degrees apart, about any axis, with any turn in the plane."""
    lean, azimuth, turn = draw(st.floats(1.5, 88)), draw(st.floats(0, 360)), draw(st.floats(0, 360))
    return Rotation.from_euler("zyz", [azimuth, lean, turn], degrees=True).as_matrix()


@given(seeds, counts, rotations())
@settings(max_examples=60, deadline=None)
def test_closed_form_is_the_generalised_inverse(seed: int, n: int, rotation: Array) -> None:
    m1, m2, _, _ = pair(np.random.default_rng(seed), n, rotation, noise_um=0.5)
    literal, closed = solve_generalised_inverse(m1, m2, rotation), solve_closed_form(m1, m2, rotation, **LITERAL)
    scale = np.abs(literal.depth_um).max()
    np.testing.assert_allclose(closed.depth_um, literal.depth_um, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(closed.translation_um, literal.translation_um, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(closed.epipolar_um, literal.epipolar_um, rtol=0, atol=1e-9 * scale)


@given(seeds, counts, rotations())
@settings(max_examples=60, deadline=None)
def test_singular_values_rank_and_condition_are_the_stated_ones(seed: int, n: int, rotation: Array) -> None:
    m1, m2, _, _ = pair(np.random.default_rng(seed), n, rotation)
    a, _ = linear_system(m1, m2, rotation)
    values = np.linalg.svd(a, compute_uv=False)
    sine = np.hypot(*rotation[:2, 2])
    stated = np.sort(np.concatenate([[n + sine**2, n], np.full(n - 1, sine**2), [0.0]]))[::-1] ** 0.5
    np.testing.assert_allclose(values, stated, atol=1e-6 * values[0])
    answer = solve_closed_form(m1, m2, rotation)
    assert a.shape == (2 * n, n + 2)
    assert answer.rank == np.linalg.matrix_rank(a) == n + 1
    assert answer.condition == pytest.approx(values[0] / values[n], rel=1e-9)


def test_rotation_about_the_image_y_axis_is_the_stereo_formula() -> None:
    m1, m2, _, _ = pair(np.random.default_rng(1), 30, Rotation.from_euler("y", 7, degrees=True).as_matrix(), 0.3)
    sine, cosine, n = np.sin(np.deg2rad(7)), np.cos(np.deg2rad(7)), 30
    answer = solve_generalised_inverse(m1, m2, Rotation.from_euler("y", 7, degrees=True).as_matrix())
    c = m2[:, 0] - cosine * m1[:, 0]
    assert answer.translation_um[0] == pytest.approx(c.sum() / (sine**2 + n), rel=1e-10)
    np.testing.assert_allclose(answer.depth_um, (c - answer.translation_um[0]) / sine, rtol=1e-9)


@given(seeds, counts, rotations())
@settings(max_examples=40, deadline=None)
def test_exact_matches_give_the_depths_up_to_the_gauge(seed: int, n: int, rotation: Array) -> None:
    m1, m2, depth, translation = pair(np.random.default_rng(seed), n, rotation)
    answer = solve_closed_form(m1, m2, rotation)
    shift = np.median(depth)
    scale = np.abs(depth).max()
    np.testing.assert_allclose(answer.depth_um, depth - shift, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(answer.translation_um, translation + shift * rotation[:2, 2], atol=1e-9 * scale)
    np.testing.assert_allclose(answer.epipolar_um, 0, atol=1e-9 * scale)


@given(seeds, rotations(), st.floats(-50, 50))
@settings(max_examples=20, deadline=None)
def test_gauge_shift_changes_no_image(seed: int, rotation: Array, k: float) -> None:
    m1, m2, _, _ = pair(np.random.default_rng(seed), 9, rotation)
    moved = solve_closed_form(m1, m2, rotation).shifted(k)
    xyz = np.column_stack([m1, moved.depth_um])
    np.testing.assert_allclose(xyz @ rotation[:2].T + moved.translation_um, m2, atol=1e-9)
    a, b = linear_system(m1, m2, rotation)
    np.testing.assert_allclose(a @ np.concatenate([moved.depth_um, moved.translation_um]), b, atol=1e-9)


@pytest.mark.parametrize(
    ("gauge", "statistic"), [("zero_mean", np.mean), ("zero_median", np.median), ("minimum_norm", None)]
)
def test_each_gauge_does_what_it_says(gauge: str, statistic: object) -> None:
    m1, m2, _, _ = pair(np.random.default_rng(2), 25, tilt_pair(5.0), 0.2)
    answer = solve_closed_form(m1, m2, tilt_pair(5.0), gauge=gauge)
    assert answer.gauge == gauge
    if statistic is None:
        null = np.concatenate([np.ones(25), -answer.parallax])
        assert abs(null @ np.concatenate([answer.depth_um, answer.translation_um])) < 1e-9
    else:
        assert abs(statistic(answer.depth_um)) < 1e-9


def test_swapped_views_see_the_same_points() -> None:
    rotation = tilt_pair(6.0, 30.0)
    m1, m2, _, _ = pair(np.random.default_rng(3), 50, rotation)
    forward, backward = solve_closed_form(m1, m2, rotation), solve_closed_form(m2, m1, rotation.T)
    depth_in_view_2 = np.column_stack([m1, forward.depth_um]) @ rotation[2]
    np.testing.assert_allclose(backward.depth_um, depth_in_view_2 - np.median(depth_in_view_2), atol=1e-9)


@given(seeds, rotations(), st.floats(0, 360))
@settings(max_examples=20, deadline=None)
def test_turning_both_images_and_the_axis_changes_no_depth(seed: int, rotation: Array, turn_deg: float) -> None:
    m1, m2, _, _ = pair(np.random.default_rng(seed), 15, rotation, 0.3)
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    flat = turn[:2, :2]
    answer = solve_closed_form(m1, m2, rotation)
    turned = solve_closed_form(m1 @ flat.T, m2 @ flat.T, turn @ rotation @ turn.T)
    np.testing.assert_allclose(turned.depth_um, answer.depth_um, atol=1e-8)
    np.testing.assert_allclose(turned.translation_um, flat @ answer.translation_um, atol=1e-8)


def test_shifting_either_image_changes_no_depth() -> None:
    rotation = tilt_pair(4.0, 70.0)
    m1, m2, _, _ = pair(np.random.default_rng(4), 40, rotation, 0.3)
    answer = solve_closed_form(m1, m2, rotation)
    shift = np.array([3.0, -8.0])
    second, first = solve_closed_form(m1, m2 + shift, rotation), solve_closed_form(m1 + shift, m2, rotation)
    np.testing.assert_allclose(second.depth_um, answer.depth_um, atol=1e-9)
    np.testing.assert_allclose(second.translation_um, answer.translation_um + shift, atol=1e-9)
    np.testing.assert_allclose(first.depth_um, answer.depth_um, atol=1e-9)
    np.testing.assert_allclose(first.translation_um, answer.translation_um - rotation[:2, :2] @ shift, atol=1e-9)


def test_missing_positions_count_nowhere() -> None:
    rotation = tilt_pair(5.0)
    m1, m2, _, _ = pair(np.random.default_rng(5), 20, rotation, 0.3)
    m1[3, 0], m2[7] = np.nan, np.nan
    kept = np.isfinite(m1).all(axis=1) & np.isfinite(m2).all(axis=1)
    for solve in (solve_closed_form, solve_generalised_inverse):
        answer, whole = solve(m1, m2, rotation), solve(m1[kept], m2[kept], rotation)
        assert np.isnan(answer.depth_um[[3, 7]]).all()
        assert answer.rank == 19
        np.testing.assert_allclose(answer.depth_um[kept], whole.depth_um)
        np.testing.assert_allclose(answer.translation_um, whole.translation_um)


def test_wrong_matches_move_the_mean_but_not_the_median_nor_the_named_inliers() -> None:
    rotation = tilt_pair(5.0)
    m1, m2, depth, translation = pair(np.random.default_rng(6), 400, rotation)
    bad = np.arange(400) % 5 == 0
    wrong = m2 + np.where(bad[:, None], [0.0, 30.0], 0.0)
    assert abs(solve_closed_form(m1, wrong, rotation, **LITERAL).translation_um[1] - translation[1]) > 5
    assert abs(solve_closed_form(m1, wrong, rotation).translation_um[1] - translation[1]) < 1e-9
    chosen = solve_closed_form(m1, wrong, rotation, **LITERAL, inliers=~bad)
    clean = solve_generalised_inverse(m1[~bad], m2[~bad], rotation)
    np.testing.assert_allclose(chosen.translation_um, clean.translation_um, atol=1e-9)
    np.testing.assert_allclose(np.abs(chosen.epipolar_um[bad]), 30, atol=1e-9)
    np.testing.assert_allclose(np.diff(chosen.depth_um), np.diff(depth), atol=1e-8)


@pytest.mark.parametrize("rotation", [np.eye(3), Rotation.from_euler("z", 20, degrees=True).as_matrix()])
def test_no_tilt_is_refused(rotation: Array) -> None:
    m1 = np.arange(10.0).reshape(5, 2)
    for solve in (solve_closed_form, solve_generalised_inverse):
        with pytest.raises(MethodError, match="same beam"):
            solve(m1, m1, rotation)


def test_bad_matches_and_rotations_are_refused_with_a_sentence() -> None:
    rotation, m = tilt_pair(3.0), np.arange(10.0).reshape(5, 2)
    with pytest.raises(MethodError, match="two usable matches, 1 found"):
        solve_closed_form(m[:1], m[:1], rotation)
    with pytest.raises(MethodError, match="two usable matches, 1 found"):
        solve_closed_form(m, m, rotation, inliers=np.arange(5) == 0)
    with pytest.raises(InputError, match="one shape"):
        solve_closed_form(m, m[:3], rotation)
    with pytest.raises(InputError, match="proper 3 x 3"):
        solve_closed_form(m, m, rotation @ np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match="proper 3 x 3"):
        solve_closed_form(m, m, 1.1 * rotation)
    with pytest.raises(InputError, match="finite"):
        linear_system(np.full((5, 2), np.nan), m, rotation)


# --- all views at once ---


def series(
    rng: np.random.Generator,
    n: int,
    rotations: Array,
    optics: Optics = OPTICS,
    noise_px: float = 0.0,
    missing: float = 0.0,
) -> tuple[Tracks, Poses, Array]:
    """Tracks of random points with median height zero in view 0, which stands still."""
    xyz = rng.uniform(-25, 25, (n, 3))
    xyz -= np.median(xyz @ rotations[0, 2]) * rotations[0, 2]
    translations = np.column_stack([rng.uniform(-10, 10, (len(rotations), 2)), np.zeros(len(rotations))])
    translations[0] = 0
    xy = np.stack([project(xyz, r, t, optics) for r, t in zip(rotations, translations, strict=True)], axis=1)
    xy = xy + rng.normal(0, noise_px, xy.shape)
    xy[rng.random(xy.shape[:2]) < missing] = np.nan
    return Tracks(xy), Poses(rotations, translations), xyz


TILTS = rotations_from_tilts(np.array([0.0, 3.0, 6.0, 9.0]))
LEANS = np.stack(
    [
        CAM_FROM_VIEW @ Rotation.from_euler("xyz", a, degrees=True).as_matrix()
        for a in ([0, 2, 0], [9, 3, 40], [-4, 7, 5])
    ]
)


@pytest.mark.parametrize("rotations", [TILTS[:2], TILTS, LEANS])
@pytest.mark.parametrize("loss", ["cauchy", "squared"])
def test_exact_tracks_give_exact_translations_and_points(rotations: Array, loss: str) -> None:
    tracks, poses, xyz = series(np.random.default_rng(7), 301, rotations)
    answer = solve_series(tracks, rotations, OPTICS, loss=loss)
    np.testing.assert_allclose(answer.poses.translations_um, poses.translations_um, atol=1e-9)
    np.testing.assert_allclose(answer.xyz_um, xyz, rtol=0, atol=1e-9 * 50)
    assert answer.rank == 2 * len(rotations) - 3
    assert len(answer.gauge) == 3


def test_missing_sightings_and_lone_tracks_do_no_harm() -> None:
    tracks, poses, xyz = series(np.random.default_rng(8), 400, TILTS, missing=0.4)
    answer = solve_series(tracks, TILTS, OPTICS)
    lone = tracks.seen.sum(axis=1) < 2
    assert lone.any()
    assert np.isnan(answer.xyz_um[lone]).all()
    offset = answer.xyz_um[~lone] - xyz[~lone]  # the median is over the points that came out
    np.testing.assert_allclose(offset[:, :2], 0, atol=1e-8)
    np.testing.assert_allclose(offset[:, 2], offset[0, 2], atol=1e-8)
    moved = answer.poses.translations_um + offset[0] @ np.swapaxes(TILTS, 1, 2) * [1, 1, 0]
    np.testing.assert_allclose(moved, poses.translations_um, atol=1e-9)
    assert (answer.weights == 0).sum() == (~tracks.seen).sum()


def test_two_views_agree_with_the_pair_solution() -> None:
    tracks, _, _ = series(np.random.default_rng(9), 60, TILTS[:2], noise_px=0.5)
    joint = solve_series(tracks, TILTS[:2], OPTICS, loss="squared")
    m = centred_um(tracks.xy_px, OPTICS)
    alone = solve_closed_form(m[:, 0], m[:, 1], TILTS[1] @ TILTS[0].T, perpendicular="mean")
    np.testing.assert_allclose(joint.poses.translations_um[1, :2], alone.translation_um, atol=1e-9)
    np.testing.assert_allclose(joint.xyz_um @ TILTS[0, 2], alone.depth_um, atol=1e-8)


def test_order_of_tracks_and_views_is_immaterial() -> None:
    rng = np.random.default_rng(10)
    tracks, _, _ = series(rng, 80, TILTS, noise_px=0.4, missing=0.2)
    answer = solve_series(tracks, TILTS, OPTICS, reference=1)
    rows, order = rng.permutation(80), np.array([2, 0, 3, 1])
    other = solve_series(Tracks(tracks.xy_px[rows][:, order]), TILTS[order], OPTICS, reference=3)
    np.testing.assert_allclose(other.poses.translations_um, answer.poses.translations_um[order], atol=1e-8)
    np.testing.assert_allclose(other.xyz_um, answer.xyz_um[rows], atol=1e-7)


def test_shifting_an_image_moves_its_translation_only() -> None:
    tracks, _, _ = series(np.random.default_rng(11), 80, TILTS, noise_px=0.4)
    answer = solve_series(tracks, TILTS, OPTICS)
    shifted = solve_series(Tracks(tracks.xy_px + np.array([[0, 0], [0, 0], [5.0, -2.0], [0, 0]])), TILTS, OPTICS)
    change = (shifted.poses.translations_um - answer.poses.translations_um) / OPTICS.pixel_size_um
    np.testing.assert_allclose(change, [[0, 0, 0], [0, 0, 0], [5, -2, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(shifted.xyz_um, answer.xyz_um, atol=1e-6)


def test_wrong_matches_are_weighted_down() -> None:
    rng = np.random.default_rng(12)
    tracks, poses, _ = series(rng, 600, TILTS, noise_px=0.3)
    bad = rng.random((600, 4)) < [0, 0, 0.2, 0]
    xy = tracks.xy_px + np.where(bad[..., None], rng.uniform(10, 60, (600, 4, 2)), 0.0)
    robust, plain = (solve_series(Tracks(xy), TILTS, OPTICS, loss=loss) for loss in ("cauchy", "squared"))
    errors = [np.abs(a.poses.translations_um - poses.translations_um)[:, 1].max() for a in (robust, plain)]
    assert errors[0] / OPTICS.pixel_size_um < 0.1 < 0.5 < errors[1] / OPTICS.pixel_size_um
    assert np.median(robust.weights[bad]) < 0.05
    assert np.median(robust.weights[~bad]) > 0.8


@pytest.mark.parametrize("rotations", [TILTS[:2], TILTS[:3], TILTS, LEANS])
@pytest.mark.parametrize("loss", ["cauchy", "squared"])
def test_scale_is_the_matching_noise(rotations: Array, loss: str) -> None:
    tracks, _, _ = series(np.random.default_rng(16), 3000, rotations, noise_px=0.3, missing=0.1)
    assert 0.9 < solve_series(tracks, rotations, OPTICS, loss=loss).scale_px / 0.3 < 1.1


def test_long_tracks_bear_a_wrong_sighting_each() -> None:
    """Two of 24 sightings wrong in nearly every track: the rest of the track still counts, and so does its noise."""
    rng, rotations = np.random.default_rng(18), rotations_from_tilts(np.linspace(-30, 30, 24))
    tracks, poses, _ = series(rng, 500, rotations, noise_px=0.3)
    bad = rng.random((500, 24)) < np.linspace(0, 0.16, 24)
    xy = tracks.xy_px + np.where(bad[..., None], rng.uniform(5, 80, (500, 24, 2)), 0.0)
    answer = solve_series(Tracks(xy), rotations, OPTICS)
    assert 0.95 < answer.scale_px / 0.3 < 1.15
    error = (answer.poses.translations_um - poses.translations_um)[:, 1] / OPTICS.pixel_size_um
    assert np.abs(error).max() < 5 * 0.3 * np.sqrt(2 / 500)
    assert np.isfinite(answer.xyz_um).all()


def test_scale_does_not_vanish_where_three_views_disagree_along_one_line_only() -> None:
    tracks, _, _ = series(np.random.default_rng(17), 400, TILTS[:3])
    noise = np.random.default_rng(17).normal(0, 40, tracks.xy_px.shape) * [1.0, 0.0]
    answer = solve_series(Tracks(tracks.xy_px + noise), TILTS[:3], OPTICS)
    assert answer.scale_px > 10
    assert answer.rank == 3


@pytest.mark.parametrize(("loss", "least", "most"), [("squared", 0.87, 1.13), ("cauchy", 0.87, 1.2)])
def test_translation_noise_is_what_the_matching_noise_implies(loss: str, least: float, most: float) -> None:
    """Across the tilt every view has ``t_y = mean(m_y) - mean(m_y of view 0)``: variance 2 sigma^2 / n."""
    rng, n, sigma = np.random.default_rng(13), 40, 0.3
    errors = []
    for _ in range(150):
        tracks, poses, _ = series(rng, n, TILTS, noise_px=sigma)
        found = global_translations(tracks, TILTS, OPTICS, loss=loss)
        errors.append((found.translations_um - poses.translations_um)[1:, 1] / OPTICS.pixel_size_um)
    assert least < np.mean(np.square(errors)) / (2 * sigma**2 / n) < most


def test_perspective_tracks_come_back_exactly() -> None:
    optics = Optics(0.147, 854, 640, inverse_working_distance=1 / 5000)
    tracks, poses, xyz = series(np.random.default_rng(14), 301, TILTS, optics)
    answer = solve_series(tracks, TILTS, optics, rounds=60)
    np.testing.assert_allclose(answer.poses.translations_um, poses.translations_um, atol=1e-6)
    np.testing.assert_allclose(answer.xyz_um, xyz, atol=1e-5)
    parallel = solve_series(tracks, TILTS, OPTICS)
    assert np.nanmax(np.abs(parallel.xyz_um - xyz)) > 0.1


def test_what_cannot_be_determined_is_refused_with_a_sentence() -> None:
    tracks, _, _ = series(np.random.default_rng(15), 90, TILTS[:3])
    with pytest.raises(MethodError, match="same beam"):
        solve_series(tracks, np.stack([TILTS[0]] * 3), OPTICS)
    with pytest.raises(InputError, match="3 views, but there are 4 rotations"):
        solve_series(tracks, TILTS, OPTICS)
    pairs_only = tracks.xy_px.copy()
    pairs_only[np.arange(90), np.arange(90) % 3] = np.nan  # every track in two views: depths of pairs are not tied
    with pytest.raises(MethodError, match="three views or more"):
        solve_series(Tracks(pairs_only), TILTS[:3], OPTICS)
    with pytest.raises(MethodError, match="do not tie"):
        solve_series(Tracks(np.full((5, 3, 2), np.nan)), TILTS[:3], OPTICS)
