"""Claims on the methods: a known surface comes back, units and signs carry through, and nothing bad goes unsaid."""

from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import ndimage

from semrecon.data import Estimate, Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import project, rotations_from_tilts
from semrecon.matches.correspondence import CorrespondenceOptions, match_adjacent_pairs
from semrecon.methods import METHODS, Disparity, DisparityIcp, KnownRotation, method_named
from semrecon.numerics.history import histories

OPTICS = Optics(0.1, 220, 180)
SHIFTS_PX = np.array([[0.0, 0.0], [4.25, -9.5], [-7.0, 3.5], [11.0, 6.25]])


def height_um(x, y):
    """A dome of 3 um with ripples, 20 um across; no slope beyond 0.8."""
    return 3 * np.exp(-(x**2 + 1.3 * y**2) / 40) + 0.2 * np.sin(1.1 * x + 0.4) * np.cos(0.9 * y) - 1.0


def rendered(tilts_deg, axis_deg=0.0, *, seed=0, optics=OPTICS, noise=6.0):
    """Pictures of a painted surface: every pixel's ray is followed to the surface, whose paint is a B-spline."""
    rng = np.random.default_rng(seed)
    size, step = 400, 0.08
    paint = ndimage.gaussian_filter(rng.normal(size=(size, size)), 1.5)
    paint += 2 * ndimage.gaussian_filter(rng.normal(size=(size, size)), 4)
    paint = 120 + 40 * paint / paint.std()
    columns, rows = np.meshgrid(np.arange(optics.width_px), np.arange(optics.height_px))
    pixels = np.stack([columns, rows], axis=-1)
    views = []
    rotations = rotations_from_tilts(np.asarray(tilts_deg, float), axis_deg)
    for i, (rotation, tilt) in enumerate(zip(rotations, tilts_deg, strict=True)):
        camera = (pixels - optics.centre_px - SHIFTS_PX[i]) * optics.pixel_size_um
        flat, z = np.linalg.inv(rotation[:2, :2]), np.zeros(optics.shape)
        for _ in range(30):
            xy = (camera - z[..., None] * rotation[:2, 2]) @ flat.T
            z = height_um(xy[..., 0], xy[..., 1])
        at = np.stack([xy[..., 1], xy[..., 0]]) / step + size / 2
        image = ndimage.map_coordinates(paint, at, order=5) + rng.normal(0, noise, optics.shape)
        views.append(View(image, float(tilt), f"view_{i}.tif"))
    return TiltSeries(tuple(views), optics, axis_deg)


@lru_cache
def scene(axis_deg=0.0, tilts_deg=(0.0, 6.0, 12.0)):
    return rendered(tilts_deg, axis_deg)


@lru_cache
def adjacent_matches():
    return match_adjacent_pairs(scene(), CorrespondenceOptions(), np.random.default_rng(0))


def answer(method, series, seed=0):
    return method(series, rng=np.random.default_rng(seed))


def depth_error_um(points):
    error = points.xyz_um[:, 2] - height_um(points.xyz_um[:, 0], points.xyz_um[:, 1])
    return error - np.median(error)


def scale_of(points):
    """Slope of measured against true heights: 1 where the depth is right, 0.5 where it is halved."""
    truth = height_um(points.xyz_um[:, 0], points.xyz_um[:, 1])
    near = np.abs(depth_error_um(points)) < 3
    return np.polyfit(truth[near], points.xyz_um[near, 2], 1)[0]


# --- known rotation ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis_deg", [0.0, 90.0, 30.0, -120.0])
def test_known_rotation_recovers_the_surface_about_any_axis(axis_deg):
    estimate = answer(KnownRotation(), scene(axis_deg))
    error = depth_error_um(estimate.points)
    assert len(estimate.points) > 1000
    assert 0.04 < np.median(np.abs(error)) < 0.09  # 0.12 px of noise, 7 px of depth a px of it for 12 degrees
    assert estimate.diagnostics["sigma_px"] == pytest.approx(0.12, rel=0.2)
    assert scale_of(estimate.points) == pytest.approx(1.0, abs=0.03)
    grid_x, grid_y = (np.arange(220) - 109.5) * 0.1, -(np.arange(180) - 89.5) * 0.1
    gap = estimate.heights.z_um - height_um(*np.meshgrid(grid_x, grid_y))
    known = np.isfinite(gap)
    assert known.mean() > 0.8
    assert np.median(np.abs(gap[known] - np.median(gap[known]))) < 0.08


