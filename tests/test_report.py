"""The report says what is in the ledger, needs nothing beside itself, and works in a browser, wide and narrow."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import benchmarks.reporting.report
from benchmarks.__main__ import app
from benchmarks.reporting.convergence_figure import LEAST_PX, convergence_plot
from benchmarks.reporting.report import content, rendered
from benchmarks.reporting.report_figures import BOUND, ERRORS, HEIGHTS, MISSING, coloured, error_curves
from benchmarks.reporting.report_scenes import ABSENT, CHANGED, drawn_answer, truth_of
from benchmarks.reporting.report_sweeps import sweep_section
from benchmarks.running.bench import LEDGER, Plan
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.bounds import add_bounds
from benchmarks.running.case import Answer, Case, Outcome, judge_version, score
from benchmarks.running.cell import Limits
from benchmarks.running.manifest import MANIFEST, manifest_of, read_manifest, write_manifest
from benchmarks.running.stored import packed
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene
from semrecon.data import Estimate, HeightMap
from semrecon.errors import InputError
from semrecon.numerics.history import CONVERGENCE, history
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from
from tests import chromium

HOSTILE = '</script><script>document.title = "taken"</script><img src=x onerror="document.title=1"> & "quoted"'
LIMITS = Limits(5.0, 1.0)
HALVING = [*(0.5 + 2.0**-step for step in range(20)), 0.5 + 2.0**-19]
"""Residuals that near 0.5 px by halves, and then stay."""
LEGEND_IS_CLEAR = """plot => {
  const box = what => plot.querySelector(what)?.getBoundingClientRect();
  const names = box('.legend'), title = box('.xtitle'), whole = box('.main-svg');
  return !names || ((!title || names.top >= title.bottom || names.left >= title.right) && names.bottom <= whole.bottom);
}"""
"""Names of curves lie over no title, and all of them within the plot."""


@dataclass(frozen=True)
class Pretender:
    """Stands in the record; whoever calls it has not understood what a report is."""

    name: str
    needs: tuple[str, ...] = ("pixel_size",)
    gauge: tuple[str, ...] = ("offset",)
    citation: str = "nobody"
    given: str = ""
    views: tuple[int, int | None] = (1, None)

    def __call__(self, *_: object, **__: object) -> Estimate:
        raise AssertionError("a report called a method")


METHODS = (
    Pretender("wavy_one", ("rotations", "pixel_size")),
    Pretender("half_done", gauge=("offset", "scale")),
    Pretender("fails", ("channels",), citation=HOSTILE),
    Pretender("oracle_level", given="true heights"),
)


def grain(cache: Path) -> BenchScene:
    shape = specimen_from({"name": "pollen", "edge_um": 1.2, "frame_width_um": 96.0, "frame_height_um": 72.0})
    scene = Scene("grain-reporting", shape, Microscope(0.6, 160, 120), TiltSchedule((0.0, 5.0)))
    return BenchScene("grain", f"A grain {HOSTILE}.", SimulatedSource(scene, cache), ("pixel_size", "rotations"))


def answer_to(case: Case) -> Answer:
    """A ripple of 1 um; its double on the upper half only, three times too high; a quarter of it; failures."""
    true = case.scene.source.truth().height_map(0)
    ripple = np.sin(np.arange(true.shape[1]) / 5) + np.zeros(true.shape)
    upper = np.arange(true.shape[0])[:, None] < 60
    heights = {
        "wavy_one": true + ripple,
        "half_done": np.where(upper, 3 * (true + 2 * ripple), np.nan),
        "oracle_level": true + 3.0 + ripple / 4,
    }
    if case.method.name not in heights or (case.scene.name == "elsewhere" and case.method.name == "half_done"):
        return Answer(case.key, "refused", HOSTILE)
    z_um = heights[case.method.name]
    kept = {CONVERGENCE: [history(HOSTILE, HALVING), history("other", HALVING[:3])]}
    estimate = Estimate(heights=HeightMap(z_um, z_um, 0.6), diagnostics=kept if case.method.name == "wavy_one" else {})
    return Answer(case.key, seconds=1.5, peak_mib=20.0, estimate=packed(estimate))


@dataclass(frozen=True)
class Ran:
    folder: Path
    plan: Plan
    scene: BenchScene


def quiet(_stage: str, _steps: int, _total: int) -> None:
    pass


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ran]:
    """A run of two scenes, of which one is not at hand any more; one case is not answered yet."""
    folder = tmp_path_factory.mktemp("run")
    scene = grain(folder / "cache")
    plan = Plan((scene, replace(scene, name="elsewhere", content="elsewhere")), METHODS, 1, LIMITS)
    ledger = BenchLedger(folder / LEDGER)
    for case in plan.cases[:-1]:
        answer = answer_to(case)
        ledger.record(Outcome(case, answer, judge_version(), score(case, answer)), LIMITS)
    with ThreadPoolExecutor(1) as executor:
        add_bounds(plan, ledger, executor, quiet)
    write_manifest(folder, manifest_of(plan, quick=True, purpose="reporting"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmarks.reporting.report, "suite", lambda *_args, **_more: (scene,))
        yield Ran(folder, plan, scene)


def write_sweep(folder: Path, axes: tuple[str, ...]) -> Path:
    """Errors of 1 / value for one method and twice that for another, which fails once."""
    folder.mkdir()
    with (folder / "sweep.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*axes, "method", "repetition", "median_um", "completeness", "failure", "bound_um"])
        for value in (1.0, 10.0, 100.0):
            for number, method in enumerate(("one", "two"), start=1):
                for repetition in (0, 1):
                    lost = method == "two" and value == 1 and repetition == 0
                    found = ["", "", HOSTILE] if lost else [number * (1 + repetition) / value, 0.5, ""]
                    writer.writerow([*([value] * len(axes)), method, repetition, *found, 0.1 / value])
    return folder


@pytest.fixture(scope="module")
def page(ran: Ran, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    sweep = write_sweep(folder / "sweep", ("dose",))
    out = folder / "new" / "report.html"
    result = CliRunner().invoke(app, ["report", "--run", str(ran.folder), "--out", str(out), "--sweep", str(sweep)])
    assert result.exit_code == 0, result.output
    assert [each.name for each in out.parent.iterdir()] == ["report.html"]
    return out


class Reader(HTMLParser):
    """Collects tags with their attributes, and the text outside of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside not in ("script", "style"):
            self.text += data


