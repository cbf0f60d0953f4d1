"""Recordings of runs and sweeps read back as what is on record, call no method, and are there whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rerun.chunk import RrdReader
from typer.testing import CliRunner

import benchmarks.suite
from benchmarks.__main__ import app
from benchmarks.commands.command_line import command_line
from benchmarks.recording.layout import Flat
from benchmarks.recording.rerun_file import rerun_file
from benchmarks.recording.run_recording import MOST_BYTES, narrowed, record_scene
from benchmarks.recording.scenery import at_repetition
from benchmarks.recording.surfaces import MOST_VERTICES, answered, error_colours, grid_faces, thinning
from benchmarks.recording.sweep_recording import place, read_swept, times_of
from benchmarks.reporting import error_maps
from benchmarks.reporting.error_maps import Record, read_run
from benchmarks.reporting.report_figures import UNJUDGED
from benchmarks.reporting.report_scenes import truth_of
from benchmarks.running import case
from benchmarks.running.bench import LEDGER, Plan
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.case import Answer, Case, Outcome, judge_version, score
from benchmarks.running.cell import Limits
from benchmarks.running.manifest import SWEEP_MANIFEST, manifest_of, origin, read_manifest, write_manifest
from benchmarks.running.stored import packed
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from benchmarks.sweeping.sweep_axes import axis_named
from benchmarks.sweeping.sweeps import Sweep, base_scene, points_of, run_sweep, sweep_settings
from semrecon.data import Estimate, HeightMap, PointCloud, Poses
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests.small_grain import GRAIN, close_cell
from tests.troubled_methods import Troubled

TILTS = (-5.0, 0.0, 5.0)
LIMITS = Limits(30.0, 2.0)


def quiet(_stage: str, _steps: int, _total: int) -> None:
    pass


def column(path: Path, entity: str, ending: str) -> list[Any]:
    """All values of a component of an entity, in the order of the file."""
    found: list[Any] = []
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.endswith(ending)]
        if chunk.entity_path == entity and names:
            found += batch.column(names[0]).to_pylist()
    return found


def placed(path: Path, entity: str, timeline: str, ending: str = "RowId") -> dict[float, Any]:
    """Values of a component by where they stand on a timeline: a count, or seconds of a duration."""
    found: dict[float, Any] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if chunk.entity_path == entity and timeline in chunk.timeline_names:
            batch = chunk.to_record_batch()
            (name,) = (name for name in batch.schema.names if name.endswith(ending))
            for at, value in zip(batch.column(timeline), batch.column(name).to_pylist(), strict=True):
                found[at.value / 1e9 if "duration" in str(at.type) else at.as_py()] = value
    return found


def places(path: Path, entity: str, timeline: str) -> list[float]:
    """Where an entity stands on a timeline."""
    return sorted(placed(path, entity, timeline))


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}


# --- a run ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> BenchScene:
    grain = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    made = Scene("grain-reporting", grain, Microscope(0.6, 160, 120), TiltSchedule(TILTS))
    offers = ("pixel_size", "rotations", "tilt_axis")
    return BenchScene("grain", "A grain.", SimulatedSource(made, tmp_path_factory.mktemp("cache")), offers)


METHODS = (Troubled("level", "wavy"), Troubled("level", "dots"), Troubled("refuses", "fails"))


def answer_to(asked: Case) -> Answer:
    """A ripple of 1 um on the truth, 7 um too high, as heights and at every fortieth pixel as points; a failure."""
    if asked.method.name == "fails":
        return Answer(asked.key, "refused", "there is nothing to see")
    ground = asked.scene.source.truth()
    true = ground.height_map(1)
    series = asked.scene.series(asked.repetition)
    ripple = np.sin(np.arange(true.shape[1]) / 5) + np.zeros(true.shape)
    rotations, shifts = (
        np.stack([getattr(pose, what) for pose in ground.poses]) for what in ("rotation", "translation_um")
    )
    poses = Poses(rotations, shifts)
    if asked.method.name == "wavy":
        heights = HeightMap(true + ripple + 7.0, np.ones(true.shape), series.optics.pixel_size_um)
        return Answer(asked.key, "", "", 1.0 + asked.repetition, 2.0, packed(Estimate(None, heights, poses)))
    rows, columns = (each.ravel()[::40] for each in np.indices(true.shape))
    xyz = ground.buffers[1].position_um[rows, columns] + [0, 0, 7.0]
    xyz[:, 2] += ripple[rows, columns]
    xy = np.column_stack([columns, rows]).astype(float)
    cloud = PointCloud(xyz, np.tile(np.eye(3), (len(xyz), 1, 1)), np.zeros(len(xyz)), xy)
    return Answer(asked.key, "", "", 1.0, 2.0, packed(Estimate(cloud, None, poses)))


@pytest.fixture(scope="module")
def run(scene: BenchScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    plan, ledger = Plan((scene,), METHODS, 2, LIMITS), BenchLedger(out / LEDGER)
    write_manifest(out, manifest_of(plan, quick=True, purpose="reporting"))
    for each in plan.cases:
        answer = answer_to(each)
        ledger.record(Outcome(each, answer, judge_version(), score(each, answer)), LIMITS)
    return out


@pytest.fixture(scope="module")
def record(run: Path) -> Iterator[Record]:
    """The record of the run; whoever calls a method now, in this process, fails."""

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("a recording called a method")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Troubled, "__call__", forbidden)
        patch.setattr(case, "call", forbidden)
        yield read_run(run)


@pytest.fixture(scope="module")
def file(record: Record, scene: BenchScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("file") / "grain.rrd"
    assert record_scene(path, record, scene) == path.stat().st_size
    return path


def test_a_scene_has_all_its_parts_and_one_blueprint(file: Path) -> None:
    wanted = ("about", "scale", "failures", "micrograph", "maps/wavy", "world/truth", "world/net", "world/view/plane")
    wanted += ("world/views/planes", "world/views/beams", "world/answers/wavy/surface", "world/answers/dots/points")
    assert {f"/{name}" for name in wanted} <= entities(file)
    assert "/world/answers/fails/surface" not in entities(file)
    assert len(RrdReader(file).blueprints()) == 1


def test_timelines_are_tilt_and_repetition(file: Path) -> None:
    assert places(file, "/micrograph", "tilt") == pytest.approx(sorted(TILTS))
    assert places(file, "/micrograph", "repetition") == [1, 2]
    assert places(file, "/world/answers/wavy/surface", "repetition") == [1, 2]
    assert places(file, "/world/answers/wavy/surface", "tilt") == [min(TILTS)]  # from the first micrograph on


def test_numbers_are_those_of_the_ledger(file: Path, record: Record) -> None:
    mine = [each for each in record.results if each.method == "wavy"]
    errors = placed(file, "/metrics/median_um/wavy", "repetition", "scalars")
    assert errors == {each.repetition + 1: [each.metrics["median_um"]] for each in mine}
    assert placed(file, "/metrics/seconds/wavy", "repetition", "scalars") == {1: [1.0], 2: [2.0]}
    assert column(file, "/metrics/median_um/fails", "scalars") == []
    assert np.abs(column(file, "/metrics/tilt_error_deg/wavy", "scalars")).max() < 1e-9  # it was given the true poses


def test_a_surface_without_its_offset_is_the_truth_and_the_ripple(
    record: Record, scene: BenchScene, run: Path, file: Path
) -> None:
    """The mesh lies where the mesh of the specimen does: the ray of each vertex meets it 1 um off at most."""
    shown = np.array(column(file, "/world/answers/wavy/surface", "vertex_positions")[0])
    ground = scene.source.truth()
    columns = (shown[:, 0] / 0.6 + 79.5).round().astype(int)
    rows = (59.5 - shown[:, 1] / 0.6).round().astype(int)
    off = shown[:, 2] - ground.height_map(1)[rows, columns] - np.sin(columns / 5)
    assert len(shown) == 160 * 120
    assert np.ptp(off) < 1e-4
    assert abs(np.median(shown[:, 2] - ground.height_map(1)[rows, columns])) < 0.3  # the offset of 7 um is gone


def test_points_carry_the_errors_that_were_scored(record: Record, scene: BenchScene) -> None:
    result = next(each for each in record.results if each.method == "dots")
    blob = record.ledger.answer(Case(scene, METHODS[1], 0, result.key)).estimate
    found = answered(blob, truth_of(scene, 0), scene.source.truth(), ("offset",), 10**9)
    assert found is not None
    assert found.cloud is not None
    assert np.median(np.abs(found.cloud.error_um)) == pytest.approx(result.metrics["points_median_um"], rel=1e-9)
    assert found.thinned == 1


def test_failures_and_words_say_what_happened(file: Path, record: Record) -> None:
    said = placed(file, "/failures", "repetition", "text")
    assert said == {number: [f"fails, repetition {number}: there is nothing to see"] for number in (1, 2)}
    (about,) = (text[0] for text in column(file, "/about", "text"))
    for words in ("µm", "| wavy | 2/2 |", "- fails: there is nothing to see", record.manifest.code, "Blue is too low"):
        assert words in about


def test_arrows_come_from_the_gun_along_parallel_beams(file: Path, scene: BenchScene) -> None:
    vectors = np.array(column(file, "/world/views/beams", "vectors")[0])
    true = np.stack([pose.rotation[2] for pose in scene.source.truth().poses])
    np.testing.assert_allclose(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), true, atol=1e-6)
    assert (vectors[:, 2] < 0).all()


def test_a_broken_recording_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    path.write_bytes(b"old")

    def stopped() -> None:
        with rerun_file(path, "a", Flat("text", "a", "a"), "tilt") as half:
            half.text("a", "begun")
            raise ValueError("half way")

    with pytest.raises(ValueError, match="half"):
        stopped()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_scene_that_the_run_did_not_come_to_is_recorded_without_answers(
    record: Record, scene: BenchScene, tmp_path: Path
) -> None:
    elsewhere = tuple(replace(each, scene="elsewhere") for each in record.results)
    record_scene(tmp_path / "none.rrd", replace(record, results=elsewhere), scene)
    assert "/micrograph" in entities(tmp_path / "none.rrd")
    assert not any(name.startswith("/world/answers") for name in entities(tmp_path / "none.rrd"))


def test_only_some_methods(record: Record, scene: BenchScene, tmp_path: Path) -> None:
    record_scene(tmp_path / "one.rrd", narrowed(record, ["dots"]), scene)
    assert "/maps/wavy" not in entities(tmp_path / "one.rrd")
    assert "/maps/dots" in entities(tmp_path / "one.rrd")


# --- what is shown ----------------------------------------------------------------------------------------------


def test_thinning_keeps_to_its_bound_and_to_all_where_it_can() -> None:
    for pixels in (100, 320 * 427, 1920 * 2560):
        every = thinning(pixels, MOST_VERTICES)
        assert pixels / every**2 <= MOST_VERTICES
        assert every == 1 or pixels / (every - 1) ** 2 > MOST_VERTICES
    assert MOST_BYTES < 30e6


def test_triangles_leave_holes_and_look_up() -> None:
    known = np.ones((3, 4), dtype=bool)
    known[2, 3] = False
    rows, columns = np.nonzero(known)
    corners = np.column_stack([columns, -rows, np.zeros(len(rows))])[grid_faces(known)]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    np.testing.assert_allclose(area, 0.5)
    assert len(area) == 2 * (2 * 3 - 1)


def test_colours_of_errors_are_signed_and_what_is_not_judged_is_none_of_them() -> None:
    low, right, high, none = error_colours(np.array([-2.0, 0.0, 2.0, np.nan]), 1.0).astype(int)
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert np.ptp(right) == 0
    assert tuple(none) == UNJUDGED


# --- a sweep ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two doses, one method that answers a level and one that refuses."""
    out = tmp_path_factory.mktemp("sweep")
    toml = out.parent / "small.toml"
    toml.write_text(GRAIN, encoding="utf-8")
    base = base_scene(str(toml), out / "cache", columns=160, purpose="reporting", channels=False)
    methods = (Troubled("level", "level"), Troubled("refuses", "refuses"))
    planned = Sweep(base, (axis_named("dose", [50.0, 200.0]),), methods, 2, limits=LIMITS)
    settings = sweep_settings(planned, str(toml), columns=160, channels=False)
    made_by = manifest_of(planned.plan, quick=False, purpose="reporting", command="typed", settings=settings)
    write_manifest(out, made_by, SWEEP_MANIFEST)
    with ThreadPoolExecutor(1) as executor:
        run_sweep(planned, BenchLedger(out / LEDGER), executor, quiet)
        executor.submit(close_cell).result()
    return out


