"""Claims on predicting a view left out: a wrong surface predicts worse, and nothing but the surface is judged."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from click.testing import Result
from known_surface import PIXEL_UM, KnowsTheBump, bump_series, bump_um, grid_um
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shifted
from scipy.stats import spearmanr
from typer.testing import CliRunner

from benchmarks.adapt import series_from_capture
from semrecon.agreement.left_out import LeftOut, leave_out, predict, without
from semrecon.agreement.left_out_camera import Sight, sight_of, visible
from semrecon.agreement.left_out_report import FILE, rows_of, table
from semrecon.agreement.left_out_score import Prediction, Score, commonly_known, score
from semrecon.agreement.left_out_windows import noise_left, smoothed
from semrecon.cli import app
from semrecon.data import Array, Estimate, HeightMap, Optics, SurfaceMesh, TiltSeries
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, tilt_rotation
from semrecon.input.intake import take_in
from semrecon.input.series import write_series
from semrecon.methods import METHODS, method_named
from semrecon.reconstruction import Reconstruction
from semsim.capture import Capture, simulate
from semsim.microscope import Microscope, TiltSchedule
from semsim.scenes import scene

TILTS = (-10.0, 0.0, 5.0, 10.0)
BUMP_TILTS = (-8.0, -4.0, 0.0, 4.0, 8.0)
NO_MESH = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def made(z_um: Array, used: TiltSeries, name: str = "made") -> Reconstruction:
    """A reconstruction that answers given heights and no poses."""
    heights = HeightMap(z_um, np.full_like(z_um, 0.1), used.optics.pixel_size_um)
    estimate = Estimate(heights=heights)
    return Reconstruction(used, name, {}, estimate, estimate, heights, NO_MESH)  # type: ignore[arg-type]  # no points


@lru_cache
def captured(name: str) -> Capture:
    made_of = replace(scene(name), microscope=Microscope(0.5, 128, 96), schedule=TiltSchedule(TILTS))
    return simulate(made_of, 30_001)


def roughness(shape: tuple[int, ...], seed: int = 0) -> Array:
    rough = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return np.asarray(rough / rough.std())


def scores_of(series: TiltSeries, view: int, surfaces: dict[str, Array]) -> dict[str, Score]:
    """Scores of surfaces over the pixels that all of them predict."""
    used = without(series, view)
    found = {name: predict(made(z_um, used, name), series.views[view]).prediction for name, z_um in surfaces.items()}
    among = commonly_known(list(found.values()))
    assert among.mean() > 0.4
    return {name: score(one, among) for name, one in found.items()}


def wrong_surfaces(z_um: Array, pixel_um: float) -> dict[str, Array]:
    x_um = np.indices(z_um.shape)[1] * pixel_um
    return {
        "deeper": 1.3 * z_um,
        "shallower": 0.7 * z_um,
        "tilted": z_um + np.tan(np.deg2rad(4)) * x_um,
        "inside_out": -z_um,
        "rough": z_um + roughness(z_um.shape),
    }


@pytest.mark.parametrize(("name", "view"), [("plane", 3), ("step", 0)])
def test_the_true_surface_predicts_best(name: str, view: int) -> None:
    series, z_um = series_from_capture(captured(name)), captured(name).truth.height_map(1)
    found = scores_of(series, view, {"true": z_um, **wrong_surfaces(z_um, series.optics.pixel_size_um)})
    true = found.pop("true")
    for wrong, other in found.items():
        assert other.local_ncc < true.local_ncc - 0.002, wrong
        assert other.ncc < true.ncc, wrong
        assert other.rms_grey > true.rms_grey, wrong
        assert other.median_grey > true.median_grey, wrong
    assert found["inside_out"].local_ncc < 0.75 * true.local_ncc


def test_the_order_by_prediction_is_the_order_by_true_error() -> None:
    series, z_um = series_from_capture(captured("wedge")), captured("wedge").truth.height_map(1)
    errors = {f"rough {size}": size * roughness(z_um.shape, 1) for size in (0.0, 0.7, 1.4, 2.8)}
    errors |= {f"wavy {size}": size * gaussian_filter(roughness(z_um.shape, 2), 8) * 12 for size in (0.5, 1.0, 3.0)}
    found = scores_of(series, 3, {name: z_um + error for name, error in errors.items()})
    true_um = [float(np.median(np.abs(error - np.median(error)))) for error in errors.values()]
    assert spearmanr(true_um, [-one.local_ncc for one in found.values()]).statistic > 0.85
    assert spearmanr(true_um, [one.rms_grey for one in found.values()]).statistic > 0.85
    for kind in ("rough", "wavy"):
        graded = [one.local_ncc for name, one in found.items() if name.startswith(kind)]
        assert graded == sorted(graded, reverse=True)


def bump(view: int, **changes: object) -> LeftOut:
    series = bump_series(BUMP_TILTS)
    left_out = replace(series.views[view], **changes)  # type: ignore[arg-type]
    return predict(made(bump_um(*grid_um()), without(series, view)), left_out)


def test_gain_and_offset_of_the_view_left_out_do_not_count() -> None:
    image = bump_series(BUMP_TILTS).views[3].image.astype(np.float64)
    plain, other = (score(bump(3, image=one).prediction) for one in (image, 0.4 * image + 37))
    assert (other.ncc, other.local_ncc, other.share) == pytest.approx(
        (plain.ncc, plain.local_ncc, plain.share), abs=1e-6
    )
    for name in ("rms_grey", "median_grey", "contrast_grey"):
        assert asdict(other)[name] == pytest.approx(0.4 * asdict(plain)[name], rel=1e-4)
    ramp = np.linspace(0.7, 1.3, image.shape[1])
    slow = score(bump(3, image=ramp * image).prediction)
    assert slow.local_ncc == pytest.approx(plain.local_ncc, abs=0.003)
    assert slow.rms_grey < 0.05 * slow.contrast_grey
    assert plain.rms_grey < 0.05 * plain.contrast_grey  # no noise, no shading: the picture is predicted


@pytest.mark.parametrize("planted_px", [(0.0, 0.0), (3.37, -1.62), (-24.7, 17.2)])
def test_a_drift_is_found_and_does_not_count(planted_px: tuple[float, float]) -> None:
    still = bump(4)
    image = shifted(bump_series(BUMP_TILTS).views[4].image.astype(float), planted_px[::-1], order=5, mode="reflect")
    moved = bump(4, image=image)
    np.testing.assert_allclose(moved.in_plane.shift_px - still.in_plane.shift_px, planted_px, atol=0.03)
    np.testing.assert_allclose(still.in_plane.shift_px, 0, atol=0.05)
    assert score(moved.prediction).local_ncc == pytest.approx(score(still.prediction).local_ncc, abs=0.01)


def test_noise_is_told_from_error() -> None:
    rng, sigma = np.random.default_rng(8), 9.0
    clean = bump_series(BUMP_TILTS)
    views = tuple(replace(v, image=v.image + rng.normal(0, sigma, v.image.shape)) for v in clean.views)
    series, z_um = replace(clean, views=views), bump_um(*grid_um())
    right = score(predict(made(z_um, without(series, 3)), series.views[3]).prediction)
    assert right.noise_grey == pytest.approx(right.rms_grey, rel=0.08)
    # between columns interpolation leaves 0.57 to 1 of the variance; the paint is a mean of four
    assert np.sqrt(0.57 * 1.25) * sigma < right.rms_grey < 1.02 * np.sqrt(1.25) * sigma
    assert right.rms_beyond_grey < 0.45 * sigma
    wrong = score(predict(made(1.6 * z_um, without(series, 3)), series.views[3]).prediction)
    assert wrong.rms_beyond_grey > 2 * right.rms_beyond_grey


def test_residuals_of_known_noise_are_that_noise() -> None:
    rng, shape = np.random.default_rng(9), (200, 260)
    picture = 100 + 30 * roughness(shape, 4)
    predicted, true = picture + rng.normal(0, 2, shape), 3 * picture + rng.normal(0, 4, shape)
    found = score(Prediction(predicted, true, np.full(shape, 4.0), np.full(shape, 16.0)))
    assert found.rms_grey == pytest.approx(np.hypot(4, 6), rel=0.02)
    assert found.noise_grey == pytest.approx(np.hypot(4, 6), rel=0.02)
    assert found.median_grey == pytest.approx(0.6745 * found.rms_grey, rel=0.03)
    assert found.ncc == pytest.approx(1 / np.sqrt((1 + 4 / 900) * (1 + 16 / 8100)), abs=0.001)
    assert found.contrast_grey == pytest.approx(np.hypot(90, np.hypot(4, 0)), rel=0.05)


def test_what_interpolation_leaves_of_noise() -> None:
    assert noise_left(np.zeros((1, 2)))[0] == pytest.approx(1)
    image = np.random.default_rng(3).normal(size=(300, 300))
    for phase in ((0.5, 0.5), (0.25, 0.0), (0.1, 0.7)):
        moved = shifted(image, [-phase[1], -phase[0]], order=3, mode="mirror")[20:-20, 20:-20]
        assert noise_left(np.array(phase)) == pytest.approx(moved.var(), rel=0.03)


def test_a_window_over_gaps_is_a_mean_of_what_is_there() -> None:
    valid = np.random.default_rng(2).random((90, 120)) > 0.4
    image = np.where(valid, 7.0, np.nan)
    for sigma_px in (2.0, 40.0):
        np.testing.assert_allclose(smoothed(image, valid, sigma_px), 7.0, rtol=1e-6)


def test_a_block_hides_what_lies_in_its_shade() -> None:
    optics, tilt_deg, height_px = Optics(PIXEL_UM, 160, 60), 30.0, 20.0
    z_um = np.zeros((60, 160))
    z_um[:, 60:80] = height_px * PIXEL_UM
    sight: Sight = sight_of(z_um, CAM_FROM_VIEW @ tilt_rotation(tilt_deg) @ CAM_FROM_VIEW, optics)
    seen = visible(sight.xy_px, sight.elevation_px)[30]
    inside = np.flatnonzero((sight.xy_px[30, :, 0] > 0) & (sight.xy_px[30, :, 0] < 159))
    hidden = np.setdiff1d(inside, np.flatnonzero(seen))
    # what is raised moves right, over a strip of height times tangent on its right
    assert hidden.min() >= 78
    assert hidden.max() <= 80 + height_px * np.tan(np.deg2rad(tilt_deg)) + 1
    assert hidden.size == pytest.approx(height_px * np.tan(np.deg2rad(tilt_deg)), abs=3)
    z_um[:, 60:80] = np.nan
    sight = sight_of(z_um, CAM_FROM_VIEW @ tilt_rotation(tilt_deg) @ CAM_FROM_VIEW, optics)
    around = visible(sight.xy_px, sight.elevation_px)[30]
    assert not around[60:80].any()  # without a height nothing is seen, and nothing hidden
    assert around[80:120].all()


def test_turning_everything_turns_the_prediction() -> None:
    series, z_um = bump_series(BUMP_TILTS), bump_um(*grid_um())
    optics = Optics(PIXEL_UM, series.optics.height_px, series.optics.width_px)
    views = tuple(replace(view, image=np.rot90(view.image, -1)) for view in series.views)
    turned = TiltSeries(views, optics, tilt_axis_deg=90.0)
    plain = predict(made(z_um, without(series, 1)), series.views[1])
    other = predict(made(np.rot90(z_um, -1), without(turned, 1)), turned.views[1])
    known = plain.prediction.known & np.rot90(other.prediction.known)
    assert known.mean() > 0.95 * plain.prediction.known.mean()
    gap = np.rot90(other.prediction.predicted) - plain.prediction.predicted
    assert np.abs(gap[known]).max() < 3
    assert score(other.prediction).local_ncc == pytest.approx(score(plain.prediction).local_ncc, abs=1e-3)


def test_leaving_out_pixels_gains_nothing() -> None:
    plain = bump(3).prediction
    gap = np.abs(plain.predicted - plain.true)
    easy = replace(plain, predicted=np.where(gap > np.nanmedian(gap), np.nan, plain.predicted))
    among = commonly_known([plain, easy])
    assert score(easy).rms_grey < score(plain).rms_grey  # what is its own alone looks better
    assert score(easy).share < 0.55 * score(plain).share
    assert score(easy, among) == score(plain, among)


def test_few_pixels_have_no_score() -> None:
    plain = bump(3).prediction
    found = score(replace(plain, predicted=np.full_like(plain.predicted, np.nan)))
    assert found.share == 0
    assert np.isnan([found.ncc, found.local_ncc, found.rms_grey, found.rms_beyond_grey]).all()


def test_a_blank_view_is_said_and_a_masked_view_paints_nothing() -> None:
    with pytest.raises(InputError, match=r"bump_3\.tif has no pixel to predict"):
        bump(3, image=np.full_like(bump_series(BUMP_TILTS).views[3].image, 9))
    series = bump_series(BUMP_TILTS)
    dark = replace(series.views[0], mask=np.zeros(series.optics.shape, dtype=bool))
    masked = replace(series, views=(dark, *series.views[1:]))
    found = predict(made(bump_um(*grid_um()), without(masked, 4)), series.views[4])
    fewer = predict(made(bump_um(*grid_um()), series.select(1, 2, 3)), series.views[4])
    np.testing.assert_allclose(found.prediction.predicted, fewer.prediction.predicted)


@dataclass(frozen=True)
class Remembers(KnowsTheBump):
    """Keep what a method is given."""

    given: ClassVar[list[TiltSeries]] = []
    name: ClassVar[str] = "remembers"

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        self.given.append(series)
        return super().__call__(series, rng=rng)


@pytest.mark.parametrize("view", [2, 4])
def test_a_method_never_sees_the_view_left_out(view: int) -> None:
    series = bump_series(BUMP_TILTS)
    Remembers.given.clear()
    (found,) = leave_out(series, view, [Remembers(points=True)])
    assert isinstance(found, LeftOut)
    (given,) = Remembers.given
    assert [one.name for one in given.views] == [one.name for one in series.views if one is not series.views[view]]
    assert found.view == series.views[view].name
    assert np.isfinite(found.prediction.predicted).mean() > 0.8  # the points of a sparse method are filled in


def test_a_failure_is_a_row_with_a_sentence() -> None:
    series = bump_series(BUMP_TILTS)
    found = leave_out(series, 3, [KnowsTheBump(heights=True), KnowsTheBump(fails=True)])
    rows = rows_of("bump_3.tif", 4.0, ["right", "broken"], found)
    assert rows[0].common == rows[0].own
    assert rows[1].common is None
    assert "only 3 matches" in rows[1].failure
    text = table(rows)
    assert "broken: only 3 matches" in text
    assert text.startswith("bump_3.tif (4 degrees) left out; all methods predict ")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("left_out") / "series"
    write_series(bump_series(BUMP_TILTS), path)
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr("semrecon.methods.METHODS", (*METHODS, KnowsTheBump(heights=True)))
    return ["--methods", "knows_the_bump"]


def test_the_command_tells_and_writes(folder: Path, quick: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("predict", folder, *quick, "--leave-out", "1,view_03.tif", "--out", out)
    assert result.exit_code == 0, result.output
    assert "knows_the_bump" in result.stdout
    content = json.loads((out / FILE).read_text())
    assert [row["tilt_deg"] for row in content["rows"]] == [-4.0, 4.0]
    assert all(row["common"]["local_ncc"] > 0.98 for row in content["rows"])
    assert content["fitted"] == "shift"
    (out / "mine.txt").write_text("mine")
    again = run("predict", folder, *quick, "--leave-out", "1", "--out", out)
    assert (again.exit_code, (out / "mine.txt").read_text()) == (2, "mine")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--methods", "guess"], "no method 'guess'"),
        (["--methods", ","], "names no method"),
        (["--leave-out", "5"], "numbers from 0 to 4"),
        (["--leave-out", "nobody.tif"], "view_00.tif"),
        (["--fit", "tilt"], "--fit knows shift and similarity, not 'tilt'"),
        (["--tilts", "1,2"], "--tilts has 2 angles for 5 images"),
    ],
)
def test_bad_input_is_one_sentence(folder: Path, options: list[str], sentence: str) -> None:
    result = run("predict", folder, *options)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert result.stdout == ""


def test_two_views_and_no_answer_are_said(quick: list[str], tmp_path: Path) -> None:
    write_series(bump_series((0.0, 6.0)), tmp_path / "two")
    result = run("predict", tmp_path / "two", *quick)
    assert result.exit_code == 2
    assert "takes three views or more, not 2" in result.stderr
    write_series(bump_series((0.0, 6.0, 12.0)), tmp_path / "three")
    none = run("predict", tmp_path / "three", "--methods", "photometric_stereo", "--leave-out", "1")
    assert none.exit_code == 2
    assert "no method predicts anything; photometric_stereo: " in none.stderr


def test_one_view_cannot_be_left_out_of_two() -> None:
    with pytest.raises(InputError, match="three views or more"):
        leave_out(bump_series((0.0, 6.0)), 1, [KnowsTheBump()])


@pytest.mark.slow
def test_methods_are_ordered_as_by_their_true_errors() -> None:
    name, view = "wedge", 3
    made_of = replace(scene(name), schedule=TiltSchedule(TILTS))
    capture = simulate(made_of, 30_002)
    series, names = series_from_capture(capture), ("dense_multiview", "known_rotation", "disparity")
    found = leave_out(series, view, [method_named(one) for one in names])
    rows = rows_of("view", TILTS[view], names, found)
    local = {row.method: row.common.local_ncc for row in rows if row.common is not None}
    rms = {row.method: row.common.rms_grey for row in rows if row.common is not None}
    assert local["dense_multiview"] > local["known_rotation"] > local["disparity"]
    assert rms["dense_multiview"] < rms["known_rotation"] < rms["disparity"]


@pytest.mark.slow
def test_a_real_view_is_predicted_better_by_dense_heights(real_data: Path) -> None:
    intake = take_in(sorted((real_data / "potamogeton").glob("*.tif")))
    size, top, left = 512, 700, 500
    views = tuple(
        replace(v, image=v.image[top : top + size, left : left + size], mask=None) for v in intake.series.views
    )
    series = replace(intake.series, views=views, optics=replace(intake.series.optics, width_px=size, height_px=size))
    names = ("dense_multiview", "known_rotation")
    rows = rows_of("view", 3.0, names, leave_out(series, 4, [method_named(one) for one in names]))
    dense, sparse = (row.common for row in rows)
    assert dense is not None
    assert sparse is not None
    assert dense.local_ncc > sparse.local_ncc
    assert dense.rms_grey < sparse.rms_grey