@pytest.fixture(scope="module")
def read(page: Path) -> Reader:
    return Reader(page.read_text(encoding="utf-8"))


def test_all_text_is_escaped(page: Path, read: Reader) -> None:
    assert HOSTILE not in page.read_text(encoding="utf-8")
    assert read.text.count(HOSTILE) >= 4  # a failure, what a scene is about, a citation, a failure of a sweep
    assert not [tag for tag, attributes in read.tags if any(name.startswith("on") for name in attributes)]


def test_the_page_needs_nothing_else(read: Reader) -> None:
    places = [value for _, each in read.tags for name, value in each.items() if name in ("src", "href", "srcset")]
    assert places
    assert all(str(place).startswith(("data:", "#")) for place in places)
    assert {tag for tag, _ in read.tags} & {"link", "iframe", "object", "embed", "base"} == {"link"}  # the icon: data:
    policy = next(str(each["content"]) for tag, each in read.tags if tag == "meta" and "http-equiv" in each)
    assert "default-src 'none'" in policy
    assert "http" not in policy


def test_no_machine_path_is_published(page: Path, ran: Ran) -> None:
    text = page.read_text(encoding="utf-8")
    assert str(ran.folder) not in text
    assert str(Path.home()) + "/" not in text


def test_tables_hold_what_is_on_record(ran: Ran) -> None:
    found = content(ran.folder, [], quiet)
    recorded = BenchLedger(ran.folder / LEDGER).results([case.key for case in ran.plan.cases], judge_version())
    assert found.unanswered == 1
    assert {(each.scene, each.method.removesuffix(" †")) for each in found.entries} == {
        (each.scene, each.method) for each in recorded
    }
    by_place = {(each.scene, each.method): each for each in found.entries}
    wavy = by_place["grain", "wavy_one"]
    assert wavy.values["median_um"] == next(each for each in recorded if each.method == "wavy_one").metrics["median_um"]
    quarter = wavy.values["median_um"] / 4
    assert by_place["grain", "oracle_level †"].values["median_um"] == pytest.approx(quarter, rel=0.01)
    assert [each.sentence for each in found.failures] == [HOSTILE] * 3
    assert "1 of 8 cases are not run yet" in Reader(rendered(found)).text


