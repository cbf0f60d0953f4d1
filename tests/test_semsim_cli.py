"""The `semsim` command as a user meets it: in a process of its own."""

import subprocess
import sys

import pytest
import tomli_w

SCENE = {
    "specimen": {"name": "wedge", "edge_um": 2.0},
    "microscope": {"pixel_size_um": 0.5, "width_px": 48, "height_px": 36},
    "schedule": {"tilts_deg": [0.0, 10.0]},
}


def semsim(*words: object, cwd=None) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", "from semsim.cli import main; main()", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "wedge.toml"
    path.write_text(tomli_w.dumps(SCENE))
    return path


def test_render_writes_a_series_and_says_so(scene_file, tmp_path):
    done = semsim("render", scene_file, "--out", tmp_path / "out", "--seed", 3)
    assert done.returncode == 0, done.stderr
    assert "2 views, 48 x 36 px" in done.stdout
    assert (tmp_path / "out" / "view_01.tif").is_file()
    assert "seed 3" in (tmp_path / "out" / "truth" / "settings.toml").read_text()


def test_the_settings_of_a_series_render_the_same_series_again(scene_file, tmp_path):
    semsim("render", scene_file, "--out", tmp_path / "a", "--scale", 0.5)
    again = semsim("render", tmp_path / "a" / "truth" / "settings.toml", "--out", tmp_path / "b")
    assert again.returncode == 0, again.stderr
    assert "24 x 18 px of 1 um" in again.stdout
    for name in ("view_00.tif", "view_01.tif", "truth/truth.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_scenes_and_specimens_are_listed():
    scenes, specimens = semsim("scenes"), semsim("specimens")
    assert scenes.returncode == specimens.returncode == 0
    for name in ("pollen", "diatom", "plane", "step", "sphere", "wedge"):
        assert name in scenes.stdout
        assert name in specimens.stdout
    assert "2560 x 1920 px of 0.08333 um, tilts 0, -15, -30" in scenes.stdout


def test_help_imports_nothing_slow():
    code = (
        "import sys; sys.argv = ['semsim', '--help']; from semsim.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: print('status', end.code)\n"
        "print(sorted({'numpy', 'open3d', 'pyrender', 'trimesh', 'numba', 'cv2', 'scipy'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "render" in answer.stdout
    assert answer.stdout.splitlines()[-2:] == ["status 0", "[]"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["moon"], "moon is neither a TOML file nor a scene"),
        (["wedge", "--backend", "crayon"], "--backend must be one of raycast, pyrender"),
        (["wedge", "--scale", "0"], "scale"),
        (["wedge", "--scale", "0.001"], "at least 16"),
        (["bad.toml"], "bad.toml: unknown key dose"),
        (["not.toml"], "not.toml is not a TOML file"),
    ],
)
def test_bad_input_is_one_sentence_and_status_2_and_nothing_written(words, sentence, tmp_path):
    (tmp_path / "bad.toml").write_text(tomli_w.dumps(SCENE | {"dose": 3}))
    (tmp_path / "not.toml").write_text("][")
    answer = semsim("render", *words, "--out", "out", cwd=tmp_path)
    assert answer.returncode == 2
    assert sentence in answer.stderr
    assert len(answer.stderr.strip().splitlines()) == 1
    assert answer.stdout == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.toml", "not.toml"]


def test_a_folder_that_holds_something_else_is_refused(scene_file, tmp_path):
    answer = semsim("render", scene_file, "--out", tmp_path)
    assert answer.returncode == 2
    assert "wedge.toml" in answer.stderr
    assert len(answer.stderr.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["wedge.toml"]


def test_a_place_that_cannot_hold_a_folder_is_refused(scene_file):
    answer = semsim("render", scene_file, "--out", scene_file / "sub")
    assert answer.returncode == 2
    assert len(answer.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("words", [["render", "wedge"], ["render", "wedge", "--out", "x", "--seed", "one"], ["fly"]])
def test_wrong_usage_is_status_2(words, tmp_path):
    answer = semsim(*words, cwd=tmp_path)
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr
    assert not any(tmp_path.iterdir())
