"""Error maps of a run show what was scored, call no method, and the page on methods says what the code says."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.oracles import ORACLES
from benchmarks.reporting import error_maps
from benchmarks.reporting.error_figures import COLUMNS, DPI, TILE_PX, WIDTH_PX, caption, draw_strip, headline
from benchmarks.reporting.error_maps import NOT_RUN, ErrorMap, Record, Strip, error_map, read_run, scene_maps, strips
from benchmarks.reporting.methods_page import (
    ALONE,
    BEGIN,
    END,
    FRONT_BEGIN,
    FRONT_END,
    cell,
    filled_page,
    leaderboard,
)
from benchmarks.reporting.report_figures import ERRORS, MISSING, UNJUDGED
from benchmarks.running import case
from benchmarks.running.bench import LEDGER, Plan, measure
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.cell import Limits
from benchmarks.running.manifest import MethodRecord, manifest_of, write_manifest
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from semrecon.errors import InputError
from semrecon.methods import METHODS
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests.test_contract import DECLARED
from tests.troubled_methods import Troubled

PAGE = Path(__file__).resolve().parent.parent / "docs" / "methods.md"


def quiet(_stage: str, _steps: int, _total: int) -> None:
    pass


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> BenchScene:
    """A ball of coarse mesh on a small field."""
    grain = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    made = Scene("grain-reporting", grain, Microscope(0.6, 160, 120), TiltSchedule((0.0, 5.0)))
    offers = ("pixel_size", "rotations", "tilt_axis")
    return BenchScene("grain", "A grain.", SimulatedSource(made, tmp_path_factory.mktemp("cache")), offers)


@pytest.fixture(scope="module")
def run(scene: BenchScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two repetitions of a method that answers a level and of one that refuses."""
    out = tmp_path_factory.mktemp("run")
    plan = Plan((scene,), (Troubled("level", "level"), Troubled("refuses", "refuses")), 2, Limits(30.0, 2.0))
    write_manifest(out, manifest_of(plan, quick=True, purpose="reporting"))
    with ThreadPoolExecutor(1) as executor:
        measure(plan, BenchLedger(out / LEDGER), executor, quiet)
    return out


@pytest.fixture
def record(run: Path, scene: BenchScene, monkeypatch: pytest.MonkeyPatch) -> Record:
    """The record of the run; whoever calls a method now fails."""

    def forbidden(*_: object) -> None:
        raise AssertionError("was run again")

    for name in ("run_case", "call", "_called"):
        monkeypatch.setattr(case, name, forbidden)
    monkeypatch.setattr(Troubled, "__call__", forbidden)
    monkeypatch.setattr(error_maps, "suite", lambda *_, **__: (scene,))
    return read_run(run)


# --- maps -------------------------------------------------------------------------------------------------------


def test_numbers_are_those_of_the_whole_map_and_a_thinned_map_keeps_its_values() -> None:
    errors = np.arange(700 * 4, dtype=np.float64).reshape(4, 700) - 1000
    judged = np.ones(errors.shape, dtype=bool)
    judged[:, 350:] = False
    errors[0] = np.nan
    found = error_map("ramp", errors, judged, 0.1)
    counted = np.abs(errors[1:, :350])
    assert found.median_um == np.median(counted)
    assert found.completeness == 0.75
    assert np.array_equal(found.error_um, errors[::3, ::3].astype(np.float32), equal_nan=True)
    assert np.array_equal(found.judged, judged[::3, ::3])
    assert found.pixel_size_um == pytest.approx(0.3)


def test_no_height_at_all_is_no_median_and_completeness_zero() -> None:
    found = error_map("empty", np.full((3, 4), np.nan), np.ones((3, 4), dtype=bool), 1.0)
    assert np.isnan(found.median_um)
    assert found.completeness == 0.0


def test_the_maps_of_a_run_show_what_was_scored_and_call_no_method(record: Record, scene: BenchScene) -> None:
    level, refuses = strips(record, quiet)
    (drawn,), (said,) = level.maps, refuses.maps
    scored = next(each for each in record.results if each.method == "level" and each.repetition == 0)
    assert drawn.median_um == pytest.approx(scored.metrics["median_um"], rel=1e-9)
    assert drawn.completeness == scored.metrics["completeness"] == 1.0
    true = scene.source.truth().height_map(0)
    shown = drawn.error_um[drawn.judged] + true[drawn.judged]  # a level's error is minus the truth, but for the offset
    assert np.ptp(shown) < 1e-4
    assert np.isnan(drawn.error_um[~drawn.judged]).all()
    assert said.failure == "there is nothing to see"
    assert said.limit_um == drawn.limit_um == pytest.approx(np.nanpercentile(np.abs(drawn.error_um), 90), rel=0.05)


def test_a_method_that_was_not_run_on_a_scene_says_so(record: Record, scene: BenchScene) -> None:
    elsewhere = [replace(each, scene="elsewhere") if each.method == "refuses" else each for each in record.results]
    found = scene_maps(replace(record, results=tuple(elsewhere)), scene)
    assert found["refuses"].failure == NOT_RUN
    assert not found["level"].failure


