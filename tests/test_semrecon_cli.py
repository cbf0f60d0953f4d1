"""Claims on the `semrecon` command: what it reads, what wins over what, what it writes, how fast it answers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from click.testing import Result
from known_surface import KnowsTheBump, bump_series, bump_um, grid_um
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.input.series import write_series
from semrecon.methods import METHODS
from semrecon.output.export import FILES

SLOW = ("open3d", "rerun", "matplotlib", "cv2", "scipy", "numba", "numpy", "tifffile", "PIL", "trimesh", "skimage")
TILTS = (0.0, 6.0, 12.0)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "series"
    write_series(bump_series(TILTS), folder)
    return folder


@pytest.fixture(scope="module")
def images(series: Path) -> list[Path]:
    return sorted(series.glob("*.tif"))


def zeiss_file(path: Path, tilt: float, pixel_nm: float = 100.0) -> Path:
    """Write a small image with the block of a Zeiss microscope."""
    lines = ["\r\n0", "AP_IMAGE_PIXEL_SIZE", f"Image Pixel Size = {pixel_nm} nm", "AP_STAGE_AT_T"]
    lines += [f"Stage at T = {tilt} °", "DP_STAGE_TILTED", "Stage Tilt = in X", "DP_IMAGE_STORE"]
    lines += ["Store resolution = 120 * 160", ""]  # turned by a quarter after the scan: the axis is vertical
    block = "\r\n".join(lines).encode("cp1252")
    image = bump_series((tilt,)).views[0].image
    tifffile.imwrite(path, image, extratags=[(34118, 7, len(block), block, True)], metadata=None)
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Options that choose a method which answers at once."""
    monkeypatch.setattr("semrecon.methods.METHODS", (*METHODS, KnowsTheBump()))
    return ["--method", "knows_the_bump"]


def report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def test_help_imports_nothing_slow() -> None:
    code = f"import sys, semrecon.cli; print(sorted(set({SLOW}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_installed_command_answers() -> None:
    command = Path(sys.executable).with_name("semrecon")
    done = subprocess.run([command, "--help"], capture_output=True, text=True, check=True)
    assert "reconstruct" in done.stdout