def test_a_sweep_is_made_again_from_its_settings(sweep: Path) -> None:
    manifest = read_manifest(sweep, SWEEP_MANIFEST)
    points = points_of(manifest.settings, sweep / "cache", "reporting")
    assert [point.values for point in points] == [(50.0,), (200.0,)]
    assert [point.scene.identity for point in points] == [each.identity for each in manifest.scenes]


def test_a_sweep_stands_on_the_timeline_of_what_was_varied(sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Troubled, "__call__", None)
    done = CliRunner().invoke(app, ["record", "--sweep", str(sweep)])
    assert done.exit_code == 0, done.output
    path = sweep / "recordings" / "sweep-dose.rrd"
    assert f"{path.stat().st_size / 1e6:.1f} MB" in done.stdout
    assert places(path, "/images/reference", "dose") == [50, 200]
    assert places(path, "/world/answers/level/surface", "dose") == [50, 200]
    assert places(path, "/world/answers/level/surface", "repetition") == [1, 2]
    assert places(path, "/metrics/median_um/level", "dose") == [50, 200]
    found = read_swept(sweep)
    means = placed(path, "/metrics/median_um/level", "dose", "scalars")
    for point in found.points:
        wanted = np.mean([each.metrics["median_um"] for each in found.results(point, "level")])
        assert means[point.values[0]] == pytest.approx([wanted])
    (about,) = (text[0] for text in column(path, "/about", "text"))
    assert "dose (electrons a pixel)" in about
    assert "typed" in about
    assert any("there is nothing to see" in text[0] for text in column(path, "/failures", "text"))