def test_a_picture_that_contradicts_the_score_on_record_is_refused(record: Record, scene: BenchScene) -> None:
    results = [replace(each, metrics={**each.metrics, "median_um": 1.0}) for each in record.results]
    with pytest.raises(InputError, match=r"median_um of level on grain is .* on record"):
        scene_maps(replace(record, results=tuple(results)), scene)


def test_a_scene_whose_specimen_is_not_at_hand_is_named(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(error_maps, "suite", lambda *_, **__: ())
    with pytest.raises(InputError, match="the specimen of grain is not at hand"):
        strips(record, quiet)


# --- pictures ---------------------------------------------------------------------------------------------------


def made_map(error_um: float, name: str = "made") -> ErrorMap:
    """Half of it has an error, a quarter is missing, a quarter not judged."""
    errors, judged = np.full((240, 320), error_um, dtype=np.float32), np.ones((240, 320), dtype=bool)
    errors[:120, 160:] = np.nan
    judged[120:, 160:] = False
    return ErrorMap(name, errors, judged, 0.2, abs(error_um), 0.5, limit_um=2.0)


@pytest.mark.parametrize(("error_um", "colour"), [(2.0, ERRORS[-1]), (-2.0, ERRORS[0]), (0.0, ERRORS[4])])
def test_colours_mean_what_the_legend_says(tmp_path: Path, error_um: float, colour: str) -> None:
    path = tmp_path / "strip.png"
    draw_strip(path, Strip(MethodRecord("made", (), ("offset",)), (made_map(error_um),)))
    with Image.open(path) as opened:
        picture = np.asarray(opened.convert("RGB")).astype(int)
    assert picture.shape[1] == WIDTH_PX
    left, quarter = 14, TILE_PX // 4
    top = int(np.flatnonzero((picture[:, left + quarter * 3] == MISSING).all(axis=1))[0])
    assert picture[top + 20, left + quarter] == pytest.approx([int(colour[i : i + 2], 16) for i in (1, 3, 5)], abs=2)
    assert tuple(picture[top + 20, left + 3 * quarter]) == MISSING
    assert tuple(picture[top + 150, left + 3 * quarter]) == UNJUDGED


def test_a_strip_of_a_dozen_noisy_scenes_is_1600_px_wide_and_small(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "strip.jpg"
    noisy = [
        replace(made_map(0.0, f"scene {i}"), error_um=rng.normal(0, 1, (240, 320)).astype(np.float32))
        for i in range(11)
    ]
    refused = ErrorMap("refused", failure="a sentence that is rather long " * 20)
    draw_strip(path, Strip(MethodRecord("noisy", (), ()), (*noisy, refused)))
    assert path.stat().st_size < 300_000  # white noise is the worst there is
    with Image.open(path) as picture:
        width, height = picture.size
    assert width == WIDTH_PX
    assert 2 * WIDTH_PX / COLUMNS * 0.75 < height < WIDTH_PX
    assert DPI * 16 == WIDTH_PX


def test_an_oracle_is_marked_on_its_picture() -> None:
    plain = MethodRecord("known_rotation", (), ("offset",))
    assert "†" not in headline(Strip(plain, ()))
    oracle = MethodRecord("oracle_matches", (), ("offset",), given="true matches")
    assert "† (given true matches)" in headline(Strip(oracle, ()))
    assert headline(Strip(oracle, ())).endswith("after removal of offset")


# --- tables -----------------------------------------------------------------------------------------------------


def test_only_what_stands_between_the_markers_is_made_anew() -> None:
    page = f"# Page\n\nBefore.\n\n{BEGIN}\nold\n{END}\n\nAfter.\n"
    once = filled_page(page, "new\n")
    assert once == f"# Page\n\nBefore.\n\n{BEGIN}\n\nnew\n\n{END}\n\nAfter.\n"
    assert filled_page(once, "new") == once


@pytest.mark.parametrize("page", ["", BEGIN, f"{END}\n{BEGIN}", f"{BEGIN}\n{END}\n{BEGIN}\n{END}"])
def test_a_page_without_one_pair_of_markers_is_refused(page: str) -> None:
    with pytest.raises(InputError, match="leaderboard:begin"):
        filled_page(page, "new")


def test_tables_hold_the_means_on_record_and_the_reasons(record: Record) -> None:
    text = leaderboard(record, strips(record, quiet))
    levels = [each.metrics for each in record.results if each.method == "level"]
    assert len(levels) == 2
    for metric in ("median_um", "common_median_um", "split_scale"):
        assert f"| level | {np.mean([each[metric] for each in levels]):.3g} |" in text, metric
    assert "| level | pixel_size | offset | 2 of 2 |" in text
    assert "| refuses | pixel_size | offset | 0 of 2 | - | - |" in text
    assert "- refuses, on grain: there is nothing to see" in text
    assert "2 repetitions" in text


def test_the_error_after_an_offset_alone_is_the_same_whatever_is_declared(record: Record) -> None:
    other = tuple(replace(each, gauge=()) for each in record.manifest.methods)
    results = tuple(replace(each, metrics={}) for each in record.results)  # those scores are of the other gauge
    changed = replace(record, manifest=replace(record.manifest, methods=other), results=results)
    drawn = strips(changed, quiet)
    (nothing_removed,), (offset_removed,) = drawn[0].maps, strips(record, quiet)[0].maps
    assert nothing_removed.median_um != offset_removed.median_um
    assert nothing_removed.offset_only_um == offset_removed.offset_only_um == offset_removed.median_um
    table = leaderboard(changed, drawn).partition(ALONE)[2].partition("###")[0]
    assert f"| level | {offset_removed.median_um:.3g} |" in table
    assert "| refuses | - |" in table


def test_the_caption_says_what_a_wider_gauge_has_forgiven() -> None:
    plain = replace(made_map(0.5), offset_only_um=0.5)
    assert caption(plain) == "median 0.5 µm, 50 % complete"
    assert caption(replace(plain, median_um=1e-9)).startswith("median < 0.001 µm")
    assert caption(replace(plain, offset_only_um=12.3)).splitlines()[1] == "12 µm after an offset alone"


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command_draws_a_picture_a_method_and_fills_the_page(record: Record, tmp_path: Path) -> None:
    page, front, out = tmp_path / "page.md", tmp_path / "front.md", tmp_path / "img"
    page.write_text(f"Mine.\n{BEGIN}\n{END}\n")
    front.write_text(f"First.\n{FRONT_BEGIN}\n{FRONT_END}\nLast.\n")
    options = ["--run", str(record.run), "--out", str(out), "--page", str(page), "--front", str(front)]
    done = CliRunner().invoke(app, ["gallery", *options])
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.iterdir()) == ["level.jpg", "refuses.jpg"]
    assert page.read_text().startswith("Mine.\n")
    assert "| level |" in page.read_text()
    assert front.read_text().startswith("First.\n")
    assert front.read_text().endswith("Last.\n")
    median = np.mean([each.metrics["median_um"] for each in record.results if each.method == "level"])
    (row,) = [line for line in front.read_text().splitlines() if line.startswith("| level |")]
    assert float(row.split("|")[2].split("(")[0]) == pytest.approx(median, rel=0.01)


def test_a_median_stands_with_its_efficiency_where_there_is_a_bound() -> None:
    assert cell(0.7213, 11.12) == "0.721 (11)"
    assert cell(0.7213, 1.26) == "0.721 (1.3)"
    assert cell(3e-8, 2e-7) == "< 0.001 (0.0)"
    assert cell(0.7213, np.nan) == "0.721"
    assert cell(np.nan, np.nan) == "-"


def test_a_folder_without_a_run_is_refused_in_a_sentence(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["gallery", "--run", str(tmp_path / "none"), "--out", str(tmp_path / "img")])
    assert done.exit_code == 2
    assert "holds no run" in done.output
    assert not (tmp_path / "img").exists()


def test_a_page_without_markers_is_refused_before_anything_is_drawn(record: Record, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    options = ["--run", str(record.run), "--out", str(tmp_path / "img"), "--page", str(page)]
    assert CliRunner().invoke(app, ["gallery", *options]).exit_code == 2
    assert page.read_text() == "nothing\n"
    assert not (tmp_path / "img").exists()


# --- the page ---------------------------------------------------------------------------------------------------


def sections() -> dict[str, str]:
    """Text by heading of the second and third level."""
    parts = re.split(r"^#{2,3} (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_every_method_has_a_section_that_states_what_the_code_states(method) -> None:
    text = sections()[method.name]
    stated = f"- **Needs** {', '.join(method.needs)}. **Cannot observe** {', '.join(method.gauge)}."
    assert stated in text
    for part in ("**Assumes**", "**Works**", "**Breaks**", f"(img/methods/{method.name}.jpg)"):
        assert part.lower() in text.lower(), part


@pytest.mark.parametrize("oracle", ORACLES, ids=lambda oracle: oracle.name)
def test_every_oracle_has_a_section_with_its_picture(oracle) -> None:
    assert f"(img/methods/{oracle.name}.jpg)" in sections()[oracle.name]


def test_the_page_names_no_method_that_there_is_not_and_every_test_that_it_names_is_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    pictured = set(re.findall(r"img/methods/(\w+)\.jpg", text))
    assert pictured == {each.name for each in (*METHODS, *ORACLES)}
    for named in set(re.findall(r"`(tests/\w+\.py)`", text)):
        assert (PAGE.parent.parent / named).is_file(), named


def test_the_page_has_one_place_for_the_tables() -> None:
    assert "| a |" in filled_page(PAGE.read_text(encoding="utf-8"), "| a |")


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_the_accuracy_that_the_page_states_is_the_one_that_is_tested(method) -> None:
    declared = DECLARED[method.name]
    claims = (declared.plane, declared.step, declared.sphere)
    cells = [f"{claim:g}" if isinstance(claim, float) else "-" for claim in claims]
    assert f"| {method.name} | {' | '.join(cells)} |" in sections()["Declared accuracy"]