def test_a_series_folder(series: Path, tmp_path: Path) -> None:
    result = run("reconstruct", series, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(FILES)
    assert "median sigma" in result.stdout
    assert report(tmp_path / "out")["series"]["stated_by"] == ["series.toml"]
    error = tifffile.imread(tmp_path / "out" / "height.tif") - bump_um(*grid_um())
    error -= np.nanmedian(error)  # the gauge: absolute height cannot be seen
    assert np.nanmedian(np.abs(error)) < 0.1  # of 3 um, upright


def test_plain_images_give_what_the_folder_gives(
    series: Path, images: list[Path], tmp_path: Path, quick: list[str]
) -> None:
    run("reconstruct", series, "--out", tmp_path / "a")
    result = run(
        "reconstruct",
        *images,
        "--tilts",
        "0,6,12",
        "--pixel-size-um",
        "0.1",
        "--tilt-axis-deg",
        "0",
        "--out",
        tmp_path / "b",
    )
    assert result.exit_code == 0, result.output
    for name in ("height.tif", "sigma.tif", "points.ply", "mesh.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_tilts_may_begin_with_a_minus_sign(images: list[Path], tmp_path: Path, quick: list[str]) -> None:
    result = run(
        "reconstruct", *quick, *images, "--tilts", "-9,-3,3.5", "--pixel-size-um", "0.1", "--out", tmp_path / "out"
    )
    assert result.exit_code == 0, result.output
    assert [view["tilt_deg"] for view in report(tmp_path / "out")["series"]["views"]] == [-9, -3, 3.5]


def test_flip_tilt_turns_the_sign(series: Path, tmp_path: Path, quick: list[str]) -> None:
    run("reconstruct", *quick, series, "--out", tmp_path / "out", "--flip-tilt")
    assert [view["tilt_deg"] for view in report(tmp_path / "out")["series"]["views"]] == [0, -6, -12]


def test_crop_bottom_cuts_every_image(series: Path, tmp_path: Path, quick: list[str]) -> None:
    run("reconstruct", *quick, series, "--out", tmp_path / "out", "--crop-bottom", "20")
    assert tifffile.imread(tmp_path / "out" / "height.tif").shape == (100, 160)


def test_flags_win_and_say_so(series: Path, tmp_path: Path, quick: list[str]) -> None:
    flags = ["--pixel-size-um", "0.2", "--tilts", "0,6,11", "--tilt-axis-deg", "0.5"]
    result = run("reconstruct", *quick, series, "--out", tmp_path / "out", *flags)
    assert result.exit_code == 0, result.output
    for sentence in ("--pixel-size-um 0.2 overrides 0.1", "--tilts overrides", "--tilt-axis-deg 0.5 overrides 0"):
        assert sentence in result.stderr
        assert any(sentence in warning for warning in report(tmp_path / "out")["warnings"])
    stated = report(tmp_path / "out")["series"]
    assert (stated["pixel_size_um"], stated["tilt_axis_deg"], stated["views"][2]["tilt_deg"]) == (0.2, 0.5, 11)


def test_flags_that_agree_say_nothing(series: Path, tmp_path: Path, quick: list[str]) -> None:
    result = run(
        "reconstruct", *quick, series, "--out", tmp_path / "out", "--pixel-size-um", "0.1", "--tilts", "0,6,12"
    )
    assert "overrides" not in result.stderr


def test_zeiss_files_need_no_flags(tmp_path: Path, quick: list[str]) -> None:
    files = [zeiss_file(tmp_path / f"{i}.tif", tilt) for i, tilt in enumerate((-6.0, 0.0, 6.0))]
    result = run("reconstruct", *quick, *files, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    stated = report(tmp_path / "out")["series"]
    assert [view["tilt_deg"] for view in stated["views"]] == [-6, 0, 6]
    assert stated["pixel_size_um"] == pytest.approx(0.1)
    assert stated["stated_by"] == ["Zeiss metadata"]


def test_info_shows_what_each_file_says(tmp_path: Path) -> None:
    files = [zeiss_file(tmp_path / f"{i}.tif", tilt, 100 + i) for i, tilt in enumerate((-6.0, 0.5))]
    result = run("info", *files)
    assert result.exit_code == 0, result.output
    first, second = (line.split() for line in result.stdout.splitlines()[1:3])
    assert first[1:] == ["160", "x", "120", "8", "bit", "0.1", "-6", "0", "-", "Zeiss", "metadata"]
    assert second[6:8] == ["0.101", "0.5"]


def test_info_of_a_series_folder(series: Path) -> None:
    result = run("info", series)
    assert result.exit_code == 0, result.output
    assert result.stdout.count("series.toml") == 3


def test_methods_are_listed() -> None:
    result = run("methods")
    assert result.exit_code == 0, result.output
    assert "known_rotation" in result.stdout


def test_a_recording_on_request(series: Path, tmp_path: Path, quick: list[str]) -> None:
    result = run("reconstruct", *quick, series, "--out", tmp_path / "out", "--rerun")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "reconstruction.rrd").stat().st_size > 1000


def test_again_into_the_same_folder_with_the_same_seed_is_the_same_surface(series: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run("reconstruct", series, "--out", out, "--seed", "3", "--rerun")
    before = (out / "height.tif").read_bytes()
    result = run("reconstruct", series, "--out", out, "--seed", "3")
    assert result.exit_code == 0, result.output
    assert (out / "height.tif").read_bytes() == before
    assert not (out / "reconstruction.rrd").exists()  # the old folder went as a whole


@pytest.mark.skipif("SEM_REAL_DATA" not in os.environ, reason="SEM_REAL_DATA names no folder of real images")
def test_info_of_real_zeiss_files() -> None:
    files = sorted((Path(os.environ["SEM_REAL_DATA"]) / "potamogeton").glob("*.tif"))
    result = run("info", *files)
    assert [line.split()[7] for line in result.stdout.splitlines()[1:8]] == ["-9", "-6", "-3", "0", "3", "6", "9"]


def test_the_default_method_can_be_told_to_trust_the_stage(series: Path, tmp_path: Path) -> None:
    result = run("reconstruct", series, "--out", tmp_path / "out", "--no-refine")
    assert result.exit_code == 0, result.output
    held = report(tmp_path / "out")["options"]["refinement"]
    assert not any(held[part] for part in ("tilts", "axis", "magnifications", "rotations"))


def test_options_of_the_method_reach_the_report(series: Path, tmp_path: Path) -> None:
    flags = ["--method", "known_rotation", "--refine", "--tilt-sigma-deg", "0.5", "--set", "pairs=all"]
    result = run("reconstruct", series, "--out", tmp_path / "out", *flags)
    assert result.exit_code == 0, result.output
    options = report(tmp_path / "out")["options"]
    assert options["refine"] is True
    assert options["refinement"]["tilt_sigma_deg"] == 0.5
    assert options["pairs"] == "all"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--tilt-sigma-deg", "0"], "--tilt-sigma-deg must be a positive number"),
        (["--set", "speed=3"], "no option 'speed'"),
        (["--set", "refine"], "NAME=VALUE"),
        (["--method", "disparity", "--refine"], "refines nothing, so --refine does not go with it"),
        (["--method", "disparity", "--no-refine"], "refines nothing, so --no-refine does not go with it"),
    ],
)
def test_options_that_do_not_fit_are_one_sentence(series: Path, tmp_path: Path, flags: list[str], said: str) -> None:
    result = run("reconstruct", series, "--out", tmp_path / "out", "--method", "known_rotation", *flags)
    assert result.exit_code == 2
    assert said in result.stderr
    assert not (tmp_path / "out").exists()


def test_two_reconstructions_are_compared(series: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        run("reconstruct", series, "--out", tmp_path / name, "--method", "known_rotation")
    result = run("compare", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "difference")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "difference" / "comparison.json").read_text())
    assert content["difference"]["median_abs_um"] == 0.0
    assert (tmp_path / "difference" / "difference.tif").is_file()
    refused = run("compare", tmp_path / "a", tmp_path / "missing")
    assert refused.exit_code == 2
    assert "missing" in refused.stderr