@pytest.mark.parametrize("name", ["wavy_one", "half_done"])
def test_the_map_shows_the_error_of_the_table(ran: Ran, name: str) -> None:
    case = next(each for each in ran.plan.cases if each.method.name == name and each.scene == ran.scene)
    truth = truth_of(ran.scene, 0)
    drawn = drawn_answer(BenchLedger(ran.folder / LEDGER).answer(case).estimate, truth, case.method.gauge)
    assert drawn is not None
    (result,) = BenchLedger(ran.folder / LEDGER).results([case.key], judge_version())
    shown = drawn.errors_um[np.isfinite(drawn.errors_um)]
    assert np.median(np.abs(shown)) == pytest.approx(result.metrics["median_um"], rel=1e-9)
    assert len(shown) / truth.judged.sum() == pytest.approx(result.metrics["completeness"])
    near = np.abs(drawn.heights_um - truth.z_um)[truth.judged]
    assert np.nanmedian(near) == pytest.approx(result.metrics["median_um"], rel=0.3)  # the gauge is gone from heights


def test_the_limit_stands_in_every_plot(ran: Ran) -> None:
    found = content(ran.folder, [], quiet)
    limit = BenchLedger(ran.folder / LEDGER).limit(ran.scene.identity)
    assert limit is not None
    section = next(each for each in found.sections if each.name == "grain")
    assert section.limit_map is not None
    assert section.curves is not None
    curve = next(each for each in section.curves["data"] if each["name"] == BOUND)
    assert np.interp(0.5, curve["y"], curve["x"]) == pytest.approx(limit.median_abs_um, rel=0.05)
    assert found.distances is not None
    line, *methods = found.distances["data"]
    assert (line["name"], line["y"]) == (BOUND, [1.0, 1.0])
    by_place = {(each.method, each.scene): each for each in found.entries}
    shown = {each["name"]: each["y"][0] for each in methods}
    assert shown["wavy_one"] == pytest.approx(by_place["wavy_one", "grain"].values["efficiency"], rel=1e-3)
    assert shown["fails"] is None
    assert "Gaussian window of 3 px" in Reader(rendered(found)).text


def test_convergence_is_drawn_for_who_kept_a_history_and_for_nobody_else(ran: Ran) -> None:
    found = content(ran.folder, [], quiet)
    figures = {each.name: each.convergence for each in found.sections}
    assert figures["elsewhere"] is None
    assert figures["grain"] is not None
    long, short = figures["grain"]["data"]
    assert {each["name"] for each in (long, short)} == {"wavy_one"}
    np.testing.assert_allclose(long["y"][:-1], [2.0**-step for step in range(1, 20)], rtol=1e-3)
    assert long["y"][-1] == LEAST_PX  # what stays is no hole in the curve
    assert long["x"] == list(range(1, 21))
    assert short["x"] == [1, 2]
    assert long["legendgroup"] == short["legendgroup"]
    assert ("showlegend" in long, short["showlegend"]) == (False, False)
    curves = next(each.curves for each in found.sections if each.curves)
    assert next(each for each in curves["data"] if each["name"] == "wavy_one")["line"] == long["line"]  # one colour
    assert convergence_plot({"one": ()}, {"one": 0}) is None


