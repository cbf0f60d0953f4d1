"""The regression gate: faults planted on purpose are caught, with a sentence that says what moved; sound code passes.

A fault is planted by a plugin of pytest that changes a function before anything else imports it, as an edit of the
source would, and the gate is run as `tox -e bench` runs it. The same by hand, for the slower kernel on the committed
ratios, with the module of the test below as `planted.py`::

    PYTHONPATH=. python -m pytest benchmarks/test_kernels.py -k semi-global -p planted
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.commands import baselines as command
from benchmarks.gate.commitment import (
    FLOOR,
    LEAST,
    Bound,
    Part,
    bound,
    bounds_of,
    means_of,
    read_commitment,
    shifts,
    write_commitment,
)
from benchmarks.gate.kernels import KERNELS
from benchmarks.gate.pace import Pace, Slower, pace, pace_of, read_paces, too_slow, write_paces
from benchmarks.gate.project import ACCURACY, TIME
from semrecon.methods import known_rotation

ROOT = Path(__file__).resolve().parent.parent

BIAS = """
from semrecon.points import triangulation

exact = triangulation.intersect

def biased(xy_px, weights, views):
    xy_px = xy_px.copy()
    xy_px[:, -1, 0] += 0.1
    return exact(xy_px, weights, views)

triangulation.intersect = biased
"""
SIGN = """
from semrecon import geometry

right = geometry.tilt_rotation
geometry.tilt_rotation = lambda tilt_deg, tilt_axis_deg=0.0: right(-tilt_deg, tilt_axis_deg)
"""
SLOW = """
from semrecon.matches import semiglobal

once = semiglobal.match_rows

def twice(*arguments):
    once(*arguments)
    return once(*arguments)

