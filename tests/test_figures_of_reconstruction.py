"""Claims on the summary page: whatever the result, it draws without warnings, nothing overlaps, numbers are right."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_surface import KnowsTheBump, bump_series
from matplotlib.axes import Axes
from matplotlib.transforms import Bbox
from PIL import Image
from scipy.stats import kstest

from semrecon.data import Estimate, HeightMap, Optics, PointCloud, Poses, SurfaceMesh, TiltSeries, View
from semrecon.geometry import rotations_from_tilts
from semrecon.numerics.robust import fit_noise
from semrecon.output.charts import APART_DEG, labelled, opening
from semrecon.output.figures import DPI, WIDTH, draw_page, write_summary
from semrecon.output.glance import (
    block_means,
    expected_density,
    facts,
    in_words,
    pair_matrices,
    region_medians,
    tilts_of,
    view_tilts,
    warning_lines,
)
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import Reconstruction

RNG = np.random.default_rng(7)
SENTENCE = "a.tif and b.tif do not fit the stated geometry: along the tilt axis they differ in magnification by 1 %"


def made_up(
    views: int = 4, shape: tuple[int, int] = (90, 120), *, known: bool = True, dense: bool = False
) -> Reconstruction:
    """A result with all that a refining method states, or with nothing but NaN."""
    rows, columns = shape
    tilts = np.linspace(-9, 21, views)
    nan = np.nan if not known else 1.0
    series = TiltSeries(
        tuple(
            View(RNG.integers(0, 255, shape, dtype=np.uint8), float(t), name=f"a_$long${i}_name_of_a_file.tif")
            for i, t in enumerate(tilts)
        ),
        Optics(0.1, columns, rows),
        30.0,
    )
    n = 500
    xy = RNG.uniform(0, 1, (n, 2)) * [columns - 1, rows - 1] * nan
    covariance = np.tile(0.01 * np.eye(3), (n, 1, 1)) * nan
    points = PointCloud(RNG.normal(size=(n, 3)) * nan, covariance, RNG.rayleigh(0.3, n) * nan, xy)
    sigma = np.full(shape, 0.1 if dense else np.nan) * nan
    sigma[::7, ::7] = 0.2 * nan
    found = tilts + np.linspace(-0.3, 0.3, views)
    diagnostics = {
        "sigma_px": 0.3,
        "tracks_by_views": {"2": 300, "3": 200},
        "pairs": [
            {"views": [i, j], "matches": 100, "sigma_across_px": 0.4 + 0.01 * i}
            for i, j in combinations(range(views), 2)
        ],
        "refinement": {"tilt_sigma_deg": np.full(views, 0.05), "tilt_axis_deg": 31.0, "tilt_axis_sigma_deg": 0.02},
    }
    poses = Poses(rotations_from_tilts(found, 31.0) * nan, np.zeros((views, 3)))
    estimate = Estimate(poses=poses, diagnostics=diagnostics if known else {})
    heights = HeightMap(RNG.normal(size=shape) * nan, sigma, 0.1)
    mesh = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    return Reconstruction(series, "made_up", {}, estimate, points, heights, mesh, (SENTENCE,) * (9 if known else 0))


def empty(result: Reconstruction) -> Reconstruction:
    """The same without a single point."""
    return replace(result, points=result.points.keep(np.zeros(len(result.points), dtype=bool)))


CASES = {
    "two views": made_up(2),
    "forty views": made_up(40),
    "portrait": made_up(7, (200, 120)),
    "very wide": made_up(3, (40, 400)),
    "two rows": made_up(3, (2, 40)),
    "dense": made_up(5, dense=True),
    "nothing but NaN": made_up(known=False),
    "no points": empty(made_up()),
    "no points, no words": empty(made_up(known=False)),
    "finer than a panel": made_up(3, (500, 900)),
}


@pytest.fixture(scope="module", params=CASES, ids=str)
def case(request: pytest.FixtureRequest) -> Reconstruction:
    return CASES[request.param]


def test_nothing_overlaps_and_nothing_leaves_the_page(case: Reconstruction) -> None:
    figure = draw_page(case)
    figure.draw_without_rendering()
    page = figure.bbox
    parts = [(axes, box) for axes in figure.axes for box in parts_of(axes)]
    parts += [(text, text.get_window_extent()) for text in figure.texts]
    out = [b for _, b in parts if min(b.x0, b.y0, page.width - b.x1, page.height - b.y1) < 0]
    assert out == []
    pairs = ((a, b) for (one, a), (other, b) in combinations(parts, 2) if one is not other)
    assert [(a, b) for a, b in pairs if overlap_px(a, b) > 2] == []


def parts_of(axes: Axes) -> list[Bbox]:
    """What of a panel takes space: its frame, labels and words; where it has no frame its words alone."""
    words = [*axes.texts, axes.title, axes._left_title]
    parts = [text.get_window_extent() for text in words if text.get_text()]
    if axes.axison:
        parts += [axes.get_window_extent(), *(axis.get_tightbbox() for axis in (axes.xaxis, axes.yaxis))]
    return [part for part in parts if part is not None]


def overlap_px(a: Bbox, b: Bbox) -> float:
    """Lesser side of what two boxes share."""
    return min(min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0))


def test_a_page_with_strange_names_is_written(tmp_path: Path) -> None:
    result = made_up()
    views = tuple(replace(view, name="花粉_$x_{1$.tif") for view in result.series.views)
    write_summary(replace(result, series=replace(result.series, views=views)), tmp_path / "summary.png")
    with Image.open(tmp_path / "summary.png") as page:
        assert page.width == round(WIDTH * DPI)


def test_a_page_of_a_real_result_holds_its_facts() -> None:
    result = reconstruct(bump_series(), KnowsTheBump())
    words = " ".join(text.get_text() for text in draw_page(result).texts)
    for name, value in facts(result):
        assert name in words
        assert value in words
    assert "a sentence from the method" in words


@given(st.floats(-80, 80), st.floats(-180, 180))
def test_a_tilt_comes_back_from_its_pose(tilt: float, axis: float) -> None:
    poses = Poses(rotations_from_tilts(np.array([tilt]), axis), np.zeros((1, 3)))
    np.testing.assert_allclose(tilts_of(poses, axis), [tilt], atol=1e-9)


def test_tilts_found_stand_beside_those_stated() -> None:
    tilts = view_tilts(made_up(4))
    np.testing.assert_allclose(tilts.found_deg - tilts.stated_deg, [-0.3, -0.1, 0.1, 0.3], atol=1e-9)
    np.testing.assert_array_equal(tilts.sigma_deg, 0.05)
    assert (tilts.axis_deg, tilts.axis_stated_deg, tilts.refined) == (31.0, 30.0, True)


def test_the_alignment_of_a_dense_method_is_read_as_well() -> None:
    result = made_up(4)
    said = dict(result.estimate.diagnostics)
    alignment = {"sigma_px": 0.3, **said.pop("refinement")}
    dense = replace(result, estimate=replace(result.estimate, diagnostics={"alignment": alignment}))
    assert view_tilts(dense).axis_found_deg == 31.0
    np.testing.assert_array_equal(view_tilts(dense).sigma_deg, 0.05)
    assert ("residuals", f"median {np.median(result.points.residual_px):.2g} px, matching noise 0.3 px") in facts(dense)


def test_sigmas_of_other_views_are_not_taken_for_these() -> None:
    result = made_up(4)
    estimate = replace(result.estimate, diagnostics={"alignment": {"tilt_sigma_deg": [0.1, 0.1, 0.1]}})
    assert np.isnan(view_tilts(replace(result, estimate=estimate)).sigma_deg).all()


def test_without_poses_the_tilts_are_those_stated() -> None:
    result = made_up(4)
    tilts = view_tilts(replace(result, estimate=Estimate()))
    np.testing.assert_array_equal(tilts.best_deg, result.series.tilts_deg)
    assert not tilts.refined
    assert tilts.axis_deg == 30.0


@pytest.mark.parametrize("tilts", [np.arange(-9.0, 10, 3), np.linspace(-60, 60, 40), np.array([40.0, 40.5])])
def test_labels_of_beams_keep_apart_and_the_reference_has_one(tilts: np.ndarray) -> None:
    angles = tilts * opening(tilts)
    chosen = labelled(angles, 1)
    assert chosen[0] == 1
    assert np.diff(np.sort(angles[chosen])).min(initial=np.inf) >= APART_DEG
    assert np.abs(angles).max() <= 60


def test_expected_residuals_are_those_of_noise() -> None:
    """Residuals of points seen 2, 3 and 5 times, drawn as triangulation leaves them, follow the curve."""
    views = np.repeat([2, 3, 5], [2000, 3000, 1000])
    residual = 0.3 * np.sqrt(RNG.chisquare(2 * views - 3) / views)
    r = np.linspace(1e-6, 3, 20000)
    density = expected_density(r, 0.3, {"2": 2000, "3": 3000, "5": 1000})
    cumulative = np.cumsum(density) * (r[1] - r[0])
    assert cumulative[-1] == pytest.approx(1, abs=1e-3)
    assert kstest(residual, lambda x: np.interp(x, r, cumulative)).pvalue > 1e-3
    assert fit_noise(residual, views).sigma_px == pytest.approx(0.3, rel=0.05)  # the noise that the curve is given


def test_regions_hold_the_median_of_their_points() -> None:
    xy = RNG.uniform(0, [119, 89], (1000, 2))
    values = RNG.normal(size=1000)
    values[::10] = np.nan
    medians, edge = region_medians(xy, values, (90, 120))
    inside = (np.floor((xy + 0.5) / edge) == [2, 1]).all(axis=1)
    assert medians[1, 2] == np.nanmedian(values[inside])
    assert medians.shape == (np.ceil(90 / edge), np.ceil(120 / edge))


def test_regions_without_points_are_missing() -> None:
    medians, _ = region_medians(np.empty((0, 2)), np.empty(0), (90, 120))
    assert np.isnan(medians).all()


def test_blocks_average_what_is_known() -> None:
    values = np.arange(15.0).reshape(3, 5)
    values[0, 0] = np.nan
    values[2, 4] = np.nan
    np.testing.assert_allclose(block_means(values, 2), [[4.0, 5.0, 6.5], [10.5, 12.5, np.nan]])
    np.testing.assert_array_equal(block_means(values, 1), values)


def test_warnings_are_whole_and_the_rest_is_counted() -> None:
    warnings = [f"{SENTENCE}, number {i}" for i in range(9)]
    lines = warning_lines(warnings, 60, 7)
    assert len(lines) <= 8
    assert max(map(len, lines)) <= 60
    shown = " ".join(line.strip() for line in lines)
    whole = [warning for warning in warnings if warning in shown]
    assert 0 < len(whole) < 9
    assert lines[-1].strip() == f'… and {9 - len(whole)} more, under "warnings" in report.json'
    assert shown.count(SENTENCE) == len(whole)
    assert warning_lines([], 60, 7) == []


def test_a_long_warning_is_shown_all_the_same() -> None:
    assert " ".join(SENTENCE.split()) in " ".join(line.strip() for line in warning_lines([SENTENCE], 30, 1))


@pytest.mark.parametrize("pairs", [None, 3, [(0, 1)], [{"views": [0, 1]}], []])
def test_pairs_that_say_nothing_are_none(pairs: object) -> None:
    result = made_up()
    estimate = replace(result.estimate, diagnostics={"pairs": pairs})
    assert pair_matrices(replace(result, estimate=estimate)) is None


def test_angles_are_never_minus_zero() -> None:
    assert [in_words(angle) for angle in (-0.001, 0.0, -0.016, 3.0)] == ["0.00", "0.00", "-0.02", "3.00"]