def test_known_rotation_states_its_noise_and_its_poses():
    estimate = answer(KnownRotation(), scene())
    error = depth_error_um(estimate.points) / estimate.points.sigma_um
    spread = 1.4826 * np.median(np.abs(error))
    assert 0.6 < spread < 1.6  # two-sided: neither boasting nor hiding
    rotations = rotations_from_tilts(scene().tilts_deg)
    np.testing.assert_array_equal(estimate.poses.rotations, rotations)
    # the shift across the axis is observable; that along it goes with the height of the origin
    shift_y = estimate.poses.translations_um[:, 1] / 0.1
    np.testing.assert_allclose(shift_y, SHIFTS_PX[:3, 1], atol=0.02)
    sighting = project(estimate.points.xyz_um, rotations[0], estimate.poses.translations_um[0], OPTICS)
    seen = np.isfinite(estimate.points.xy_px).all(axis=1)
    off = np.linalg.norm(sighting - estimate.points.xy_px, axis=1)[seen]
    assert np.median(off) < 0.3
    found = estimate.diagnostics
    assert found["tracks"] == len(estimate.points) + found["rejected"]
    assert sum(found["tracks_by_views"].values()) == found["tracks"]
    assert set(found["features"]) == {"view_0.tif", "view_1.tif", "view_2.tif"}


def test_wrong_matches_are_rejected_by_their_reprojection_error():
    rng = np.random.default_rng(3)
    spoilt = []
    for one in adjacent_matches():
        xy2 = one.matches.xy2_px.copy()
        wrong = rng.permutation(len(xy2)) < 0.05 * len(xy2)
        xy2[wrong, 1] += rng.choice([-1, 1], int(wrong.sum())) * 8.0
        spoilt.append(replace(one, matches=replace(one.matches, xy2_px=xy2)))
    clean, estimate = (KnownRotation().from_matches(scene(), m) for m in (adjacent_matches(), tuple(spoilt)))
    left_out = [one.diagnostics["rejected"] + one.diagnostics["sightings_left_out"] for one in (clean, estimate)]
    extra = left_out[1] - left_out[0]
    assert extra > 0.02 * estimate.diagnostics["tracks"]
    assert np.median(np.abs(depth_error_um(estimate.points))) < 1.2 * np.median(np.abs(depth_error_um(clean.points)))


def test_the_published_form_gives_clouds_in_their_first_views_frames():
    series = scene()
    estimate = KnownRotation(merge="icp").from_matches(series, adjacent_matches())
    assert estimate.pairs == ((0, 1), (1, 2))
    for cloud in estimate.clouds:
        centred = (cloud.xy_px - OPTICS.centre_px) * [0.1, -0.1]
        off = cloud.xyz_um[:, :2] - centred
        assert np.abs(off[:, 0]).max() < 1e-9  # an epipolar mismatch moves points along the axis alone
        assert np.abs(off[:, 1]).max() < 0.2
    assert len(estimate.points) == sum(len(cloud) for cloud in estimate.clouds)
    assert np.median(np.abs(depth_error_um(estimate.points))) < 0.25
    assert estimate.diagnostics["registration_rmse_um"] > 0
    (told,) = histories(estimate.diagnostics)
    assert told["stage"] == "ICP, pair 1-2 to the pair before"
    assert told["residual_px"][-1] == pytest.approx(estimate.diagnostics["registration_rmse_um"] / 0.1)


