"""Claims on the stages of the dense method, each alone: against plain NumPy, closed forms and statistics."""

import numpy as np
import pytest
from scipy import ndimage

from semrecon.data import Optics, Poses, View
from semrecon.dense.aggregation import aggregated, best_rung
from semrecon.dense.parallax import ParallaxOptions, bending, normal_equations, refined
from semrecon.dense.pictures import Level, noise_model, noise_variance, prepared, pyramid
from semrecon.dense.sightlines import elevation, motion, place, sightlines
from semrecon.dense.smoothness import applied, edge_weights, solved
from semrecon.dense.spline import sampled, spline_of
from semrecon.dense.surface import (
    LEAST_PIXELS,
    MOST_RUNGS,
    SweepOptions,
    coarsest_level,
    narrow_sweep,
    step_height,
    swept,
    wide_sweep,
    with_walls,
    without_spikes,
)
from semrecon.dense.sweep import UNKNOWN, Ladder, correlate, matching_costs
from semrecon.dense.visibility import visible
from semrecon.geometry import CAM_FROM_VIEW, back_project, project, rotations_from_tilts

SHAPE = (60, 80)


def cameras(tilts_deg, axis_deg=0.0, shifts_um=None, k=0.0, shape=SHAPE, distortions=None):
    optics = Optics(0.5, shape[1], shape[0], k)
    shifts = np.zeros((len(tilts_deg), 3)) if shifts_um is None else np.asarray(shifts_um, dtype=float)
    poses = Poses(rotations_from_tilts(np.asarray(tilts_deg, float), axis_deg), shifts)
    distortions = np.tile(np.eye(2), (len(tilts_deg), 1, 1)) if distortions is None else distortions
    return optics, poses, sightlines(poses, distortions, optics, int(np.argmin(np.abs(tilts_deg))))


def textured(shape=SHAPE, seed=0, sigma=1.5):
    picture = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma)
    return (20 * picture / picture.std()).astype(np.float32)


def levels_of(*pictures):
    return [Level(np.asarray(one, np.float32), np.ones(one.shape, dtype=bool)) for one in pictures]


# --- geometry -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0.0, 2e-3])
@pytest.mark.parametrize("axis_deg", [0.0, 37.0, 90.0])
def test_places_are_those_of_the_projection(k, axis_deg):
    turn = 1.01 * np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]])
    distortions = np.stack([np.eye(2), turn])
    optics, poses, lines = cameras((2.0, -25.0), axis_deg, [[0, 0, 0], [1.0, -2.5, 0]], k, distortions=distortions)
    rng = np.random.default_rng(0)
    xy, h = rng.uniform(0, 50, (20, 2)), rng.uniform(-30, 30, 20)
    world = back_project(xy, -h * 0.5, poses.rotations[0], poses.translations_um[0], optics)
    ideal = project(world, poses.rotations[1], poses.translations_um[1], optics)
    expected = optics.centre_px + (ideal - optics.centre_px) @ turn.T
    up = -(world @ poses.rotations[1][2])
    for (x, y), one, want, above in zip(xy, h, expected, up, strict=True):
        np.testing.assert_allclose(place(lines.of(1), x, y, one), want, atol=1e-9)
        ahead, behind = (np.array(place(lines.of(1), x, y, one + d)) for d in (1e-4, -1e-4))
        np.testing.assert_allclose(motion(lines.of(1), x, y, one), (ahead - behind) / 2e-4, atol=1e-7)
        assert elevation(lines.of(1), x, y, one) == pytest.approx(above / 0.5, abs=1e-9)
        np.testing.assert_allclose(place(lines.of(0), x, y, one), (x, y), atol=1e-9)


def test_a_level_of_the_pyramid_sees_the_same_places():
    _, _, lines = cameras((0.0, 12.0), 20.0, [[0, 0, 0], [3.0, 1.0, 0]], 1e-3)
    half = lines.at_level(1)
    np.testing.assert_allclose(
        2 * np.array(place(half.of(1), 10.0, 7.0, 4.0)), place(lines.of(1), 20.0, 14.0, 8.0), atol=1e-12
    )


# --- pictures -------------------------------------------------------------------------------------------------------


def test_noise_that_grows_with_the_grey_value_becomes_one_unit_everywhere():
    rng = np.random.default_rng(1)
    mean = np.tile(np.linspace(40, 400, 256), (256, 1))
    image = 0.25 * rng.poisson(mean) + 12.0
    model = noise_model(image, np.ones(image.shape, dtype=bool))
    assert model.gain == pytest.approx(0.25, rel=0.15)
    noise = model.stabilised(image) - model.stabilised(0.25 * mean + 12.0)
    for part in np.array_split(noise, 4, axis=1):
        assert part.std() == pytest.approx(1.0, abs=0.12)


