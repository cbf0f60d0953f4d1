"""docs/adding-a-method.md, done step by step: its blocks become an installed package, which is then used as it says."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from known_surface import bump_series, bump_um
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.errors import InputError
from semrecon.methods import METHODS, all_methods, method_named
from semrecon.methods.outside import outside_methods

PAGE = Path(__file__).resolve().parent.parent / "docs" / "adding-a-method.md"
BLOCKS = re.findall(r"^```(?:python|toml)\n# (file: \S+|run)\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
FILES = {head.removeprefix("file: "): body for head, body in BLOCKS if head.startswith("file: ")}
RUNS = [body for head, body in BLOCKS if head == "run"]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Do what pip would: the module on the path, and beside it the metadata with its entry points."""
    project = tomllib.loads(FILES["pyproject.toml"])["project"]
    (tmp_path / "tile_shift.py").write_text(FILES["tile_shift.py"])
    info = tmp_path / f"tile_shift-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"]
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(str(tmp_path))
    outside_methods.cache_clear()
    yield info
    sys.modules.pop("tile_shift", None)
    outside_methods.cache_clear()


def test_the_page_has_its_blocks() -> None:
    assert set(FILES) == {"tile_shift.py", "pyproject.toml"}
    assert len(RUNS) == 2


@pytest.mark.usefixtures("installed")
def test_the_method_is_found_by_its_name_and_by_the_command_line() -> None:
    assert [method.name for method in all_methods()] == [*(method.name for method in METHODS), "tile_shift"]
    result = CliRunner().invoke(app, ["methods"])
    assert result.exit_code == 0
    assert "tile_shift\n  views: 2 or more\n  needs: rotations, pixel_size, tilt_axis" in result.output
    with pytest.raises(InputError, match="no option 'tile'; its options are tile_px"):
        method_named("tile_shift", tile=3)
    with pytest.raises(InputError, match="tile_px must be at least 8"):
        method_named("tile_shift", tile_px=2)


@pytest.mark.usefixtures("installed")
def test_the_method_measures_what_it_says() -> None:
    estimate = method_named("tile-shift", tile_px=24)(bump_series(), rng=np.random.default_rng(0))
    assert estimate.points is not None
    x, y, z = estimate.points.xyz_um.T
    error = z - bump_um(x, y)
    assert np.median(np.abs(error - np.median(error))) < 0.2
    assert np.polyfit(bump_um(x, y), z, 1)[0] == pytest.approx(1, abs=0.25)


@pytest.mark.usefixtures("installed")
def test_the_page_runs_as_it_stands(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {}
    for body in RUNS:
        exec(compile(body, str(PAGE), "exec"), names)
    assert capsys.readouterr().out == "(2, None) ('offset',)\n"


def test_without_the_package_there_is_no_such_method() -> None:
    with pytest.raises(InputError, match="no method 'tile_shift'"):
        method_named("tile_shift")


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("tile_shift:Missing", "cannot be loaded"),
        ("tile_shift:np", "is no method"),
        ("nowhere:Any", "cannot be loaded"),
    ],
)
def test_an_entry_point_that_leads_nowhere_is_named(installed: Path, value: str, said: str) -> None:
    (installed / "entry_points.txt").write_text(f"[semrecon.methods]\ntile_shift = {value}\n")
    with pytest.raises(InputError, match=f"entry point tile_shift = {value}.* {said}"):
        all_methods()


def test_two_names_for_one_method_are_refused(installed: Path) -> None:
    (installed / "entry_points.txt").write_text("[semrecon.methods]\nother = tile_shift:TileShift\n")
    with pytest.raises(InputError, match="calls itself tile_shift"):
        all_methods()
