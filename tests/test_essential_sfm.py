"""Claims on structure from motion by essential matrices: exact with strong perspective, frank without."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.adapt import series_from_capture
from benchmarks.judging.evaluate import cloud_score
from semrecon.data import View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import project
from semrecon.judging.gauge import gauge_residual
from semrecon.methods.essential_sfm import EssentialSfm
from semrecon.perspective.essential import EssentialOptions
from semrecon.perspective.incremental import incremental
from semrecon.perspective.pinhole import Pinholes, focal_length_px, in_series, intersect, residual_px
from semrecon.perspective.pinhole_bundle import bundle, robust_cost
from semsim.capture import simulate
from semsim.microscope import Microscope, TiltSchedule
from semsim.scenes import scene
from tests.known_surface import bump_series
from tests.pinhole_tracks import NEAR, blank_series, matches_of, scattered, seen, true_poses


def answer(noise_px):
    xyz, poses = scattered(), true_poses()
    matches = matches_of(seen(xyz, poses, NEAR, noise_px))
    return xyz, poses, EssentialSfm().from_matches(blank_series(), matches, rng=np.random.default_rng(0))


def pinholes():
    """True cameras of the tracks."""
    poses, away = true_poses(), np.array([0.0, 0.0, 1 / NEAR.inverse_working_distance])
    return Pinholes(poses.rotations, poses.translations_um + away, focal_length_px(NEAR, 10), NEAR.centre_px)


# --- the camera -------------------------------------------------------------------------------------------------


def test_a_pinhole_sees_what_the_microscope_sees():
    xyz = scattered()
    np.testing.assert_allclose(pinholes().project(xyz), seen(xyz, true_poses(), NEAR, 0.0), atol=1e-9)


def test_beams_meet_in_the_point_and_state_its_scatter():
    xyz = scattered(400)
    exact = intersect(seen(xyz, true_poses(), NEAR, 0.0), pinholes())[0]
    np.testing.assert_allclose(exact, xyz, atol=1e-8)
    found, covariance = intersect(seen(xyz, true_poses(), NEAR, 0.3), pinholes())
    square = np.einsum("ni,nij,nj->n", found - xyz, np.linalg.inv(0.3**2 * covariance), found - xyz)
    assert square.mean() == pytest.approx(3, rel=0.12)  # chi-square of three numbers, 400 times


def test_a_point_of_one_view_is_no_point():
    xy_px = seen(scattered(5), true_poses(), NEAR, 0.0)
    xy_px[2, 1:] = np.nan
    xyz, covariance = intersect(xy_px, pinholes())
    assert np.isnan(xyz[2]).all()
    assert np.isnan(covariance[2]).all()
    assert np.isfinite(np.delete(xyz, 2, axis=0)).all()


def test_the_adjustment_finds_the_least_cost():
    """From a disturbed start to the misses of the noise; the truth does not cost less."""
    xyz, cameras = scattered(), pinholes()
    xy_px = seen(xyz, true_poses(), NEAR, 0.2)
    rng = np.random.default_rng(5)
    shaken = replace(cameras, translations=cameras.translations + rng.normal(0, 3, cameras.translations.shape))
    start = xyz + rng.normal(0, 3, xyz.shape)
    found, adjusted = bundle(xy_px, start, shaken)
    assert robust_cost(xy_px, found, adjusted, 1.0) < robust_cost(xy_px, xyz, cameras, 1.0)
    assert robust_cost(xy_px, found, adjusted, 1.0) < 0.05 * robust_cost(xy_px, start, shaken, 1.0)
    rms = np.sqrt(np.mean(residual_px(xy_px, found, adjusted) ** 2) * 4 / 5)  # 8 numbers, 3 taken up: 5 are left
    assert rms == pytest.approx(0.2, rel=0.07)


# --- on tracks made for it --------------------------------------------------------------------------------------


def test_strong_perspective_without_noise_is_exact():
    """Rotations to 1e-6, points to 1e-4 um, in the unit that the pixel size sets at their median depth."""
    xyz, poses, estimate = answer(0.0)
    np.testing.assert_allclose(estimate.poses.rotations, poses.rotations, atol=1e-6)
    ratio = (1 / NEAR.inverse_working_distance) / (1 / NEAR.inverse_working_distance - np.median(xyz[:, 2]))
    expected = ratio * (xyz - [0, 0, np.median(xyz[:, 2])])  # the pixel size holds at the median depth
    np.testing.assert_allclose(estimate.points.xyz_um, expected, atol=1e-4)
    assert estimate.diagnostics["turns_deg"] == pytest.approx([0, 15, 15, 30], abs=1e-4)
    assert estimate.warnings == ()


def test_noise_comes_back_as_stated():
    """Two-sided: the noise of the sightings, and the depth errors beside their sigma."""
    xyz, poses, estimate = answer(0.3)
    assert estimate.diagnostics["sigma_px"] == pytest.approx(0.3, rel=0.07)
    assert np.abs(estimate.poses.rotations - poses.rotations).max() < 0.003
    error = gauge_residual(estimate.points.xyz_um[:, 2], xyz[:, 2], ("offset", "scale"), None, "absolute")
    ratio = 1.4826 * np.median(np.abs(error) / estimate.points.sigma_um)
    assert 0.7 < ratio < 1.4


def test_points_project_to_where_they_were_seen():
    _, _, estimate = answer(0.3)
    back = project(estimate.points.xyz_um, estimate.poses.rotations[0], estimate.poses.translations_um[0], NEAR)
    misses = np.linalg.norm(back - estimate.points.xy_px, axis=1)
    assert 0.1 < np.sqrt(np.mean(misses**2) / 2) < 0.35
    assert np.median(estimate.points.xyz_um[:, 2]) == pytest.approx(0, abs=1e-9)


def test_wrong_matches_are_left_out():
    xyz, poses = scattered(), true_poses()
    xy_px = seen(xyz, poses, NEAR, 0.2)
    wrong = np.random.default_rng(2).permutation(len(xyz)) < 60
    xy_px[wrong, 1] += np.random.default_rng(3).uniform(5, 40, (60, 2))
    estimate = EssentialSfm().from_matches(blank_series(), matches_of(xy_px), rng=np.random.default_rng(0))
    assert 230 <= len(estimate.points) <= 245
    assert np.abs(estimate.poses.rotations - poses.rotations).max() < 0.003


def test_a_view_without_enough_points_is_left_out_and_named():
    xy_px = seen(scattered(), true_poses(), NEAR, 0.1)
    matches = [one for one in matches_of(xy_px) if 3 not in one.pair]
    estimate = EssentialSfm().from_matches(blank_series(), matches, rng=np.random.default_rng(0))
    assert np.isnan(estimate.poses.rotations[3]).all()
    assert "view 3 could not be placed" in " ".join(estimate.warnings)


def test_the_frame_of_a_reconstruction_does_not_matter():
    """Turn, move and stretch cameras and points together: the answer in the series is the same."""
    options, series = EssentialOptions(), blank_series()
    matches = matches_of(seen(scattered(), true_poses(), NEAR, 0.2))
    found = incremental(series, matches, pinholes().focal_px, options, np.random.default_rng(0))
    turn, shift = true_poses().rotations[3], np.array([3.0, -2.0, 5.0])
    cameras = replace(
        found.cameras,
        rotations=found.cameras.rotations @ turn.T,
        translations=7 * (found.cameras.translations - found.cameras.rotations @ turn.T @ shift),
    )
    moved = replace(
        found, cameras=cameras, xyz=7 * (found.xyz @ turn.T + shift), covariance=49 * turn @ found.covariance @ turn.T
    )
    for a, b in zip(in_series(series, found), in_series(series, moved), strict=True):
        for name in a.__dataclass_fields__:
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-6, atol=1e-6)


# --- on pictures ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_simulated_series_of_short_working_distance_is_measured():
    """A rough face at 0.3 mm: tilts to 0.3 degrees, depths to 3 px (1.2 um) at the points, the offset alone removed."""
    whole = scene("fracture")
    near = replace(
        whole,
        microscope=Microscope(0.4, 360, 270, working_distance_um=300.0),
        schedule=TiltSchedule((-10.0, 0.0, 10.0, 20.0)),
    )
    capture = simulate(near, np.random.default_rng(3))
    series = series_from_capture(capture)
    estimate = EssentialSfm()(series, rng=np.random.default_rng(0))
    assert estimate.diagnostics["turns_deg"] == pytest.approx([10, 0, 10, 20], abs=0.3)
    score = cloud_score(estimate.points, capture.truth, 1, ("offset",)).summary
    assert 0.3 < score.median_abs_um < 1.2


def test_parallel_views_are_answered_with_a_warning():
    estimate = EssentialSfm()(bump_series(), rng=np.random.default_rng(0))
    assert np.isfinite(estimate.points.xyz_um).all()
    assert "focal length of 10 image widths" in " ".join(estimate.warnings)


def test_the_same_seed_gives_the_same_answer_and_the_input_stays():
    series = bump_series()
    before = [view.image.copy() for view in series.views]
    one, two = (EssentialSfm()(series, rng=np.random.default_rng(7)) for _ in range(2))
    assert np.array_equal(one.points.xyz_um, two.points.xyz_um)
    assert np.array_equal(one.heights.z_um, two.heights.z_um, equal_nan=True)
    assert all(np.array_equal(a, view.image) for a, view in zip(before, series.views, strict=True))


@pytest.mark.parametrize("spoiled", ["black", "saturated", "equal", "small", "rows"])
def test_bad_views_are_answered_or_refused_in_a_sentence(spoiled):
    images = [view.image.copy() for view in bump_series().views]
    if spoiled in {"black", "saturated"}:
        images[1] = np.full_like(images[1], 0 if spoiled == "black" else 255)
    elif spoiled == "equal":
        images[1] = images[0].copy()
    elif spoiled == "small":
        images = [np.ascontiguousarray(image[20:84, 40:104]) for image in images]
    else:
        images = [image.astype(np.float32) for image in images]
        images[1][30] = np.nan
    series = bump_series()
    views = tuple(View(image, v.tilt_deg, v.name) for image, v in zip(images, series.views, strict=True))
    optics = replace(series.optics, height_px=images[0].shape[0], width_px=images[0].shape[1])
    spoilt = replace(series, views=views, optics=optics)
    if spoiled in {"black", "saturated"}:
        with pytest.raises(MethodError, match=r"bump_1\.tif is blank"):
            EssentialSfm()(spoilt, rng=np.random.default_rng(0))
        return
    with suppress(MethodError):
        assert np.isfinite(EssentialSfm()(spoilt, rng=np.random.default_rng(0)).points.xyz_um).all()


def test_what_cannot_be_is_said():
    with pytest.raises(MethodError, match="two views"):
        EssentialSfm()(bump_series().select(0), rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="focal_widths"):
        EssentialSfm(focal_widths=0.0)(bump_series(), rng=np.random.default_rng(0))
