"""Sweeps: axes do what they say, noise is paired, the machinery is that of `run`, and pages say what is in the rows."""

from __future__ import annotations

import csv
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.running.bench import contenders
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.sweeping.sweep_axes import AXES, Axis, axis_named
from benchmarks.sweeping.sweep_figures import draw_sweep
from benchmarks.sweeping.sweep_summary import curves, interval, slope, sweep_markdown, write_sweep_csv
from benchmarks.sweeping.sweeps import Sweep, Swept, Theory, base_scene, offered, read_sweep, run_sweep
from semrecon.errors import InputError
from semsim.scene import Scene
from semsim.scenes import scene
from tests.small_grain import GRAIN, close_cell


@pytest.fixture
def base(tmp_path: Path):
    return base_scene("plane", tmp_path / "cache", columns=96, purpose="reporting", channels=False)


def changed(name: str, value: float, of: str = "pollen") -> Scene:
    return axis_named(name, [value]).at(scene(of), value)


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_every_axis_changes_the_scene_and_keeps_its_name(axis: Axis) -> None:
    variants = [axis.at(scene("pollen"), value) for value in axis.values]
    assert len({repr(each) for each in variants}) == len(axis.values)
    assert {each.name for each in variants} == {"pollen"}  # so that the noise of a repetition is the same


@pytest.mark.parametrize(
    ("name", "off"),
    [
        ("tilt", 9.0),
        ("dose", 200.0),
        ("tilt-error", 0.0),
        ("spot", 0.7),
        ("drift", 0.0),
        ("views", 4),
        ("texture", 0.05),
    ],
)
def test_an_axis_at_the_present_value_photographs_the_same(name: str, off: float) -> None:
    was, now = scene("pollen"), changed(name, off)
    np.testing.assert_allclose(now.schedule.tilts_deg, was.schedule.tilts_deg, atol=1e-12)
    still = replace(now, schedule=was.schedule, stage_errors=was.stage_errors)
    assert still == was
    assert not any(now.stage_errors.tilts_deg)