def test_pictures_are_left_out_where_they_would_not_be_those_of_the_run(
    ran: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes = {each.name: (each.note, each.image is None) for each in content(ran.folder, [], quiet).sections}
    assert notes == {"grain": ("", False), "elsewhere": (ABSENT, True)}
    other = replace(ran.scene, content="another specimen")
    monkeypatch.setattr(benchmarks.reporting.report, "suite", lambda *_args, **_more: (other,))
    (section, _) = content(ran.folder, [], quiet).sections
    assert (section.note, section.image, section.curves) == (CHANGED, None, None)
    assert len(section.cards) == len(METHODS)


def test_colours_are_those_of_the_scale() -> None:
    for colours in (HEIGHTS, ERRORS):
        shown = coloured(np.array([-9.0, -1.0, 0.0, 1.0, 9.0, np.nan]), (-1.0, 1.0), colours)
        wanted = [colours[0], colours[0], colours[len(colours) // 2], colours[-1], colours[-1]]
        assert ["#" + bytes(each).hex() for each in shown[:-1]] == list(wanted)
        assert tuple(shown[-1]) == MISSING


def test_the_curve_of_errors_ends_at_completeness_and_crosses_half_at_the_median() -> None:
    errors = np.concatenate([np.linspace(-2, 2, 4001), np.full(1000, np.nan)])
    (curve,) = error_curves({"one": errors, "none": np.full(3, np.nan)}, 5001, {"one": 0, "none": 1})["data"]
    x, y = np.array(curve["x"]), np.array(curve["y"])
    assert y[-1] == pytest.approx(4001 / 5001, rel=1e-3)
    assert x[-1] == pytest.approx(2)
    assert np.interp(0.5 * 4001 / 5001, y, x) == pytest.approx(1.0, rel=0.01)
    assert np.all(np.diff(x) >= 0)


def test_a_sweep_is_drawn_from_its_table(tmp_path: Path) -> None:
    section = sweep_section(write_sweep(tmp_path / "sweep", ("dose",)))
    (_, figure), _ = section.figures
    one, two, bound, predicted = figure["data"]
    assert (one["x"], one["y"]) == ([1.0, 10.0, 100.0], [1.5, 0.15, 0.015])
    assert two["y"] == [4.0, 0.3, 0.03]  # where one repetition failed, the mean is that of the other
    assert two["error_y"]["array"][0] == 0  # and has no interval
    assert one["error_y"]["array"][0] == pytest.approx(0.5)
    assert bound["y"] == [0.1, 0.01, 0.001]
    assert predicted["y"] == [None] * 3
    assert figure["layout"]["xaxis"]["type"] == "log"
    assert section.failures == (f"two, 1 of 6 cases: {HOSTILE}",)


def test_a_sweep_of_two_axes_is_a_map_a_method(tmp_path: Path) -> None:
    section = sweep_section(write_sweep(tmp_path / "sweep", ("tilt", "dose")))
    assert [caption.partition(":")[0] for caption, _ in section.figures] == ["Cramér-Rao bound", "one", "two"]
    traces = [figure["data"][0] for _, figure in section.figures]
    assert {(each["zmin"], each["zmax"]) for each in traces} == {(0.001, 4.0)}  # colours can be compared
    trace = traces[1]
    assert np.array(trace["z"], dtype=float).shape == (3, 3)
    np.testing.assert_allclose(np.diag(np.array(trace["z"], dtype=float)), [1.5, 0.15, 0.015])
    assert trace["z"][0][1] is None


def test_a_manifest_comes_back_as_it_was(ran: Ran, tmp_path: Path) -> None:
    manifest = read_manifest(ran.folder)
    assert manifest.methods[0].needs == ("rotations", "pixel_size")
    assert [each.key for each in manifest.cases] == [each.key for each in ran.plan.cases]
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"scenes": 3}), "\xff"])
def test_a_damaged_manifest_is_one_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match="is damaged"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--run", "{new}"], "holds no run; make one"),
        (["--run", "{run}", "--sweep", "{new}"], "is no folder of a sweep"),
        (["--run", "{run}", "--sweep", "{table}"], "is no table of a sweep"),
        (["--run", "{run}", "--out", "{run}"], "is a folder; name a file"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_2(arguments: list[str], sentence: str, ran: Ran, tmp_path: Path) -> None:
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "sweep.csv").write_text("a,b\n1,2\n")
    places = {"new": tmp_path / "new", "run": ran.folder, "table": tmp_path / "table"}
    filled = [each.format(**places) for each in arguments]
    result = CliRunner().invoke(app, ["report", *filled])
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("Error:") == 1
    assert not (tmp_path / "new").exists()
    assert not (ran.folder / "report.html").exists()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[chromium.Chromium]:
    binary = chromium.found()
    if binary is None:
        pytest.skip(
            "there is no Chromium to look at the page with: install it (Debian: chromium), or name it in CHROMIUM"
        )
    opened = chromium.Chromium(binary, tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


@pytest.fixture
def wide(browser: chromium.Chromium, page: Path) -> chromium.Chromium:
    browser.open(page, 1280)
    return browser


def column(browser: chromium.Chromium, table: str, number: int) -> list[str]:
    rows = f"[...document.querySelectorAll('#{table} tbody tr')].filter(row => row.offsetParent !== null)"
    return list(browser.ask(f"{rows}.map(row => row.cells[{number}].textContent.trim())"))


def number(text: str) -> float:
    return float("nan") if text == "–" else float(text)


def click(browser: chromium.Chromium, what: str) -> None:
    browser.ask(f"document.querySelector({json.dumps(what)}).click()")


def choose(browser: chromium.Chromium, what: str, value: str) -> None:
    asked = f"(box => {{ box.value = {json.dumps(value)}; box.dispatchEvent(new Event('change')); }})"
    browser.ask(f"{asked}(document.querySelector({json.dumps(what)}))")


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_a_browser_shows_all_without_complaint_or_overflow(
    browser: chromium.Chromium, page: Path, width: int, dark: bool
) -> None:
    browser.complaints.clear()
    browser.asked.clear()
    browser.open(page, width, dark=dark)
    for number in range(browser.ask("document.querySelectorAll('.plot').length")):
        browser.ask(f"document.querySelectorAll('.plot')[{number}].scrollIntoView({{behavior: 'instant'}})")
        browser.wait(f"document.querySelectorAll('.plot')[{number}].querySelector('.main-svg') !== null")
    assert browser.ask(f"[...document.querySelectorAll('.plot')].every({LEGEND_IS_CLEAR})")
    assert browser.ask("document.querySelectorAll('#convergence-grain .scatterlayer .trace').length") == 2
    assert browser.ask("document.querySelectorAll('#convergence-grain .legend .traces').length") == 1
    ticks = "[...document.querySelectorAll('#convergence-grain .ytick')].map(each => each.textContent)"
    assert all(each.startswith("10") or each == "1" for each in browser.ask(ticks))  # powers of ten alone
    browser.wait("[...document.images].every(each => { each.loading = 'eager'; return each.complete; })")
    assert browser.ask("[...document.images].every(each => each.naturalWidth > 0)")
    assert browser.ask("document.images.length") == 3 + 2 * 3
    assert browser.ask("document.documentElement.scrollWidth") <= width
    assert browser.ask("document.title") == "SEM reconstruction bench"
    assert browser.complaints == []
    assert {address for address in browser.asked if not address.startswith("data:")} == {page.resolve().as_uri()}


def test_a_click_sorts_and_another_turns_the_order(wide: chromium.Chromium) -> None:
    heading = "#entries thead th:nth-child(3) button"
    click(wide, heading)
    rising = column(wide, "entries", 2)
    known = [float(each) for each in rising if each != "–"]
    assert len(known) == 4
    assert known == sorted(known)
    assert rising[len(known) :] == ["–"] * 3
    click(wide, heading)
    falling = column(wide, "entries", 2)
    assert [float(each) for each in falling[: len(known)]] == known[::-1]
    assert falling[len(known) :] == ["–"] * 3  # no number is last both ways
    assert wide.ask("document.querySelector('#entries th:nth-child(3)').ariaSort") == "descending"
    click(wide, "#entries thead th:nth-child(1) button")
    names = column(wide, "entries", 0)
    assert names == sorted(names)


def test_filters_leave_what_was_asked_for(wide: chromium.Chromium) -> None:
    assert set(column(wide, "overview", 0)) == {"wavy_one", "half_done", "fails", "oracle_level †"}
    click(wide, "[data-need=rotations]")
    assert set(column(wide, "overview", 0)) == {"half_done", "fails", "oracle_level †"}
    assert "wavy_one" not in column(wide, "entries", 0)
    click(wide, "#oracles")
    assert set(column(wide, "overview", 0)) == {"half_done", "fails"}
    click(wide, "[data-need=rotations]")
    choose(wide, "#scene", "elsewhere")
    assert set(column(wide, "entries", 1)) == {"elsewhere"}
    assert set(column(wide, "entries", 0)) == {"wavy_one", "half_done", "fails"}
    assert wide.ask("[...document.querySelectorAll('#overview thead th:not([hidden])')].length") == 3
    assert wide.ask("document.querySelector('#shown').textContent") == "3 of 7 lines"


def test_the_overview_shows_the_metric_that_is_chosen(wide: chromium.Chromium) -> None:
    choose(wide, "#metric", "completeness")
    shown = dict(zip(column(wide, "overview", 0), column(wide, "overview", 1), strict=True))
    assert shown["wavy_one"] == "1"
    assert 0.3 < float(shown["half_done"]) < 0.7
    assert shown["fails"] == "–"
    best = "[...document.querySelectorAll('#overview .best')].map(cell => cell.parentElement.dataset.method)"
    assert set(wide.ask(best)) == {"wavy_one"}  # never the oracle
    click(wide, "#overview thead th:nth-child(2) button")
    assert column(wide, "overview", 1)[-1] == "–"
    choose(wide, "#metric", "efficiency")
    found = zip(column(wide, "overview", 0), column(wide, "overview", 1), strict=True)
    ratios = {name: number(text) for name, text in found}
    assert ratios["wavy_one"] == pytest.approx(4 * ratios["oracle_level †"], rel=0.02)  # over the same pixels
    assert np.isnan(ratios["fails"])


@pytest.mark.parametrize("plot", ["#sweep-1-1", "#convergence-grain"])
def test_a_drag_zooms_a_plot(wide: chromium.Chromium, plot: str) -> None:
    wide.ask(f"document.querySelector('{plot}').scrollIntoView({{behavior: 'instant', block: 'center'}})")
    wide.wait(f"document.querySelector('{plot} .nsewdrag') !== null")
    span = f"(range => range[1] - range[0])(document.querySelector('{plot}')._fullLayout.xaxis.range)"
    before = wide.ask(span)
    x, y, width, height = wide.ask(
        "(box => [box.x, box.y, box.width, box.height])"
        f"(document.querySelector('{plot} .nsewdrag').getBoundingClientRect())"
    )
    wide.drag((x + 0.25 * width, y + 0.25 * height), (x + 0.75 * width, y + 0.75 * height))
    wide.wait(f"{span} < {0.9 * before}")
    assert wide.ask(span) == pytest.approx(before / 2, rel=0.05)


def test_every_table_is_a_table_with_headings(read: Reader) -> None:
    tables = [each for tag, each in read.tags if tag == "table"]
    assert len(tables) == 5
    assert len([tag for tag, _ in read.tags if tag == "caption"]) == len(tables)
    assert all(each.get("scope") in ("col", "row") for tag, each in read.tags if tag == "th")
    assert all(each.get("alt") for tag, each in read.tags if tag == "img")
    ids = [str(each["id"]) for _, each in read.tags if "id" in each]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[\w-]+", each) for each in ids)