def test_masked_pixels_are_marked_and_filled_with_what_is_near():
    image = textured() + 100
    mask = np.ones(SHAPE, dtype=bool)
    mask[20:30, 10:40] = False
    spoilt = image.copy()
    spoilt[~mask] = 1e6
    one, other = prepared(View(image, 0.0, mask=mask)), prepared(View(spoilt, 0.0, mask=mask))
    np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(one.valid, mask)


def test_halving_keeps_pixels_in_place_and_states_the_noise_that_is_left():
    column = np.tile(np.arange(80.0, dtype=np.float32), (60, 1))
    np.testing.assert_allclose(
        pyramid(levels_of(column)[0], 1)[1].values[5, 5:-5], np.arange(40.0)[5:-5] * 2, atol=1e-4
    )
    noise = np.random.default_rng(2).normal(size=(256, 256)).astype(np.float32)
    for level, picture in enumerate(pyramid(levels_of(noise)[0], 2)):
        assert picture.values.var() == pytest.approx(noise_variance(level), rel=0.3)


def test_the_spline_is_that_of_scipy_and_its_gradient_its_derivative():
    picture = textured()
    _, _, lines = cameras((0.0, 8.0), 30.0, [[0, 0, 0], [1.3, 0.6, 0]])
    heights = 5 * np.sin(np.arange(80) / 9)[None] + np.zeros(SHAPE)
    seen = sampled(spline_of(levels_of(picture)[0]), lines, 1, heights)
    at = np.array([[place(lines.of(1), x, y, heights[y, x]) for x in range(80)] for y in range(60)])
    known = np.isfinite(seen.values)
    assert known.mean() > 0.8

    def scipy_at(du, dv):
        return ndimage.map_coordinates(picture, [at[..., 1] + dv, at[..., 0] + du], order=3, mode="mirror")

    np.testing.assert_allclose(seen.values[known], scipy_at(0, 0)[known], atol=1e-3)
    for slope, (du, dv) in ((seen.across, (0.02, 0)), (seen.down, (0, 0.02))):
        numeric = (scipy_at(du, dv) - scipy_at(-du, -dv)) / 0.04
        np.testing.assert_allclose(slope[known], numeric[known], atol=0.05)


# --- sweep ------------------------------------------------------------------------------------------------------------


def test_correlation_is_the_textbooks():
    rng = np.random.default_rng(3)
    first = rng.normal(size=(20, 24)).astype(np.float32)
    second = (first + rng.normal(size=first.shape)).astype(np.float32)
    second[5:8, 5:9] = np.nan
    out = np.empty_like(first)
    correlate(first, second, 2, 0.3, out)
    for y in range(20):
        for x in range(24):
            window = (slice(max(y - 2, 0), y + 3), slice(max(x - 2, 0), x + 3))
            a, b = first[window].astype(float), second[window].astype(float)
            both = np.isfinite(a + b)
            if both.sum() < 12.5:
                assert np.isnan(out[y, x])
                continue
            a, b = a[both] - a[both].mean(), b[both] - b[both].mean()
            expected = (a * b).mean() / np.sqrt(((a**2).mean() + 0.3) * ((b**2).mean() + 0.3))
            assert out[y, x] == pytest.approx(expected, abs=1e-5)


def test_a_hidden_view_does_not_spoil_the_cost_and_an_empty_place_costs_the_same_everywhere():
    _, _, lines = cameras((0.0, 5.0, -5.0, 8.0))
    picture = textured()
    ladder = Ladder(np.full(SHAPE, -2, dtype=np.int32), 8.0, 5)
    pictures = [picture, np.zeros(SHAPE)]  # the last one shows nothing of the specimen
    costs = matching_costs(
        levels_of(pictures[0], pictures[0], pictures[0], pictures[1]), lines, ladder, radius_px=3, noise=0.1
    )
    inside = costs[10:-10, 39:41]  # where the surface of height zero is the same picture in all views
    assert (inside.argmin(axis=2) == 2).mean() > 0.95
    assert np.median(inside[..., 2]) < 15
    blind = levels_of(*[picture] * 4)
    blind[0] = Level(picture, np.zeros(SHAPE, dtype=bool))
    assert (matching_costs(blind, lines, ladder, radius_px=3, noise=0.1) == UNKNOWN).all()


