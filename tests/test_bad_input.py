"""The promise to users of `semrecon`: bad input gives one sentence, exit status 2, and nothing written."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from known_surface import bump_series
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.input.series import write_series

Arguments = list[object]


def noise(seed: int) -> np.ndarray:
    """An image that has nothing in common with those of other seeds."""
    return np.random.default_rng(seed).integers(0, 255, (120, 160), dtype=np.uint8)


@pytest.fixture
def series(tmp_path: Path) -> Path:
    write_series(bump_series((0.0, 6.0)), tmp_path / "series")
    return tmp_path / "series"


def missing_file(series: Path) -> Arguments:
    return [series / "view_00.tif", series / "nowhere.tif", "--tilts", "0,6", "--pixel-size-um", "0.1"]


def not_an_image(series: Path) -> Arguments:
    (series / "view_01.tif").write_text("dear diary")
    return [series]


def a_folder_without_a_series(series: Path) -> Arguments:
    (series / "series.toml").unlink()
    return [series]


def an_image_that_the_series_names_is_missing(series: Path) -> Arguments:
    (series / "view_01.tif").unlink()
    return [series]


def different_sizes(series: Path) -> Arguments:
    tifffile.imwrite(series / "view_01.tif", noise(0)[:100])
    return [series]


def one_image(series: Path) -> Arguments:
    return [series / "view_00.tif", "--tilts", "0", "--pixel-size-um", "0.1"]


def all_tilts_equal(series: Path) -> Arguments:
    return [series, "--tilts", "3,3"]


def nan_tilt(series: Path) -> Arguments:
    return [series, "--tilts", "0,nan"]


def nan_tilt_in_toml(series: Path) -> Arguments:
    toml = series / "series.toml"
    toml.write_text(toml.read_text().replace("6.0", "nan"))
    return [series]


def no_tilts(series: Path) -> Arguments:
    return [series / "view_00.tif", series / "view_01.tif", "--pixel-size-um", "0.1"]


def a_tilt_too_few(series: Path) -> Arguments:
    return [series, "--tilts", "0"]


def tilts_that_are_words(series: Path) -> Arguments:
    return [series, "--tilts", "left,right"]


def no_pixel_size(series: Path) -> Arguments:
    return [series / "view_00.tif", series / "view_01.tif", "--tilts", "0,6"]


def zero_pixel_size(series: Path) -> Arguments:
    return [series, "--pixel-size-um", "0"]


def negative_pixel_size(series: Path) -> Arguments:
    return [series, "--pixel-size-um", "-0.1"]


def zero_pixel_size_in_toml(series: Path) -> Arguments:
    toml = series / "series.toml"
    toml.write_text(toml.read_text().replace("0.1", "0.0"))
    return [series]


def blank_image(series: Path) -> Arguments:
    tifffile.imwrite(series / "view_01.tif", np.full((120, 160), 9, dtype=np.uint8))
    return [series]


def too_few_matches(series: Path) -> Arguments:
    tifffile.imwrite(series / "view_01.tif", noise(1))
    return [series]


def truncated_tiff(series: Path) -> Arguments:
    content = (series / "view_01.tif").read_bytes()
    (series / "view_01.tif").write_bytes(content[: len(content) // 2])
    return [series]


def unknown_key(series: Path) -> Arguments:
    toml = series / "series.toml"
    toml.write_text("pixle_size_um = 3\n" + toml.read_text())
    return [series]


def broken_toml(series: Path) -> Arguments:
    (series / "series.toml").write_text("pixel_size_um = = 1")
    return [series]


def unknown_method(series: Path) -> Arguments:
    return [series, "--method", "crystal-ball"]


def folder_beside_images(series: Path) -> Arguments:
    return [series, series / "view_00.tif"]


def cropped_to_nothing(series: Path) -> Arguments:
    return [series, "--crop-bottom", "120"]


CASES = {
    missing_file: "nowhere.tif does not exist",
    not_an_image: "view_01.tif is not an image",
    a_folder_without_a_series: "holds no series.toml",
    an_image_that_the_series_names_is_missing: "view_01.tif does not exist",
    different_sizes: "view_01.tif is 160 x 100 px, expected 160 x 120",
    one_image: "one image (view_00.tif) cannot show depth",
    all_tilts_equal: "no parallax",
    nan_tilt: "view_01.tif has no tilt angle",
    nan_tilt_in_toml: "view_01.tif has no tilt angle",
    no_tilts: "view_00.tif states no tilt angle; give --tilts",
    a_tilt_too_few: "--tilts has 1 angles for 2 images",
    tilts_that_are_words: "--tilts must be angles",
    no_pixel_size: "give --pixel-size-um",
    zero_pixel_size: "--pixel-size-um must be a positive number of micrometres, not 0",
    negative_pixel_size: "--pixel-size-um must be a positive number of micrometres, not -0.1",
    zero_pixel_size_in_toml: "series.toml: pixel_size_um must be a positive number",
    blank_image: "view_01.tif is blank",
    too_few_matches: "match",
    truncated_tiff: "view_01.tif is cut short",
    unknown_key: "series.toml: unknown key pixle_size_um; allowed are pixel_size_um",
    broken_toml: "series.toml is not valid TOML",
    unknown_method: "crystal-ball",
    folder_beside_images: "one series folder or image files",
    cropped_to_nothing: "cannot crop 120 rows",
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_one_sentence_and_nothing_written(case: Callable[[Path], Arguments], series: Path, tmp_path: Path) -> None:
    arguments = ["reconstruct", *case(series), "--out", tmp_path / "out"]
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 2
    assert CASES[case] in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert result.stdout == ""
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("holds", ["notes.txt", "report.json", "height.tif"])
def test_an_output_folder_that_holds_something_else_stays(holds: str, series: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / holds).write_text('{"mine": true}')
    result = CliRunner().invoke(app, ["reconstruct", str(series), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "holds something else" in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == [holds]
    assert (tmp_path / "out" / holds).read_text() == '{"mine": true}'


def test_an_output_path_that_is_a_file_stays(series: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    result = CliRunner().invoke(app, ["reconstruct", str(series), "--out", str(tmp_path / "out")])
    assert (result.exit_code, (tmp_path / "out").read_text()) == (2, "mine")
    assert "is a file" in result.stderr


@pytest.mark.parametrize("case", [truncated_tiff, too_few_matches], ids=lambda case: case.__name__)
def test_no_library_speaks_beside_the_sentence(case: Callable[[Path], Arguments], series: Path, tmp_path: Path) -> None:
    code = "from semrecon.cli import main; main()"
    arguments = ["reconstruct", *case(series), "--out", tmp_path / "out"]
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("semrecon: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", [missing_file, not_an_image, truncated_tiff], ids=lambda case: case.__name__)
def test_info_says_the_same(case: Callable[[Path], Arguments], series: Path) -> None:
    arguments = [str(argument) for argument in case(series)]
    paths = arguments[: arguments.index("--tilts")] if "--tilts" in arguments else arguments
    result = CliRunner().invoke(app, ["info", *paths])
    assert result.exit_code == 2
    assert CASES[case] in result.stderr