def test_two_axes_stand_each_on_its_own_timeline(sweep: Path) -> None:
    """What is not varied on a timeline is in the middle, so that no place holds two things."""
    found = read_swept(sweep)
    dose, spot = axis_named("dose", [50.0, 100.0, 200.0]), axis_named("spot", [0.5, 0.7])
    both = Sweep(found.points[0].scene, (dose, spot), ())
    swept = type(found)(found.record, (dose, spot), tuple(both.points))
    at = {point.values: times_of(swept, point, 0) for point in both.points}
    assert swept.middle == (100.0, 0.7)
    assert at[(50.0, 0.7)] == {"dose": 50}
    assert at[(100.0, 0.5)] == {"spot": 0.5}
    assert at[(100.0, 0.7)] == {"dose": 100, "spot": 0.7, **at_repetition(0)}
    assert at[(50.0, 0.5)] == {}
    assert [point.values for point in swept.shown] == [values for values, times in at.items() if times]
    assert place(spot, 0.5) == {"spot": 0.5}


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command_writes_a_file_a_scene_and_says_its_size(
    record: Record, run: Path, scene: BenchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmarks.suite, "suite", lambda *_, **__: (scene,))
    done = CliRunner().invoke(app, ["record", "--run", str(run), "--out", str(tmp_path / "seen")])
    assert done.exit_code == 0, done.output
    (path,) = (tmp_path / "seen").iterdir()
    assert path.name == "grain.rrd"
    assert f"{path} is written, {path.stat().st_size / 1e6:.1f} MB" in done.stdout.replace("\n", "")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--run", "RUN", "--sweep", "RUN"], "name one of them"),
        (["--sweep", "RUN", "--scenes", "grain"], "leave it out"),
        (["--run", "RUN", "--scenes", "moon"], "no scene 'moon'"),
        (["--run", "RUN", "--methods", "magic"], "no method 'magic'"),
        (["--sweep", "RUN"], "no sweep.json"),
        (["--run", "NOWHERE"], "holds no run"),
        (["--run", "RUN", "--out", "FILE"], "is a file"),
    ],
)
def test_what_a_user_can_put_right_is_a_sentence(options: list[str], said: str, run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    names = {"RUN": run, "NOWHERE": tmp_path / "nowhere", "FILE": tmp_path / "file"}
    done = CliRunner().invoke(app, ["record", *(str(names.get(each, each)) for each in options)])
    assert done.exit_code == 2
    assert said in done.stderr
    assert "Traceback" not in done.output
    assert not (tmp_path / "nowhere").exists()


def test_a_run_that_contradicts_the_truth_of_today_is_refused(
    record: Record, scene: BenchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(error_maps, "AGREE", -1.0)
    with pytest.raises(Exception, match="on record"):
        record_scene(tmp_path / "a.rrd", record, scene)
    assert not list(tmp_path.iterdir())


def test_a_page_repeats_the_command_that_was_typed() -> None:
    app, typed = typer.Typer(), []

    @app.command()
    def turn(context: typer.Context, axes: list[str], scene: str = "", times: int = 1, fast: bool = False) -> None:
        typed.append(command_line(context))

    done = CliRunner().invoke(app, ["dose", "tilt", "--scene", "my scene.toml", "--fast"], prog_name="turn")
    assert done.exit_code == 0, done.output
    assert typed == ["python -m benchmarks turn dose tilt --scene 'my scene.toml' --fast"]


def test_a_page_says_where_it_comes_from(sweep: Path) -> None:
    manifest = read_manifest(sweep, SWEEP_MANIFEST)
    text = "\n".join(origin(manifest))
    for said in ("    typed\n", manifest.code, manifest.started, f"numpy {np.__version__}", "cores"):
        assert said in text