def plain_aggregation(costs, base, small, large):
    """All eight paths by the recursion as it is written."""
    rows, columns, rungs = costs.shape
    total = np.zeros(costs.shape, dtype=int)
    for dy, dx in ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)):
        path = {}
        ys = range(rows) if dy >= 0 else range(rows - 1, -1, -1)
        xs = range(columns) if dx >= 0 else range(columns - 1, -1, -1)
        for y in ys:
            for x in xs:
                before = path.get((y - dy, x - dx))
                now = costs[y, x].astype(int)
                if before is not None:
                    shift = base[y, x] - base[y - dy, x - dx]
                    for i in range(rungs):
                        choices = [before.min() + large]
                        for j, price in ((i + shift, 0), (i + shift - 1, small), (i + shift + 1, small)):
                            if 0 <= j < rungs:
                                choices.append(before[j] + price)
                        now[i] += min(choices) - before.min()
                path[y, x] = now
                total[y, x] += now
    return total


def test_aggregation_is_the_recursion_in_eight_directions_also_on_a_base_that_varies():
    rng = np.random.default_rng(4)
    costs = rng.integers(0, 256, (7, 9, 6)).astype(np.uint8)
    base = rng.integers(-3, 4, (7, 9)).astype(np.int32)
    np.testing.assert_array_equal(aggregated(costs, base, small=9, large=60), plain_aggregation(costs, base, 9, 60))


def seen_ladders(monkeypatch, ends):
    """Replace the sweep by one that says which ends of the ladder pixels choose; returns the ladders it was asked."""
    asked = []

    def sweep(levels, lines, ladder, noise, options):
        asked.append(ladder)
        shape = levels[0].values.shape
        return ladder.height(np.zeros(shape)), np.full(shape, next(ends)), np.ones(shape, dtype=bool)

    monkeypatch.setattr("semrecon.dense.surface._swept", sweep)
    return asked


def test_a_span_too_long_for_the_ladder_is_searched_in_coarser_steps_and_never_cut_off(monkeypatch):
    _, _, lines = cameras((0.0, 10.0))
    asked = seen_ladders(monkeypatch, iter([0, 0]))
    fine, level = step_height(lines, SweepOptions()), levels_of(textured())
    for span in ((-20.0, 30.0), (-700.0, 500.0)):
        wide_sweep(level, lines, span, 1.0, SweepOptions())
    short, long = asked
    assert short.step == fine
    assert long.step > fine
    assert long.rungs <= MOST_RUNGS
    for ladder, (low, high) in zip(asked, ((-20.0, 30.0), (-700.0, 500.0)), strict=True):
        assert ladder.base.min() * ladder.step <= low
        assert (ladder.base.min() + ladder.rungs - 1) * ladder.step >= high


@pytest.mark.parametrize("end", [-1, 1])
def test_a_ladder_grows_at_the_end_that_pixels_choose_but_not_without_bound(monkeypatch, end):
    _, _, lines = cameras((0.0, 10.0))
    asked = seen_ladders(monkeypatch, iter([end] * 9))
    wide_sweep(levels_of(textured()), lines, (-20.0, 30.0), 1.0, SweepOptions())
    lows = [ladder.base.min() * ladder.step for ladder in asked]
    highs = [(ladder.base.min() + ladder.rungs - 1) * ladder.step for ladder in asked]
    moved, kept = (highs, lows) if end == 1 else (lows, highs)
    assert len(asked) > 1
    assert np.ptp(kept) < 1e-9
    assert abs(moved[1]) > abs(moved[0])
    assert max(np.abs(moved)) < 0.6 * max(SHAPE) + 2 * asked[0].step  # no relief is taller than wide


@pytest.mark.parametrize(
    ("pixels", "tilt_deg", "level"),
    [(300_000, 10, 0), (300_001, 10, 1), (1_200_001, 10, 2), (300_000, 12, 1), (300_000, 30, 2), (5_000, 30, 0)],
)
def test_the_wide_sweep_is_made_at_half_the_size_for_four_times_the_pixels_or_twice_the_parallax(
    pixels, tilt_deg, level
):
    _, _, lines = cameras((0.0, tilt_deg))
    assert coarsest_level(pixels, lines, SweepOptions()) == level
    assert pixels / 4**level >= min(LEAST_PIXELS, pixels)


def test_spikes_are_taken_off_and_slopes_are_left():
    y, x = np.indices((30, 40)).astype(float)
    plane = 2 * x - 0.5 * y
    spiky = plane.copy()
    spiky[10, 12:14] += 100
    inside = slice(6, -6), slice(6, -6)
    np.testing.assert_allclose(without_spikes(plane)[inside], plane[inside], atol=1e-9)
    assert np.abs(without_spikes(spiky) - plane)[inside].max() < 2.0


