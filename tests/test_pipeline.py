"""Claims on the recipe: what is missing is completed, a seed fixes every bit, a hopeless series is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_surface import PIXEL_UM, KnowsTheBump, bump_series, bump_um, grid_um

from semrecon.data import Estimate, HeightMap, PointCloud, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import nominal_poses, project
from semrecon.output.maps import hillshade, round_length
from semrecon.pipeline import reconstruct


def test_points_get_a_mesh_and_its_heights() -> None:
    result = reconstruct(bump_series(), KnowsTheBump())
    x, y = grid_um()
    error = result.heights.z_um - bump_um(x, y)
    assert result.completeness > 0.85
    assert np.nanmax(np.abs(error)) < 0.06  # linear between points 0.8 um apart: h^2/8 times the curvature, 2/9 a um
    assert len(result.mesh.faces) > 400


def test_heights_get_a_point_a_pixel_that_projects_back_to_it() -> None:
    series = bump_series((5.0, 12.0))
    result = reconstruct(series, KnowsTheBump(points=False, heights=True))
    pose = nominal_poses(series)
    xy = project(result.points.xyz_um, pose.rotations[0], pose.translations_um[0], series.optics)
    np.testing.assert_allclose(xy, result.points.xy_px, atol=1e-9)
    rows, columns = result.points.xy_px[:, 1].astype(int), result.points.xy_px[:, 0].astype(int)
    height = -(result.points.xyz_um @ pose.rotations[0].T + pose.translations_um[0])[:, 2]
    np.testing.assert_allclose(height, result.heights.z_um[rows, columns], atol=1e-9)
    along_beam = np.einsum("i,nij,j->n", pose.rotations[0][2], result.points.covariance_um2, pose.rotations[0][2])
    np.testing.assert_allclose(np.sqrt(along_beam), result.heights.sigma_um[rows, columns])
    assert len(result.points) == np.isfinite(result.heights.z_um).sum()


def test_an_answer_with_both_is_kept() -> None:
    result = reconstruct(bump_series(), KnowsTheBump(heights=True))
    assert result.points is result.estimate.points
    assert result.heights is result.estimate.heights


def test_same_seed_same_bits_and_another_seed_others() -> None:
    one, two, other = (reconstruct(bump_series(), KnowsTheBump(), seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.heights.z_um, two.heights.z_um)
    np.testing.assert_array_equal(one.points.covariance_um2, two.points.covariance_um2)
    assert not np.array_equal(one.points.covariance_um2, other.points.covariance_um2)


def test_stages_are_told_and_timed() -> None:
    told: list[str] = []
    result = reconstruct(bump_series(), KnowsTheBump(), progress=told.append)
    assert told == ["knows_the_bump", "surface"]
    assert list(result.seconds) == told
    assert all(seconds >= 0 for seconds in result.seconds.values())


def test_perspective_is_warned_of_where_it_outweighs_the_noise() -> None:
    near = reconstruct(bump_series(), KnowsTheBump(), working_distance_um=500)
    far = reconstruct(bump_series(), KnowsTheBump(), working_distance_um=50_000)
    assert any("perspective" in sentence for sentence in near.warnings)
    assert not any("perspective" in sentence for sentence in far.warnings)


def test_perspective_that_is_modelled_needs_no_warning() -> None:
    series = bump_series()
    series = replace(series, optics=replace(series.optics, inverse_working_distance=1 / 500))
    result = reconstruct(series, KnowsTheBump(points=False, heights=True), working_distance_um=500)
    assert not any("perspective" in sentence for sentence in result.warnings)


@pytest.mark.parametrize(
    ("tilts", "sentence"), [((3.0,), "one image"), ((3.0, 3.0), "all 2 images have the tilt 3 degrees")]
)
def test_series_without_parallax_are_refused(tilts: tuple[float, ...], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        reconstruct(bump_series(tilts), KnowsTheBump())


def test_a_blank_image_is_refused() -> None:
    series = bump_series((0.0, 6.0))
    blank = View(np.full((120, 160), 7, dtype=np.uint8), 9.0, name="empty.tif")
    with pytest.raises(InputError, match=r"empty\.tif is blank"):
        reconstruct(TiltSeries((*series.views, blank), series.optics), KnowsTheBump())


def test_more_views_than_a_method_takes_are_refused() -> None:
    view = bump_series((0.0, 1.0))
    many = TiltSeries(tuple(replace(view.views[i % 2], tilt_deg=float(i)) for i in range(10)), view.optics)
    with pytest.raises(InputError, match="takes 2 to 9 views, not 10"):
        reconstruct(many, KnowsTheBump())


def test_an_empty_answer_is_a_failure_of_the_method() -> None:
    class FindsNothing(KnowsTheBump):
        def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
            empty = np.empty((0, 3))
            return Estimate(points=PointCloud(empty, np.empty((0, 3, 3)), np.empty(0), np.empty((0, 2))))

    with pytest.raises(MethodError, match="no point"):
        reconstruct(bump_series(), FindsNothing())


def test_an_inclined_plane_is_shaded_by_the_cosine_of_its_normal() -> None:
    x, y = grid_um()
    for slope_x, slope_y in [(0.0, 0.0), (0.5, 0.0), (0.0, -0.4)]:
        normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
        flat, up = np.cos(np.deg2rad(55)) * np.sqrt(0.5), np.sin(np.deg2rad(55))
        sun = np.array([-flat, flat, up])  # upper left: from -x, +y
        np.testing.assert_allclose(hillshade(slope_x * x + slope_y * y, PIXEL_UM), normal @ sun, atol=1e-9)


@pytest.mark.parametrize(("length", "rounded"), [(1.0, 1.0), (4.99, 2.0), (5.0, 5.0), (0.031, 0.02), (980.0, 500.0)])
def test_scale_bars_are_round(length: float, rounded: float) -> None:
    assert round_length(length) == pytest.approx(rounded)


def test_summary_of_a_surface_without_sigma(tmp_path: object) -> None:
    from pathlib import Path

    from semrecon.output.figures import write_summary

    class NoSigma(KnowsTheBump):
        def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
            z = bump_um(*grid_um())
            return Estimate(heights=HeightMap(z, np.full_like(z, np.nan), PIXEL_UM))

    result = reconstruct(bump_series(), NoSigma())
    assert np.isnan(result.median_sigma_um)
    path = Path(str(tmp_path)) / "summary.png"
    write_summary(result, path)
    assert path.stat().st_size > 10_000