semiglobal.match_rows = twice
"""


def gate(folder: Path, fault: str, *arguments: str) -> tuple[int, str]:
    """Run the gate on the kernels with a fault planted; exit status and what was said."""
    pytest.importorskip("pytest_benchmark")
    (folder / "planted.py").write_text(fault)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "benchmarks/test_kernels.py",
        "-q",
        "-p",
        "planted",
        "-p",
        "no:cacheprovider",
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(folder)])  # and as a worker it would not take times
    done = subprocess.run(
        [*command, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def figures(said: str, metric: str) -> tuple[float, float, float]:
    """Before, after and tolerance in the sentence on a metric."""
    found = re.search(rf"{metric} was (\S+) and is (\S+), which is more than the tolerance of (\S+) away", said)
    assert found, said
    before, after, tolerance = map(float, found.groups())
    return before, after, tolerance


def test_sound_kernels_pass(tmp_path: Path) -> None:
    status, said = gate(tmp_path, "", "-k", "triangulation or translation", "--benchmark-disable")
    assert status == 0, said


def test_a_bias_of_a_tenth_of_a_pixel_in_triangulation_is_caught(tmp_path: Path) -> None:
    status, said = gate(tmp_path, BIAS, "-k", "triangulation or translation", "--benchmark-disable")
    assert status == 1
    before, after, tolerance = figures(said, "kernels, triangulation of exact matches: depth_bias_um")
    assert abs(before) < 1e-9
    assert abs(after) > 100 * tolerance
    before, after, tolerance = figures(said, "kernels, triangulation: depth_bias_um")
    assert abs(after - before) > 5 * tolerance
    assert "kernels, translation" not in said


def test_a_swapped_sign_of_the_tilt_is_caught(tmp_path: Path) -> None:
    status, said = gate(tmp_path, SIGN, "-k", "triangulation or translation", "--benchmark-disable")
    assert status == 1
    before, after, tolerance = figures(said, "kernels, translation: depth_scale")
    assert before == pytest.approx(1, abs=0.01)
    assert after == pytest.approx(-1, abs=0.01)
    assert tolerance < 0.1


@pytest.mark.slow
def test_a_kernel_that_takes_twice_as_long_is_caught(tmp_path: Path) -> None:
    """Commit to the speed of a kernel on this machine; the gate passes it as it is, and names it when it runs twice."""
    kernel = next(each for each in KERNELS if each.name == "semi-global matching")
    write_paces({kernel.name: pace_of(kernel.trial(0).call, kernel.reference)}, tmp_path / "time.json")
    path = str(tmp_path / "time.json")
    here = f"from pathlib import Path\nfrom benchmarks.gate import project\nproject.TIME = Path({path!r})\n"
    sound, unsaid = gate(tmp_path, here, "-k", "semi-global")
    assert sound == 0, unsaid
    slow, said = gate(tmp_path, here + SLOW, "-k", "semi-global")
    assert slow == 1, said
    pattern = r"semi-global matching: processor time was \S+ and is \S+ times .* as much; the tolerance is 1\.\d+ times"
    assert re.search(pattern, said), said


def test_faults_are_no_faults_of_what_is_committed() -> None:
    """Everything is committed to by a tolerance that a fault of its own size passes."""
    part = read_commitment(ACCURACY)["kernels"].bounds["kernels"]
    assert set(part) == {kernel.name for kernel in KERNELS}
    assert part["triangulation of exact matches"]["depth_bias_um"].tolerance == FLOOR
    assert part["translation"]["depth_scale"].tolerance < 0.1
    assert all(1 < known.factor < 2 for known in read_paces(TIME).values())


# --- the rule -------------------------------------------------------------------------------------------------------


def test_a_tolerance_is_of_the_spread_of_all_about_the_mean_of_the_first() -> None:
    values = np.array([1.0, 2.0, 3.0, 10.0])
    assert bound(values, 3).mean == 2.0
    assert bound(values, 3).tolerance == pytest.approx(4 * values.std(ddof=1) / np.sqrt(3), rel=0.01)
    assert bound(np.full(4, -5.0), 3) == Bound(-5.0, 5 * LEAST)
    assert bound(np.zeros(4), 3) == Bound(0.0, FLOOR)


def test_means_of_fresh_draws_stay_within_their_tolerances() -> None:
    """Two-sided: of 2000 means of other noise few leave, and those that leave are not none."""
    rng = np.random.default_rng(0)
    left = 0
    for _ in range(2000):
        known, now = bound(rng.normal(0, 1, 6), 3), rng.normal(0, 1, 3).mean()
        left += abs(now - known.mean) > known.tolerance
    assert 0 < left < 0.1 * 2000


def test_what_is_gone_has_left_its_tolerance() -> None:
    part = Part(1, 0, {"scene": {"mine": {"rms_um": Bound(1.0, 0.1)}}})
    for now, seen in ((1.05, False), (0.85, True), (1.2, True), (float("nan"), True)):
        assert bool(shifts("scene", {"mine": {"rms_um": now}}, part)) == seen
    (gone,) = shifts("scene", {}, part, {"mine": "found no match"})
    assert "scene, mine: rms_um was 1 and is nan (found no match), which is more than the tolerance of 0.1" in str(gone)


def test_a_repetition_without_an_answer_is_no_mean_and_no_commitment() -> None:
    figures = {"mine": [{"rms_um": 1.0, "points": 3.0}, {"points": 3.0}, {"rms_um": 1.0, "points": 3.0}]}
    assert np.isnan(means_of(figures)["mine"]["rms_um"])
    assert list(bounds_of(figures, 2)["mine"]) == ["points"]


@pytest.mark.parametrize(("spread", "factor"), [(0.0, 1.5), (0.13, 1.68), (1.0, 1.7)])
def test_a_factor_follows_the_spread_and_twice_is_always_too_slow(spread: float, factor: float) -> None:
    steps = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    known = pace("loops", 3.0 * np.exp(spread * steps / steps.std(ddof=1)))
    assert known.ratio == 3.0
    assert known.factor == pytest.approx(factor, abs=0.01)
    assert too_slow(known, 6.0)
    assert too_slow(known, float("nan"))
    assert not too_slow(known, 3.0 * 1.4)


def test_the_sentence_on_time_has_metric_before_after_and_tolerance() -> None:
    said = str(Slower("plane sweep", Pace("loops", 0.5, 1.6), 1.0))
    assert "plane sweep: processor time was 0.5 and is 1 times that of the reference 'loops'" in said
    assert "2.00 times as much; the tolerance is 1.60 times" in said


# --- baselines of one's own -----------------------------------------------------------------------------------------


def run(arguments: Sequence[str]) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["baselines", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_a_method_is_committed_to_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mine.json"
    monkeypatch.setattr(command, "_scratch", lambda: nullcontext(tmp_path / "cache"))  # rendered once, not three times
    small = ["--scenes", "fracture_rough", "--columns", "96", "--seeds", "2", "--file", str(file)]
    status, out, _ = run(["--methods", "known-rotation", *small])
    assert status == 0
    assert out.endswith(f"figures on fracture_rough to {file}.\n")
    status, out, err = run(["--check", "--file", str(file)])
    assert status == 0, err
    assert out.startswith("Nothing moved")
    right = known_rotation.rotations_from_tilts
    monkeypatch.setattr(known_rotation, "rotations_from_tilts", lambda tilts, axis=0.0: right(-tilts, axis))
    status, _, err = run(["--check", "--file", str(file)])
    assert status == 1
    _, after, _ = figures(err, "fracture_rough, known_rotation: scale")
    assert after < 0
    assert f"--file {file}" in err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--methods", "nobody", "--file", "{new}"], "--methods names no method 'nobody'"),
        (["--methods", "disparity", "--scenes", "nowhere", "--file", "{new}"], "--scenes names no scene 'nowhere'"),
        (
            ["--methods", "light_field", "--scenes", "steps", "--columns", "64", "--file", "{new}"],
            "nothing to commit to",
        ),
        (["--file", "{new}"], "--file needs --methods"),
        (["--methods", "disparity"], "name their file with --file"),
        (["--methods", "disparity", "--file", "{new}/none/mine.json"], "there is no folder"),
        (["--check", "--file", "{new}"], "cannot be read"),
        (["--check", "--file", "{text}"], "holds no baselines"),
        (["--check", "--file", "{empty}"], "commits to nothing"),
        (["--check", "--methods", "disparity", "--file", "{text}"], "--check takes methods and scenes from"),
        (["--check", "--only", "speed"], "--only names no part 'speed'"),
        (["--times", "--check"], "--times writes times and nothing else"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_2(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    files = {name: str(tmp_path / name) for name in ("new", "text", "empty")}
    (tmp_path / "text").write_text("[1, 2]")
    (tmp_path / "empty").write_text("{}")
    status, _, err = run([each.format(**files) for each in arguments])
    assert status == 2
    assert sentence in err
    assert [line for line in err.splitlines() if not line.startswith("measuring")] == [err.splitlines()[-1]]
    assert not (tmp_path / "new").exists()


def test_baselines_come_back_from_their_file(tmp_path: Path) -> None:
    part = Part(3, 213, {"scene": {"mine": {"rms_um": Bound(1.0, 0.1)}}})
    write_commitment({"methods": part}, tmp_path / "mine.json")
    assert read_commitment(tmp_path / "mine.json") == {"methods": part}
    assert part.only("scene", "mine") == replace(part)
    assert json.loads((tmp_path / "mine.json").read_text())["methods"]["repetitions"] == 3


# --- workflows ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", [".github/workflows/bench.yml", "docs/ci/regression.yml"])
def test_workflows_are_sound_and_call_what_there_is(file: str) -> None:
    yaml = pytest.importorskip("yaml")
    workflow = yaml.safe_load((ROOT / file).read_text())
    assert workflow["permissions"] == {"contents": "read"}
    known = set(re.findall(r"^  (\w+) ", (ROOT / "dev").read_text(), re.MULTILINE))
    (job,) = workflow["jobs"].values()
    for step in job["steps"]:
        assert ("uses" in step) != ("run" in step)
        assert "uses" not in step or re.fullmatch(r"actions/(checkout|setup-python)@v\d+", step["uses"])
        assert set(re.findall(r"\./dev (\w+)", step.get("run", ""))) <= known
    assert "--benchmark-disable" in job["steps"][-1]["run"] or "--check --file" in job["steps"][-1]["run"]