def test_what_the_axes_set() -> None:
    assert changed("tilt", 18).schedule.tilts_deg == pytest.approx((0, 6, 12, 18))
    assert changed("tilt", 4, "pyramid").schedule.tilts_deg == pytest.approx((-2, 0, 2))
    assert changed("views", 3).schedule.tilts_deg == pytest.approx((0, 4.5, 9))
    assert changed("tilt-error", 0.3).stage_errors.tilts_deg == pytest.approx((0, 0.1, 0.2, 0.3))
    assert changed("tilt-error", 0.3, "pyramid").stage_errors.tilts_deg == pytest.approx((-0.3, 0, 0.3))
    assert changed("magnification", 2).view_errors.magnifications == pytest.approx((0, 2e-3 / 3, 4e-3 / 3, 2e-3))
    assert changed("pixel-size", scene("pollen").microscope.pixel_size_um * 2).microscope.width_px == 427
    assert changed("perspective", 5).microscope.working_distance_um == 5000


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("doze", (), "there is no sweep 'doze'"),
        ("spot.sigma_px", (), "has no values of its own"),
        ("dose", (float("nan"),), "must be finite"),
    ],
)
def test_an_axis_that_cannot_be_is_a_sentence(name: str, values: tuple[float, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        axis_named(name, values)


@pytest.mark.parametrize(
    ("name", "value", "of", "said"),
    [
        ("dose", -1, "pollen", "sweep dose at -1"),
        ("tilt", 8, "translation", "differ in tilt"),
        ("views", 2.5, "pollen", "whole views"),
        ("pixel-size", 0, "pollen", "positive"),
        ("perspective", -2, "pollen", "positive"),
        ("spot.nothing", 1, "pollen", "spot.nothing"),
    ],
)
def test_a_value_that_cannot_be_is_a_sentence(name: str, value: float, of: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        changed(name, value, of)


def test_a_base_scene_has_the_width_asked_for_and_offers_what_it_has(tmp_path: Path, base) -> None:
    assert base.source.scene.microscope.width_px == 96
    assert base.offers == ("pixel_size", "tilt_axis", "rotations")
    with_channels = base_scene("grains", tmp_path, columns=128, purpose="reporting", channels=True)
    assert set(with_channels.offers) == {"pixel_size", "tilt_axis", "channels", "rotations", "perspective"}
    for purpose, seed in (("reporting", 0), ("development", 1)):
        scene_of = base_scene("plane", tmp_path, columns=64, purpose=purpose, channels=False).source.scene
        assert (scene_of.name, scene_of.specimen_seed) == (f"plane-{purpose}", seed)
    assert "stage_path" in offered(scene("translation"))
    with pytest.raises(Exception, match="neither a TOML file nor a scene"):
        base_scene("nowhere", tmp_path, columns=128, purpose="reporting", channels=False)


def test_points_are_all_combinations_with_the_noise_of_the_base(base) -> None:
    axes = (axis_named("dose", [50, 200]), axis_named("spot", [0.5, 1.0, 2.0]))
    points = Sweep(base, axes, (), 1).points
    assert [point.values for point in points][:4] == [(50, 0.5), (50, 1.0), (50, 2.0), (200, 0.5)]
    assert len({point.scene.name for point in points}) == len({point.scene.identity for point in points}) == 6
    assert {point.scene.seed(3) for point in points} == {base.seed(3)}
    assert {point.scene.source.name for point in points} == {base.source.name}


def test_a_sweep_runs_goes_on_and_is_told(tmp_path: Path) -> None:
    (tmp_path / "grain.toml").write_text(GRAIN)
    file = str(tmp_path / "grain.toml")
    base = base_scene(file, tmp_path / "cache", columns=160, purpose="reporting", channels=False)
    sweep = Sweep(base, (axis_named("dose", [100, 400]),), contenders(["known_rotation"]), 1)
    ledger = BenchLedger(tmp_path / "out" / "bench.sqlite")
    stages: list[str] = []
    with ThreadPoolExecutor(1) as executor:
        found = run_sweep(sweep, ledger, executor, lambda stage, *_: stages.append(stage))
        answered = ledger.count()
        again = run_sweep(sweep, ledger, executor, lambda *_: None)
        executor.submit(close_cell).result()
    assert (answered, ledger.count()) == (2, 2)
    assert again.theory == found.theory
    assert again.results == found.results
    assert {"preparing scenes", "cases", "theory"} <= set(stages)
    assert found.theory[0].bound_um == pytest.approx(2 * found.theory[1].bound_um, rel=1e-6)
    assert found.theory[0].predicted_um == pytest.approx(found.theory[1].predicted_um)
    assert len(json.loads((tmp_path / "out" / "theory.json").read_text())) == 2
    assert [[each.method for each in results] for results in found.results] == [["known_rotation"]] * 2
    errors = curves(found)[0].mean
    assert (errors > [theory.bound_um for theory in found.theory]).all()  # nothing is better than the light
    assert (errors < 3.0).all()


def made_up(base, axes: tuple[Axis, ...], repetitions: int = 4) -> Swept:
    """Results by formula: one method at twice the bound, one that fails now and then, no method called."""
    methods = contenders(["known_rotation", "disparity"])
    sweep = Sweep(base, axes, methods, repetitions)
    points = tuple(sweep.points)
    theory = tuple(Theory(1 / np.sqrt(sum(point.values)), 0.5, 0.1) for point in points)
    rng = np.random.default_rng(0)
    results = []
    for point, expected in zip(points, theory, strict=True):
        luck = rng.normal(1, 0.01, repetitions)
        rows = [
            Result("", point.scene.name, "known_rotation", i, metrics={"median_um": 2 * expected.bound_um * luck[i],
                                                                      "completeness": 0.9})
            for i in range(repetitions)
        ]  # fmt: skip
        rows += [
            Result("", point.scene.name, "disparity", i, metrics={"median_um": 3 * expected.bound_um * luck[i]})
            for i in range(repetitions - 1)
        ]
        rows.append(Result("", point.scene.name, "disparity", repetitions - 1, "refused", "only 3 matches"))
        results.append(tuple(rows))
    return Swept(sweep, points, theory, tuple(results))


def test_curves_have_the_mean_and_an_interval_that_holds_it(base) -> None:
    swept = made_up(base, (axis_named("dose", [50, 200, 800]),))
    proposed, control = curves(swept)
    np.testing.assert_allclose(proposed.mean, [np.mean(row) for row in proposed.values])
    assert (proposed.low < proposed.mean).all()
    assert (proposed.mean < proposed.high).all()
    assert (proposed.answered, control.answered) == (12, 9)


def test_the_interval_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(4)
    limits = [interval(rng.normal(3, 1, 20)) for _ in range(400)]
    covered = np.mean([low < 3 < high for low, high in limits])
    assert 0.88 < covered < 0.97  # a bootstrap of 20 is a little narrow
    assert np.isnan(interval(np.array([1.0, np.nan]))).all()


def test_slope_of_a_power_law() -> None:
    x = np.array([1.0, 2.0, 8.0])
    assert slope(x, 3 * x**-0.5) == pytest.approx(-0.5)
    assert np.isnan(slope(x, np.array([np.nan, 1.0, np.nan])))


def test_the_page_says_what_is_in_the_rows(base) -> None:
    text = sweep_markdown(made_up(base, (axis_named("dose", [50, 200, 800]),)), "sweep.svg")
    assert "The bound goes from 0.141 um at 50 to 0.0354 um at 800, a power of -0.50." in text
    assert "`known_rotation` stays at 2 to 2 times the bound" in text
    assert "`disparity` has no answer in 3 of 12 cases: only 3 matches." in text
    assert "`known_rotation` has the smaller error than `disparity` at 3 of 3 points, the larger at 0" in text


@pytest.mark.parametrize("names", [("dose",), ("dose", "spot")])
def test_figures_and_rows_are_written(tmp_path: Path, base, names: tuple[str, ...]) -> None:
    values = {"dose": [50, 200, 800], "spot": [0.5, 1.0]}
    swept = made_up(base, tuple(axis_named(name, values[name]) for name in names))
    for ending in ("png", "svg"):
        draw_sweep(tmp_path / f"sweep.{ending}", swept)
        assert (tmp_path / f"sweep.{ending}").stat().st_size > 5000
    write_sweep_csv(tmp_path / "sweep.csv", swept)
    rows = list(csv.DictReader((tmp_path / "sweep.csv").read_text().splitlines()))
    assert len(rows) == len(swept.points) * 8
    assert list(rows[0])[: len(names)] == list(names)
    assert {row["failure"] for row in rows} == {"", "only 3 matches"}


def test_a_sweep_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'scene = "plane"\nmethods = ["known_rotation"]\nrepetitions = 2\n'
        '[[axis]]\nname = "signal.exponent"\nvalues = [0.8, 1.2]\n[[axis]]\nname = "dose"\n'
    )
    asked = read_sweep(path)
    assert [axis.name for axis in asked["axes"]] == ["signal.exponent", "dose"]
    assert asked["axes"][0].values == (0.8, 1.2)
    assert (asked["scene"], asked["repetitions"]) == ("plane", 2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("axis = 3", "axis must be a list"),
        ("colour = 1", "colour must be one of"),
        ('scene = "plane"', "one or two"),
        ('[[axis]]\nname = "dose"\nvalues = ["a"]', "a list of numbers"),
        ("= 3", "cannot be read"),
    ],
)
def test_a_bad_file_of_a_sweep_is_a_sentence(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_sweep(tmp_path / "bad.toml")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["doze"], "there is no sweep 'doze'"),
        (["dose", "spot", "tilt"], "one axis or two"),
        (["dose", "--values", "1,x"], "not a list of numbers"),
        (["dose", "--values", "-3"], "sweep dose at -3"),
        (["dose", "--values", "-3", "--methods", "oracle_matches"], "sweep dose at -3"),
        (["dose", "--methods", "magic"], "names no method 'magic'"),
    ],
)
def test_a_bad_command_ends_with_one_sentence(tmp_path: Path, arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["sweep", *arguments, "--scene", "plane", "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert said in done.output
    assert len(done.output.strip().splitlines()) == 1