def test_a_later_view_is_posed_or_says_why_not(series: Path, tmp_path: Path) -> None:
    blank = tmp_path / "blank.tif"
    tifffile.imwrite(blank, np.full((120, 160), 7, dtype=np.uint8))
    flags = ["--method", "known_rotation", "--later", blank, "--later", series / "view_01.tif"]
    result = run("reconstruct", series, "--out", tmp_path / "out", *flags)
    assert result.exit_code == 0, result.output
    failed, posed = report(tmp_path / "out")["later_views"]
    assert "blank.tif" in result.stderr
    assert failed["failure"]
    tilt = np.rad2deg(np.arctan2(-posed["rotation_cam_from_world"][2][0], -posed["rotation_cam_from_world"][2][2]))
    assert abs(tilt) == pytest.approx(6.0, abs=0.5)


def test_a_working_distance_makes_the_projection_central(series: Path, tmp_path: Path) -> None:
    result = run("reconstruct", series, "--out", tmp_path / "out", "--working-distance-mm", "5")
    assert result.exit_code == 0, result.output
    assert report(tmp_path / "out")["series"]["inverse_working_distance"] == pytest.approx(1 / 5000)
    refused = run("reconstruct", series, "--out", tmp_path / "no", "--working-distance-mm", "0")
    assert (refused.exit_code, "--working-distance-mm must be" in refused.stderr) == (2, True)


def test_methods_that_look_at_no_tilts_ask_for_none(images: list[Path], tmp_path: Path) -> None:
    given = [images[0], "--pixel-size-um", "0.1", "--out", tmp_path / "out", "--crop-bottom", "0"]
    result = run("reconstruct", *given, "--method", "shape_from_shading")
    assert result.exit_code == 0, result.output
    refused = run("reconstruct", *images[:2], *given[1:], "--method", "known_rotation")
    assert (refused.exit_code, "states no tilt angle" in refused.stderr) == (2, True)