def test_registration_takes_the_reference_view_as_origin_wherever_it_stands():
    for tilts in ((-6.0, 0.0, 6.0), (-12.0, -6.0, 0.0)):
        series = rendered(tilts)
        estimate = answer(DisparityIcp("boyde"), series)
        reference = series.reference
        # the painted surface was shifted in the reference view, whose centre is the origin now
        moved = estimate.points.xyz_um - np.append(SHIFTS_PX[reference] * [0.1, -0.1], 0)
        error = moved[:, 2] - height_um(moved[:, 0], moved[:, 1])
        assert np.median(np.abs(error - np.median(error))) < 0.25


# --- disparity ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("variant", "scale"), [("printed", 0.5), ("symmetric", 1.0), ("boyde", 1.0)])
def test_the_printed_formula_halves_the_depth_and_the_others_do_not(variant, scale):
    estimate = Disparity(variant).from_matches(scene(), adjacent_matches())
    z = estimate.points.xyz_um[:, 2]
    truth = height_um(estimate.points.xyz_um[:, 0], estimate.points.xyz_um[:, 1])
    slope = np.polyfit(truth, z, 1)[0]
    assert slope == pytest.approx(scale, abs=0.05)


def test_disparity_put_right_and_known_rotation_agree_on_a_pair():
    series = scene().select(0, 1)
    matches = adjacent_matches()[:1]
    right = Disparity("boyde").from_matches(series, matches).points.xyz_um[:, 2]
    known = KnownRotation(merge="icp", reject_sigmas=np.inf).from_matches(series, matches).points.xyz_um[:, 2]
    assert len(known) == len(right)
    gap = known - right
    np.testing.assert_allclose(gap - np.median(gap), 0, atol=1e-9)


def test_disparity_is_seen_from_the_reference_view():
    series = rendered((-6.0, 0.0))
    estimate = answer(Disparity("boyde"), series)
    moved = estimate.points.xyz_um - np.append(SHIFTS_PX[1] * [0.1, -0.1], 0)
    error = moved[:, 2] - height_um(moved[:, 0], moved[:, 1])
    assert np.median(np.abs(error - np.median(error))) < 0.2


# --- methods that work on sparse matches; what holds for all methods stands in test_contract.py ----------------------

EVERY = [KnownRotation(), Disparity(), DisparityIcp(), KnownRotation(merge="icp")]
every_method = pytest.mark.parametrize("method", EVERY, ids=lambda m: "-".join(str(v) for v in _label(m)))


def _label(method):
    return [method.name, *(v for v in vars(method).values() if isinstance(v, str))]


@every_method
def test_the_same_seed_gives_the_same_bits_and_the_input_stays(method):
    series = scene()
    before = [view.image.copy() for view in series.views]
    one, other = answer(method, series), answer(method, series)
    np.testing.assert_array_equal(one.points.xyz_um, other.points.xyz_um)
    np.testing.assert_array_equal(one.heights.z_um, other.heights.z_um)
    for view, image in zip(series.views, before, strict=True):
        np.testing.assert_array_equal(view.image, image)


@every_method
def test_lengths_scale_with_the_pixel_size(method):
    small, large = scene(), replace(scene(), optics=replace(OPTICS, pixel_size_um=0.2))
    one, other = answer(method, small).points, answer(method, large).points
    # ICP's stopping rule has a length in it, so that registered clouds scale only to about that length
    registered = "icp" in (method.name[-3:], getattr(method, "merge", ""))
    np.testing.assert_allclose(other.xyz_um, 2 * one.xyz_um, atol=5e-3 if registered else 1e-8)
    np.testing.assert_allclose(np.median(other.sigma_um), 2 * np.median(one.sigma_um), rtol=1e-3)


@every_method
def test_the_wrong_sign_of_the_tilts_turns_the_relief_inside_out(method):
    right = scene()
    wrong = replace(right, views=tuple(replace(view, tilt_deg=-view.tilt_deg) for view in right.views))
    one, other = answer(method, right).points, answer(method, wrong).points
    np.testing.assert_allclose(other.xyz_um, one.xyz_um * [1, 1, -1], atol=1e-6)