STEEP_SHAPE = (100, 140)


def steep_pictures():
    """Views 30 degrees to either side of a slope of 1.2: one shows it stretched to 1.5, the other squeezed to 0.3."""
    _, _, lines = cameras((-30.0, 0.0, 30.0), 90.0, shape=STEEP_SHAPE)
    y, x = np.indices(STEEP_SHAPE).astype(float)
    heights = 1.2 * (x - 70) + 0.1 * (y - 50)
    return heights, lines, painted(heights, lines, noise=4.0)


def share_found(found, heights, lines):
    """Share of the pixels whose height is right to a pixel of parallax, but for the margin that not all views show."""
    fastest = np.linalg.norm(lines.parallax(), axis=1).max()
    return float((np.abs(found - heights) * fastest < 1)[10:-10, 45:-45].mean())


def test_windows_along_a_steep_surface_find_what_level_windows_miss():
    heights, lines, pictures = steep_pictures()
    span, options = (-95.0, 95.0), SweepOptions()
    level = share_found(wide_sweep(pictures, lines, span, 1.0, options), heights, lines)
    assert level < 0.75
    assert share_found(swept(pictures, lines, span, options), heights, lines) > level + 0.1
    rough = heights + np.random.default_rng(1).normal(size=heights.shape)
    assert share_found(narrow_sweep(pictures, lines, rough, 1.0, options), heights, lines) > 0.95


def test_a_sweep_may_end_at_a_smaller_size_and_start_from_a_plane():
    heights, lines, pictures = steep_pictures()
    found = swept(pictures, lines, (-10.0, 10.0), SweepOptions(), finest=1, plane=heights)
    assert found.shape == (50, 70)
    assert np.median(np.abs(2 * found - heights[::2, ::2])[5:-5, 22:-22]) < 1.0


def test_walls_that_were_smeared_are_drawn_anew_and_flat_ground_stays():
    step, (_, _, lines) = 12.0, cameras((-8.0, 0.0, 8.0), shape=(100, 140))
    true = np.where(np.arange(140) < 70, 0.0, step) * np.ones((100, 1))
    pictures = painted(true, lines, noise=1.0)
    views = [spline_of(picture) for picture in pictures]
    smeared = ndimage.gaussian_filter1d(true, 5.0, axis=1)
    found = with_walls(pictures, views, lines, smeared, SweepOptions(), ParallaxOptions())
    wall, ground = np.s_[10:-10, 60:80], np.s_[10:-10, 20:45]
    assert np.abs(found - true)[wall].mean() < 0.7 * np.abs(smeared - true)[wall].mean()
    np.testing.assert_allclose(found[ground], smeared[ground], atol=0.1)


def test_the_lowest_cost_is_found_between_the_rungs():
    rungs = np.arange(9.0)
    sums = np.rint(500 + 100 * (rungs - np.array([[[3.3]], [[0.0]]])) ** 2).astype(np.uint16)
    found, at_end = best_rung(sums)
    np.testing.assert_allclose(found.ravel(), [3.3, 0.0], atol=0.01)
    np.testing.assert_array_equal(at_end.ravel(), [False, True])


# --- least squares ---------------------------------------------------------------------------------------------------


def test_the_prior_ignores_planes_and_the_solver_solves():
    y, x = np.indices((12, 15))
    plane = 2.0 * x - 3.0 * y + 1
    weights = edge_weights(plane, 1.0)
    bent = np.zeros_like(weights)
    np.testing.assert_allclose(applied(np.zeros(plane.shape), weights, plane, bent), 0, atol=1e-9)
    rng = np.random.default_rng(5)
    weights, information = rng.uniform(0, 1, (2, 12, 15)), rng.uniform(0.1, 1, (12, 15))
    weights[0, :, [0, -1]] = weights[1, [0, -1]] = 0
    basis = np.eye(180).reshape(180, 12, 15)
    matrix = np.array([applied(information, weights, one, np.zeros_like(weights)).ravel() for one in basis])
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    right = rng.normal(size=(12, 15))
    found = solved(information, right, weights, np.zeros((12, 15)), 400)
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(matrix, right.ravel()), atol=1e-6)


