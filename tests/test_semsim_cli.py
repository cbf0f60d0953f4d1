"""The `semsim` command as a user meets it: in a process of its own, or in this one where nothing turns on that."""

import subprocess
import sys
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
import tomli_w
from PIL import Image

from semsim.cli import main
from semsim.scenes import NAMED, load_scene, scene
from semsim.specimens import SPECIMENS

SCENE = {
    "specimen": {"name": "wedge", "edge_um": 2.0},
    "microscope": {"pixel_size_um": 0.5, "width_px": 48, "height_px": 36},
    "schedule": {"tilts_deg": [0.0, 10.0]},
}


def in_a_process(*words: object, cwd=None) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", "from semsim.cli import main; main()", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


@pytest.fixture
def here(monkeypatch, capsys):
    """Run the command in this process."""

    def run(*words: object) -> SimpleNamespace:
        monkeypatch.setattr(sys, "argv", ["semsim", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        out, err = capsys.readouterr()
        return SimpleNamespace(returncode=end.value.code, stdout=out, stderr=err)

    return run


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "wedge.toml"
    path.write_text(tomli_w.dumps(SCENE))
    return path


def test_render_writes_a_series_and_says_so(scene_file, tmp_path):
    done = in_a_process("render", scene_file, "--out", tmp_path / "out", "--seed", 3)
    assert done.returncode == 0, done.stderr
    assert "2 views, 48 x 36 px" in done.stdout
    assert (tmp_path / "out" / "view_01.tif").is_file()
    assert "seed 3" in (tmp_path / "out" / "truth" / "settings.toml").read_text()


def test_the_settings_of_a_series_render_the_same_series_again(scene_file, tmp_path):
    in_a_process("render", scene_file, "--out", tmp_path / "a", "--scale", 0.5)
    again = in_a_process("render", tmp_path / "a" / "truth" / "settings.toml", "--out", tmp_path / "b")
    assert again.returncode == 0, again.stderr
    assert "24 x 18 px of 1 um" in again.stdout
    for name in ("view_00.tif", "view_01.tif", "truth/truth.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_scenes_and_specimens_are_listed(here):
    scenes, specimens = here("scenes").stdout.splitlines(), here("specimens").stdout
    assert [line.split()[0] for line in scenes[::2]] == list(NAMED)
    assert "2560 x 1920 px of 0.08333 um, tilts 0, -15, -30 degrees" in scenes[2 * list(NAMED).index("diatom") + 1]
    assert "7 views, shifted, all at tilt 0 degrees" in scenes[2 * list(NAMED).index("translation") + 1]
    for kind in SPECIMENS:
        assert f"\n{kind.name}: " in f"\n{specimens}"
    assert "rise_um=10.0" in specimens


def test_the_options_of_a_specimen_are_explained(here):
    answer = here("specimens", "step")
    assert tomllib.loads(answer.stdout)["specimen"]["rise_um"] == 10.0
    assert "# Height of the wall" in answer.stdout


def test_a_printed_scene_can_be_edited_and_rendered(here, tmp_path):
    printed = here("scene", "wedge", "--set", "specimen.edge_um=2", "--scale", 0.25).stdout
    (tmp_path / "mine.toml").write_text(printed.replace("dose_e = 200.0", "dose_e = 20.0"))
    assert here("render", tmp_path / "mine.toml", "--out", tmp_path / "out").returncode == 0
    rendered = load_scene(tmp_path / "out" / "truth" / "settings.toml")
    assert (rendered.detector.dose_e, rendered.specimen.edge_um, rendered.microscope.width_px) == (20.0, 2.0, 64)
    assert printed.startswith("# wedge: ")


def test_settings_are_changed_on_the_command_line(here, scene_file, tmp_path):
    words = ("--set", "detector.bits=16", "--set", "schedule.tilts_deg=[0, 4, 8]", "--set", "detector.contrast=view")
    assert here("render", scene_file, *words, "--out", tmp_path / "out").returncode == 0
    rendered = load_scene(tmp_path / "out" / "truth" / "settings.toml")
    assert (rendered.detector.bits, rendered.detector.contrast) == (16, "view")
    assert tifffile.imread(tmp_path / "out" / "view_02.tif").dtype == np.uint16


def test_show_draws_a_series_with_and_without_truth(here, scene_file, tmp_path):
    here("render", scene_file, "--out", tmp_path / "series")
    (tmp_path / "bare").mkdir()
    for name in ("series.toml", "view_00.tif", "view_01.tif"):
        (tmp_path / "bare" / name).write_bytes((tmp_path / "series" / name).read_bytes())
    assert here("show", tmp_path / "series").stdout == f"{tmp_path / 'series.png'}\n"
    assert here("show", tmp_path / "bare", "--out", tmp_path / "bare.jpg").returncode == 0
    with Image.open(tmp_path / "series.png") as full, Image.open(tmp_path / "bare.jpg") as bare:
        assert abs(full.width - bare.width) < 5
        assert full.height > 2 * bare.height
        assert np.asarray(full.convert("RGB")).std() > 20


def test_show_takes_real_images_of_any_kind(here, tmp_path):
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)).save(tmp_path / "a.jpg")
    tifffile.imwrite(tmp_path / "b.tif", rng.integers(0, 9999, (30, 40), dtype=np.uint16), photometric="minisblack")
    Image.fromarray(rng.integers(0, 255, (30, 40), dtype=np.uint8)).save(tmp_path / "c.png")
    views = [{"image": name, "tilt_deg": 3 * i} for i, name in enumerate(("a.jpg", "b.tif", "c.png"))]
    (tmp_path / "series.toml").write_text(tomli_w.dumps({"view": views}))
    assert here("show", tmp_path, "--out", tmp_path / "sheet.pdf").returncode == 0
    assert (tmp_path / "sheet.pdf").stat().st_size > 1000


def test_a_training_set_is_made_and_goes_on(here, scene_file, tmp_path):
    words = ("dataset", scene_file, "plane", "--set", "microscope.width_px=40", "--set", "specimen.edge_um=4")
    words += ("--scale", 0.5, "--out", tmp_path / "set", "--vary", "detector.dose_e=50:500:log")
    first, second = here(*words, "--seeds", 1, "--workers", 1), in_a_process(*words, "--seeds", 2, "--workers", 2)
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert second.stdout == f"{tmp_path / 'set' / 'index.csv'}: 4 series\n"
    rows = (tmp_path / "set" / "index.csv").read_text().splitlines()[1:]
    assert [row.split(",")[0] for row in rows] == ["wedge_0000", "wedge_0001", "plane_0000", "plane_0001"]


def test_the_gallery_is_one_command(here, tmp_path):
    answer = here("gallery", tmp_path / "docs", "--width", 64, "--scene", "plane", "--scene", "step")
    assert answer.stdout == f"{tmp_path / 'docs' / 'gallery.md'}\n"
    page = (tmp_path / "docs" / "gallery.md").read_text()
    for name in ("plane", "step"):
        assert f"(img/gallery/{name}.jpg)" in page
        with Image.open(tmp_path / "docs" / "img" / "gallery" / f"{name}.jpg") as picture:
            assert picture.size == (64, round(64 * scene(name).microscope.height_px / scene(name).microscope.width_px))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["scene", "moon"], "moon is neither a TOML file nor a scene"),
        (["scene", "wedge", "--set", "detector.dos=1"], "detector.dos=1: unknown key dos"),
        (["scene", "wedge", "--set", "detector"], "'detector' is not a setting"),
        (["specimens", "moon"], "there is no specimen 'moon'"),
        (["render", "wedge", "--set", "detector.bits=9", "--out", "out"], "detector.bits=9: "),
        (["render", "wedge", "--set", "wedge.x=9", "--out", "out"], "unknown key wedge"),
        (["show", "full"], "full is not a tilt series (it has no series.toml)"),
        (["show", "missing"], "missing is not a tilt series"),
        (["show", "broken"], "broken/series.toml is no tilt series"),
        (["show", "empty"], "empty/series.toml names no view"),
        (["show", "gone"], "gone/view_00.tif cannot be read as an image"),
        (["show", "gone", "--out", "sheet.docx"], "sheet.docx is no picture"),
        (["show", "gone", "--out", "missing/sheet.png"], "missing/sheet.png cannot be written"),
        (["dataset", "moon", "--seeds", "1", "--out", "out"], "moon is neither"),
        (["dataset", "wedge", "--seeds", "0", "--out", "out"], "1 seed or more, not 0"),
        (["dataset", "wedge", "wedge", "--seeds", "1", "--out", "out"], "two scenes are called wedge"),
        (["dataset", "wedge", "--seeds", "1", "--out", "full"], "full holds something else than a training set"),
        (["dataset", "wedge", "--seeds", "1", "--out", "full/notes.txt"], "notes.txt is a file"),
        (["dataset", "wedge", "--seeds", "1", "--out", "full/notes.txt/x"], "cannot be made"),
        (["dataset", "wedge", "--seeds", "1", "--out", "out", "--vary", "dose"], "'dose' is not a setting"),
        (["dataset", "wedge", "--seeds", "1", "--out", "out", "--vary", "detector.dose_e=9:1"], "from 9 to 1"),
        (["dataset", "wedge", "--seeds", "1", "--out", "out", "--vary", "detector.dose=1:2"], "unknown key dose"),
        (["dataset", "wedge", "--seeds", "1", "--out", "out", "--backend", "crayon"], "--backend must be one of"),
        (["gallery", "out", "--scene", "moon"], "no scene is called 'moon'"),
        (["gallery", "full/notes.txt", "--scene", "plane"], "cannot be made"),
    ],
)
def test_every_command_answers_bad_input_with_one_sentence(words, sentence, here, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder, name, text in (
        ("full", "notes.txt", "mine"),
        ("broken", "series.toml", "[[view]]\nimage = 'a.tif'"),
        ("empty", "series.toml", "view = []"),
        ("gone", "series.toml", "[[view]]\nimage = 'view_00.tif'\ntilt_deg = 0"),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_text(text)
    before = sorted(tmp_path.rglob("*"))
    answer = here(*words)
    assert answer.returncode == 2
    assert sentence in answer.stderr
    assert answer.stderr.startswith("semsim: ")
    assert len(answer.stderr.strip().splitlines()) == 1
    assert answer.stdout == ""
    assert sorted(tmp_path.rglob("*")) == before


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
        (["wedge", "--backend", "crayon"], "--backend must be one of "),
        (["wedge", "--scale", "0"], "scale"),
        (["wedge", "--scale", "0.001"], "at least 16"),
        (["bad.toml"], "bad.toml: unknown key dose"),
        (["not.toml"], "not.toml is not a TOML file"),
    ],
)
def test_bad_input_is_one_sentence_and_status_2_and_nothing_written(words, sentence, tmp_path):
    (tmp_path / "bad.toml").write_text(tomli_w.dumps(SCENE | {"dose": 3}))
    (tmp_path / "not.toml").write_text("][")
    answer = in_a_process("render", *words, "--out", "out", cwd=tmp_path)
    assert answer.returncode == 2
    assert sentence in answer.stderr
    assert len(answer.stderr.strip().splitlines()) == 1
    assert answer.stdout == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.toml", "not.toml"]


def test_a_folder_that_holds_something_else_is_refused(scene_file, tmp_path):
    answer = in_a_process("render", scene_file, "--out", tmp_path)
    assert answer.returncode == 2
    assert "wedge.toml" in answer.stderr
    assert len(answer.stderr.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["wedge.toml"]


def test_a_place_that_cannot_hold_a_folder_is_refused(scene_file):
    answer = in_a_process("render", scene_file, "--out", scene_file / "sub")
    assert answer.returncode == 2
    assert len(answer.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("words", [["render", "wedge"], ["render", "wedge", "--out", "x", "--seed", "one"], ["fly"]])
def test_wrong_usage_is_status_2(words, tmp_path):
    answer = in_a_process(*words, cwd=tmp_path)
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr
    assert not any(tmp_path.iterdir())


def test_help_of_the_package_names_what_it_offers_and_its_examples_hold():
    import doctest
    import pydoc

    import semsim
    from semsim import figures, overrides, template

    text = pydoc.plain(pydoc.render_doc(semsim))
    for name in semsim.__all__:
        assert name in text
        assert getattr(semsim, name).__doc__
    for module in (semsim, figures, overrides, template):
        tried = doctest.testmod(module)
        assert tried.attempted
        assert not tried.failed