def flat(value):
    return np.full(OPTICS.shape, value, dtype=np.uint8)


def spoilt(case):
    series = scene()
    first, second, third = series.views
    if case == "black":
        return replace(series, views=(first, replace(second, image=flat(0)), third))
    if case == "saturated":
        return replace(series, views=(replace(first, image=flat(255)), second, third))
    if case == "mostly saturated":
        return replace(series, views=(first, replace(second, image=np.clip(second.image, 0, 60)), third))
    if case == "NaN row":
        broken = second.image.copy()
        broken[100:103] = np.nan
        return replace(series, views=(first, replace(second, image=broken), third))
    if case == "all NaN":
        return replace(series, views=(first, second, replace(third, image=np.full(OPTICS.shape, np.nan))))
    if case == "identical":
        return replace(series, views=(first, replace(first, tilt_deg=3.0)))
    if case == "equal tilts":
        return replace(series, views=(first, replace(second, tilt_deg=0.0)))
    if case == "unrelated":
        return replace(series, views=(first, replace(rendered((6.0,), seed=9).views[0])))
    if case == "noise":
        noise = np.random.default_rng(1).normal(size=(2, *OPTICS.shape))
        return replace(series, views=(replace(first, image=noise[0]), replace(second, image=noise[1])))
    if case == "masked":
        return replace(series, views=(first, replace(second, mask=np.zeros(OPTICS.shape, dtype=bool)), third))
    if case == "perspective":
        return replace(series, optics=replace(OPTICS, inverse_working_distance=1e-5))
    small = Optics(0.1, 64, 64)
    views = tuple(replace(view, image=view.image[60:124, 70:134]) for view in series.views)
    return TiltSeries(views, small)


ANSWERED = {"NaN row", "identical"}
REFUSED = {"black", "saturated", "all NaN", "equal tilts", "unrelated", "noise", "masked"}


@every_method
@pytest.mark.parametrize("case", sorted(ANSWERED | REFUSED | {"mostly saturated", "perspective", "64 x 64"}))
def test_bad_input_gives_an_answer_or_a_sentence(method, case):
    if case in REFUSED:
        with pytest.raises(MethodError, match=r"view_[012]\.tif.{20}") as caught:
            answer(method, spoilt(case))
        assert "\n" not in str(caught.value)
        return
    with nullcontext() if case in ANSWERED else suppress(MethodError):
        estimate = answer(method, spoilt(case))
        assert isinstance(estimate, Estimate)
        assert np.isfinite(estimate.points.xyz_um).all()
        assert np.isfinite(estimate.heights.z_um).any()


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_every_method_says_what_it_is(method):
    assert method_named(method.name) == method
    assert method_named(method.name.replace("_", "-")) == method
    assert method.citation
    assert method.views[0] >= 1
    assert len({one.name for one in METHODS}) == len(METHODS)


def test_options_are_set_by_name_and_misspelt_ones_are_named():
    assert method_named("disparity", variant="boyde") == Disparity("boyde")
    with pytest.raises(InputError, match="no method 'shape'; the methods are dense_multiview, known_rotation"):
        method_named("shape")
    with pytest.raises(InputError, match="no option 'varient'; its options are variant"):
        method_named("disparity", varient="boyde")


def test_one_view_is_refused():
    with pytest.raises(InputError, match="at least two views"):
        answer(KnownRotation(), scene().select(0))


def test_a_pair_that_does_not_fit_the_stated_geometry_is_warned_of():
    series = scene()
    zoom, centre = 1.01, (np.array(OPTICS.shape) - 1) / 2
    larger = ndimage.affine_transform(series.views[1].image, np.eye(2) / zoom, centre - centre / zoom, order=5)
    wrong = replace(series, views=(series.views[0], replace(series.views[1], image=larger)))
    (warning,) = answer(KnownRotation(), wrong).warnings
    assert "view_0.tif and view_1.tif" in warning
    assert "1.0" in warning
    assert answer(KnownRotation(), series).warnings == ()