def painted(heights, lines, seed=6, noise=0.0):
    """Views of a smooth surface painted in the reference view: each pixel's place is followed back by iteration."""
    paint = ndimage.spline_filter(textured(heights.shape, seed, 1.2).astype(float), order=3)
    surface = ndimage.spline_filter(heights, order=3)
    rng = np.random.default_rng(seed)
    y, x = np.indices(heights.shape).astype(float)
    pictures = []
    for view in range(len(lines)):
        m, c = lines.matrices[view], lines.centre_px
        flat = np.linalg.inv(m[:2, :2])
        at = np.stack([x, y])
        for _ in range(30):
            h = ndimage.map_coordinates(surface, at[::-1], order=3, prefilter=False, mode="nearest")
            p, q = x - c[0] + m[0, 2] * h - m[0, 3], y - c[1] + m[1, 2] * h - m[1, 3]
            at = np.stack([flat[0, 0] * p + flat[0, 1] * q + c[0], flat[1, 0] * p + flat[1, 1] * q + c[1]])
        picture = ndimage.map_coordinates(paint, at[::-1], order=3, prefilter=False, mode="mirror")
        pictures.append(picture + noise * rng.normal(size=heights.shape))
    return levels_of(*pictures)


def test_parallax_recovers_a_painted_surface_from_a_rough_start():
    y, x = np.indices((90, 110))
    heights = 4 * np.exp(-((x - 55) ** 2 + (y - 45) ** 2) / 600)
    _, _, lines = cameras((0.0, 6.0, 12.0), 20.0, [[0, 0, 0], [0.4, -0.3, 0], [1.1, 0.7, 0]], shape=(90, 110))
    levels = painted(heights, lines)
    splines = [spline_of(one) for one in levels]
    found = refined(splines, lines, heights + 1.5, 0.01, ParallaxOptions(rounds=10))
    error = (found - heights)[15:-15, 15:-15]
    assert np.sqrt((error**2).mean()) < 0.12  # 0.02 px of parallax


def test_normal_equations_state_the_noise_of_the_heights():
    """With no prior and the same window, noise of one unit spreads b / H as the information says."""
    _, _, lines = cameras((0.0, 8.0, -8.0), shape=(120, 160))
    levels = painted(np.zeros((120, 160)), lines, noise=1.0)
    equations = normal_equations(
        [spline_of(one) for one in levels], lines, np.zeros((120, 160)), 1.0, ParallaxOptions(likeness_px=12.0)
    )
    inside = (slice(20, -20), slice(20, -20))
    ratio = equations.right[inside].var() / equations.information[inside].mean()
    assert 0.55 < ratio < 1.1  # below 1: robust weights count noise a little less, and likeness takes some of it away


def test_a_plane_bends_the_least_and_a_rough_surface_as_much_as_it_is_high():
    options = ParallaxOptions()
    y, x = np.indices(SHAPE).astype(float)
    np.testing.assert_allclose(bending(2 * x - y, options), options.bend_px[0])
    rough = ndimage.gaussian_filter(np.random.default_rng(9).normal(size=(200, 200)), 3)
    rough /= rough.std()
    within = [np.median(bending(height * rough, options)) for height in (0.5, 1.0, 100.0)]
    assert within[1] == pytest.approx(2 * within[0], rel=1e-3)
    assert within[2] == options.bend_px[1]


def test_bending_is_the_mean_square_of_second_differences_over_its_reach():
    """Heights x^2 / 2 c have the second difference s^2 / c over s along columns and none along rows."""
    options = ParallaxOptions(bend_px=(1e-6, 1e6))
    x = np.indices(SHAPE)[1].astype(float)
    expected = 4 * (options.bend_reach_px**2 / 50 / np.sqrt(2)) / options.bend_reach_px**1.5
    np.testing.assert_allclose(bending(x**2 / 100, options)[20:-20, 30:-30], expected, rtol=1e-3)


def test_a_wall_hides_what_lies_behind_it_and_no_more():
    _, _, lines = cameras((0.0, 20.0))
    heights = np.zeros(SHAPE)
    heights[:, 30:40] = 20.0
    seen = visible(heights, lines, 1)
    shadow = 20 * np.tan(np.deg2rad(20.0))  # raised things move right: what lies right of the wall is hidden
    np.testing.assert_array_equal(seen[30, 40 : 40 + int(shadow)], False)
    assert seen[30, 40 + int(shadow) + 3 : -3].all()
    assert seen[30, 3:28].all()
    assert seen[30, 32:38].all()
    assert visible(heights, lines, 0).all()


def test_the_axes_of_view_and_camera_differ_by_half_a_turn_about_x():
    """The sign on which all heights rest: up is against the beam."""
    _, _, lines = cameras((0.0, 10.0))
    assert lines.parallax()[1, 0] == pytest.approx(np.sin(np.deg2rad(10.0)), abs=1e-9)
    np.testing.assert_array_equal(CAM_FROM_VIEW, np.diag([1.0, -1.0, -1.0]))
