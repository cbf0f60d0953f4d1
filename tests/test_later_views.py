"""Claims on later views: an odd orientation is found within its sigma, in any order, and a failure is a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_surface import KnowsTheBump, bump_series
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from benchmarks.adapt import series_from_capture
from semrecon.data import Array, Image, Optics
from semrecon.errors import InputError
from semrecon.geometry import project, rotations_from_tilts
from semrecon.matches.features import FeatureOptions, Features, detect_features
from semrecon.matches.matching import MatchOptions, match_exhaustively
from semrecon.matches.unguided_matching import match_all
from semrecon.methods import method_named
from semrecon.numerics.motion import rotation_angle_rad
from semrecon.pipeline import reconstruct
from semrecon.pose.later_views import LaterView, LaterViewOptions, later_views_report, pose_later_views
from semrecon.pose.magnified_pose import fit_pose
from semrecon.reconstruction import Reconstruction
from semsim.capture import prepare, simulate
from semsim.microscope import Microscope, TiltSchedule
from semsim.scenes import scene

TURN_DEG, ODD_TILT_DEG, ODD_AXIS_DEG = 20.0, 10.0, 60.0
OPTICS = Optics(0.2, 400, 300)


def turned(image: Image) -> tuple[Image, Array]:
    """An image turned in its plane about the centre, and the rotation of the camera that does the same."""
    rotation = Rotation.from_euler("z", TURN_DEG, degrees=True).as_matrix()
    centre = (np.array(image.shape[::-1]) - 1) / 2
    rows, columns = np.indices(image.shape)
    xy = (np.stack([columns, rows], axis=-1) - centre) @ rotation[:2, :2] + centre
    grey = map_coordinates(image.astype(float), [xy[..., 1], xy[..., 0]], order=3, mode="reflect")
    return grey.clip(0, np.iinfo(image.dtype).max).astype(image.dtype), rotation


@pytest.fixture(scope="module")
def world() -> tuple[Reconstruction, list[tuple[str, Image]], list[Array]]:
    """A reconstruction of three tilts, two later images of the same specimen, and their true rotations."""
    base = replace(scene("fracture"), microscope=Microscope(5 / 24, 640, 480))
    straight = replace(base, schedule=TiltSchedule((0.0, 6.0, 12.0)))
    odd = replace(base, schedule=TiltSchedule((ODD_TILT_DEG, -8.0), ODD_AXIS_DEG))
    series = series_from_capture(simulate(straight, 1, prepare(straight)))
    images = simulate(odd, 2, prepare(odd)).images
    first, spin = turned(images[0])
    rotations = rotations_from_tilts(np.array([ODD_TILT_DEG, -8.0]), ODD_AXIS_DEG)
    result = reconstruct(series, method_named("known_rotation"))
    return result, [("odd.tif", first), ("tilted.tif", images[1])], [spin @ rotations[0], rotations[1]]


@pytest.fixture(scope="module")
def found(world: tuple[Reconstruction, list[tuple[str, Image]], list[Array]]) -> tuple[LaterView, ...]:
    return pose_later_views(world[0], world[1], np.random.default_rng(0))


@pytest.mark.slow
def test_an_odd_orientation_is_found(
    world: tuple[Reconstruction, list[tuple[str, Image]], list[Array]], found: tuple[LaterView, ...]
) -> None:
    for view, rotation in zip(found, world[2], strict=True):
        assert view.pose is not None, view.failure
        error_deg = np.rad2deg(rotation_angle_rad(view.pose.rotation @ rotation.T))
        assert error_deg < 0.3
        assert error_deg < 6 * np.linalg.norm(view.sigma_deg)  # errors that points share are not in the sigma
        assert view.sigma_deg.max() < 0.3
        assert view.inliers >= 60
        assert view.magnification == pytest.approx(1, abs=0.005)
        assert view.warnings == ()


@pytest.mark.slow
def test_the_order_of_images_does_not_matter(
    world: tuple[Reconstruction, list[tuple[str, Image]], list[Array]], found: tuple[LaterView, ...]
) -> None:
    back = pose_later_views(world[0], world[1][::-1], np.random.default_rng(0))[::-1]
    for one, other in zip(found, back, strict=True):
        assert one.pose is not None
        assert other.pose is not None
        np.testing.assert_array_equal(one.pose.rotation, other.pose.rotation)


@pytest.mark.slow
def test_new_points_lie_on_the_surface(
    world: tuple[Reconstruction, list[tuple[str, Image]], list[Array]], found: tuple[LaterView, ...]
) -> None:
    heights = world[0].heights
    points = [view.points.xyz_um for view in found if view.points is not None]
    xyz = np.concatenate(points)
    at = project(xyz, world[0].estimate.poses.rotations[0], np.zeros(3), world[0].series.optics)  # type: ignore[union-attr]
    z_um = map_coordinates(heights.z_um, at[:, ::-1].T, order=1, cval=np.nan)
    error = np.abs(xyz[:, 2] - z_um)
    assert np.isfinite(error).sum() >= 5
    assert np.nanmedian(error) < 1.5  # of 20 um and more of relief, between points of 0.3 um


@pytest.mark.slow
def test_the_report_is_plain(found: tuple[LaterView, ...]) -> None:
    said = later_views_report(found)
    assert json.loads(json.dumps(said, allow_nan=False)) == said
    assert [one["image"] for one in said] == ["odd.tif", "tilted.tif"]


def test_what_cannot_be_posed_says_why() -> None:
    result = reconstruct(bump_series(), KnowsTheBump())
    noise = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    blank, strange = pose_later_views(
        result, [("blank.tif", np.zeros((9, 9), np.uint8)), ("noise.tif", noise)], np.random.default_rng(0)
    )
    assert "blank.tif is blank" in blank.failure
    assert "noise.tif" in strange.failure
    assert (blank.pose, strange.pose) == (None, None)
    assert [set(one) for one in later_views_report([blank, strange])] == [{"image", "failure"}] * 2
    with pytest.raises(InputError, match="one grey image"):
        pose_later_views(result, [("colour.tif", np.zeros((9, 9, 3), np.uint8))], np.random.default_rng(0))
    with pytest.raises(InputError, match="pixel size"):
        pose_later_views(result, [("n.tif", noise)], np.random.default_rng(0), LaterViewOptions(pixel_size_um=-1.0))


def sightings(seed: int, magnification: float, wrong: float = 0.3) -> tuple[Array, Array, Array, Array, Array]:
    """Noisy points with covariance, sightings of a view of any orientation, its rotation, which are right."""
    rng = np.random.default_rng(seed)
    n, sigma = 200, np.array([0.06, 0.06, 0.5])
    truth = rng.uniform(-30, 30, (n, 3)) * [1, 1, 0.4]
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    xy = project(truth, rotation, np.zeros(3), replace(OPTICS, pixel_size_um=OPTICS.pixel_size_um / magnification))
    xy += rng.normal(0, 0.4, xy.shape)
    good = rng.uniform(size=n) > wrong
    xy[~good] = rng.uniform(0, 300, (int((~good).sum()), 2))
    return truth + rng.normal(size=truth.shape) * sigma, xy, np.tile(np.diag(sigma**2), (n, 1, 1)), rotation, good


@pytest.mark.slow
def test_pose_and_noise_are_calibrated() -> None:
    squares, noises, scales = [], [], []
    for seed in range(12):
        xyz, xy, covariance, rotation, _ = sightings(seed, 1.0)
        fit = fit_pose(xyz, xy, covariance, OPTICS, 1.0, np.random.default_rng(seed), trials=40)
        turn = Rotation.from_matrix(rotation @ fit.pose.rotation.T).as_rotvec()
        squares.append(turn @ np.linalg.solve(fit.pose.covariance[:3, :3], turn) / 3)
        noises.append(fit.pose.sigma_px / 0.4)
        scales.append((fit.magnification - 1) / fit.magnification_sigma)
        assert fit.warnings == ()
    assert 0.45 < np.mean(squares) < 1.75  # 36 numbers: one sigma is 0.24
    assert np.mean(noises) == pytest.approx(1, abs=0.08)
    assert 0.35 < np.mean(np.square(scales)) < 2.2  # 12 numbers: one sigma is 0.41


@pytest.mark.parametrize("magnification", [1.01, 1.3])
def test_another_magnification_is_found_and_said(magnification: float) -> None:
    xyz, xy, covariance, rotation, good = sightings(5, magnification)
    # features look larger by the magnification, known to a few percent
    fit = fit_pose(xyz, xy, covariance, OPTICS, magnification * 1.01, np.random.default_rng(0), trials=60)
    assert fit.magnification == pytest.approx(magnification, abs=5 * fit.magnification_sigma)
    assert fit.magnification_sigma < 0.005
    assert fit.optics.pixel_size_um == pytest.approx(OPTICS.pixel_size_um / magnification, rel=0.01)
    assert rotation_angle_rad(fit.pose.rotation @ rotation.T) < np.deg2rad(1.5)
    assert any("magnification" in sentence for sentence in fit.warnings)
    assert fit.inliers[good].mean() > 0.95


def test_unguided_matching_equals_the_reference() -> None:
    view = bump_series().views[0]
    options = FeatureOptions(upright=False)
    first, second = (detect_features(one, options) for one in (view, bump_series().views[1]))
    fast, slow = (match(first, second, MatchOptions()) for match in (match_all, match_exhaustively))
    np.testing.assert_array_equal(fast.index1, slow.index1)
    np.testing.assert_array_equal(fast.index2, slow.index2)
    nothing = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32), np.zeros(0, np.int64))
    assert len(match_all(first, nothing, MatchOptions())) == 0
    assert len(match_all(nothing, first, MatchOptions())) == 0


@pytest.mark.slow
def test_a_real_view_left_out_is_posed_where_the_refined_series_has_it(real_data: Path) -> None:
    from semrecon.input.intake import take_in

    series = take_in([real_data / "potamogeton" / f"pot_0{i}.tif" for i in range(7)]).series
    part = reconstruct(series.select(0, 1, 2, 3, 4, 6), method_named("known_rotation", refine=True))
    (view,) = pose_later_views(part, [("pot_05.tif", series.views[5].image)], np.random.default_rng(0))
    assert view.pose is not None, view.failure
    assert part.estimate.poses is not None
    relative = view.pose.rotation @ part.estimate.poses.rotations[3].T
    assert np.rad2deg(rotation_angle_rad(relative)) == pytest.approx(6.07, abs=0.1)  # as the series calibrates itself
