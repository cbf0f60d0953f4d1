"""The recipe as a whole: sign and size of what moves, statistics of repetitions, determinism, scenes and files."""

import hashlib
import subprocess
import sys
import tomllib
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import tifffile
import tomli_w
import trimesh

import semsim
from semsim.capture import Capture, Surfaces, expose, prepare, simulate
from semsim.detector import DetectorOptions, blur_by_spot, contrasts
from semsim.errors import InputError
from semsim.io import read_ply, read_truth, require_free, write_ply, write_series
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import NAMED, Scene, load_scene, scaled, scene, scene_from, tables


@dataclass(frozen=True)
class Hill:
    """A bright round hill of a given height at the origin of a dark plane at z = 0."""

    name: ClassVar[str] = "hill"
    height_um: float = 3.0

    def __call__(self, rng: np.random.Generator) -> Mesh:
        axis = np.linspace(-12, 12, 97)
        x, y = (v.ravel() for v in np.meshgrid(axis, axis))
        bell = np.exp(-(x**2 + y**2) / 2 / 1.5**2)
        i = np.arange(97 * 97).reshape(97, 97)
        a, b, c, d = (v.ravel() for v in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
        return Mesh(np.stack([x, y, self.height_um * bell], axis=1), faces, 0.2 + bell)


HILL = Scene("hill", Hill(), Microscope(0.2, 64, 48), TiltSchedule((0.0, 10.0, -10.0)))


@pytest.fixture(scope="module")
def hill() -> Surfaces:
    return prepare(HILL)


@pytest.fixture(scope="module")
def ball() -> Scene:
    small = scaled(scene("sphere"), 0.25)
    return replace(small, specimen=replace(small.specimen, subdivisions=4), schedule=TiltSchedule((0.0, 8.0)))


def centre_of(image: np.ndarray) -> np.ndarray:
    """Column and row of the brightest place, as the centroid of what is above the middle grey."""
    weight = np.clip(image - (image.min() + image.max()) / 2, 0, None)
    rows, columns = np.indices(image.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def test_a_raised_feature_moves_right_as_the_tilt_grows(hill):
    plain = replace(HILL, signal=replace(HILL.signal, yield_exponent=0.0, asymmetry=0.0, shadowing=0.0))
    left, middle, right = (
        centre_of(rate) for rate in prepare(replace(plain, schedule=TiltSchedule((-10.0, 0.0, 10.0)))).rates
    )
    assert np.allclose(middle, HILL.microscope.centre_px, atol=0.05)
    # Only the bright top counts, two thirds of the height or more: z sin(t) / pixel size.
    whole = 3.0 * np.sin(np.radians(10)) / 0.2
    assert 0.6 * whole < right[0] - middle[0] < whole
    assert -whole < left[0] - middle[0] < -0.6 * whole
    assert abs(right[1] - middle[1]) < 0.05


def test_a_stage_shift_moves_the_picture_by_whole_pixels():
    schedule = TiltSchedule((5.0, 5.0), 0.0, ((0.0, 0.0), (4 * 0.2, -3 * 0.2)))
    still, moved = prepare(replace(HILL, schedule=schedule, signal=replace(HILL.signal, shadowing=0.0))).rates
    assert np.allclose(moved[:-3, 4:], still[3:, :-4], atol=1e-6)
    assert np.abs(moved - still).max() > 0.1


def test_repetitions_have_the_mean_and_variance_of_counting(hill):
    """Grey = offset + gain N: over 200 exposures mean and variance follow, two-sided, within 5 standard errors."""
    options = DetectorOptions(dose_e=100.0, bits=16, gain_per_e=20.0, offset_grey=500.0)
    electrons = (np.stack([expose(hill, seed, options)[1] for seed in range(200)]) - 500.0) / 20.0
    expected = 100.0 * blur_by_spot(hill.rates[1], options.spot_sigma_px)
    n = electrons.size
    z_mean = ((electrons - expected) / np.sqrt(expected)).mean() * np.sqrt(n)
    assert abs(z_mean) < 5
    chi2 = ((electrons - expected) ** 2 / expected).mean() - 1
    assert abs(chi2) < 5 * np.sqrt((2 + 1 / expected.mean()) / n) * 1.2


def test_noise_is_uncorrelated_between_pixels_views_and_seeds(hill):
    options = DetectorOptions(bits=16, gain_per_e=20.0)
    a, b = expose(hill, 1, options), expose(hill, 2, options)
    expected = [200 * 20 * blur_by_spot(rate, options.spot_sigma_px) for rate in hill.rates]
    noise = [(image - mean) / np.sqrt(20 * mean) for image, mean in zip(a + b, expected * 2, strict=True)]
    pairs = [(noise[0], noise[1]), (noise[0], noise[3]), (noise[0][:, 1:], noise[0][:, :-1])]
    for left, right in pairs:
        assert abs((left * right).mean()) < 4.5 / np.sqrt(left.size)
    assert np.var(noise[0]) == pytest.approx(1, abs=0.15)


def test_same_seed_same_bits_and_another_seed_other_bits(hill):
    first, again, other = simulate(HILL, 7, hill), simulate(HILL, 7, hill), simulate(HILL, 8, hill)
    assert all(np.array_equal(a, b) for a, b in zip(first.images, again.images, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(first.images, other.images, strict=True))


def test_seeds_of_every_kind_agree(hill):
    images = [expose(hill, seed)[2] for seed in (5, np.random.SeedSequence(5), np.random.default_rng(5))]
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_a_view_keeps_its_noise_whatever_other_views_there_are(hill):
    fixed = DetectorOptions(gain_per_e=0.4)
    fewer = Surfaces(HILL, hill.truth, hill.rates[:2])
    assert np.array_equal(expose(hill, 3, fixed)[1], expose(fewer, 3, fixed)[1])


def test_same_bits_in_another_process(ball):
    code = (
        "import sys, hashlib, tomllib; from semsim.scene import scene_from; from semsim.capture import simulate;"
        "images = simulate(scene_from(tomllib.loads(sys.stdin.read())), 11).images;"
        "print(hashlib.sha256(b''.join(i.tobytes() for i in images)).hexdigest())"
    )
    here = hashlib.sha256(b"".join(i.tobytes() for i in simulate(ball, 11).images)).hexdigest()
    there = subprocess.run(
        [sys.executable, "-c", code], input=tomli_w.dumps(tables(ball)), capture_output=True, text=True, check=True
    )
    assert there.stdout.strip() == here


def test_the_specimen_has_a_seed_of_its_own(ball):
    one, other = prepare(ball), prepare(replace(ball, specimen_seed=1))
    assert not np.array_equal(one.truth.mesh.vertex_yield, other.truth.mesh.vertex_yield)
    assert np.array_equal(one.rates[0], prepare(ball).rates[0])


def test_contrast_is_shared_by_the_series_and_untouched_by_the_seed(hill):
    expected = [200 * blur_by_spot(rate, 0.7) for rate in hill.rates]
    assert len(set(contrasts(expected, HILL.detector))) == 1
    levels = [[np.median(image) for image in expose(hill, seed)] for seed in range(5)]
    assert np.ptp(levels, axis=0).max() <= 3


def test_both_backends_give_the_same_picture_within_a_grey_level():
    options = replace(HILL, signal=replace(HILL.signal, shadowing=0.0))
    cast, drawn = prepare(options), prepare(options, backend="pyrender")
    for a, b in zip(cast.rates, drawn.rates, strict=True):
        assert np.abs(a - b).max() < 1e-3


def test_progress_counts_every_step_to_the_end():
    told = []
    prepare(HILL, lambda step, done, total: told.append((done, total)))
    assert told == [(i, 7) for i in range(1, 8)]


@pytest.mark.parametrize("name", NAMED)
def test_named_scenes_survive_a_toml_file(name, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(tomli_w.dumps(tables(scene(name))))
    assert load_scene(path) == scene(name) == load_scene(name)


def test_table_1_of_the_seed():
    pollen, diatom = scene("pollen"), scene("diatom")
    assert pollen.microscope == Microscope(5 / 34, 854, 640)
    assert pollen.schedule == TiltSchedule((0.0, 3.0, 6.0, 9.0))
    assert diatom.microscope == Microscope(5 / 60, 2560, 1920)
    assert diatom.schedule == TiltSchedule((0.0, -15.0, -30.0))


def test_scaling_keeps_the_field():
    small = scaled(scene("pollen"), 0.25).microscope
    assert (small.width_px, small.height_px) == (214, 160)
    assert small.pixel_size_um * small.width_px == pytest.approx(854 * 5 / 34, rel=1e-12)
    with pytest.raises(InputError, match="at least 16"):
        scaled(scene("pollen"), 0.01)


MINIMAL = {
    "specimen": {"name": "plane"},
    "microscope": {"pixel_size_um": 0.2, "width_px": 40, "height_px": 30},
    "schedule": {"tilts_deg": [0, 5]},
}


@pytest.mark.parametrize(
    ("keys", "size_um"),
    [
        ({"pixel_size_um": 0.2}, 0.2),
        ({"bar_um": 5, "bar_px": 34}, 5 / 34),
        ({"bar_um": 5, "bar_mm": 25.4, "dpi": 34}, 5 / 34),
        ({"magnification": 337.34375, "dpi": 512}, 5 / 34),
        ({"magnification": 1000}, 127 / 40),
        ({"magnification": 1000, "print_width_um": 100_000}, 100 / 40),
    ],
)
def test_a_pixel_size_can_be_said_in_several_ways(keys, size_um):
    table = MINIMAL | {"microscope": {"width_px": 40, "height_px": 30, **keys}}
    assert scene_from(table).microscope.pixel_size_um == pytest.approx(size_um, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"colour": 3}, ["colour", "known are"]),
        ({"detector": {"dose": 3}}, ["[detector]", "dose", "dose_e"]),
        ({"detector": {"bits": 8.5}}, ["[detector]", "bits", "whole"]),
        ({"signal": {"asymmetry": 2}}, ["asymmetry", "between 0 and 1"]),
        ({"signal": 3}, ["[signal]"]),
        ({"schedule": {}}, ["[schedule]", "tilts_deg"]),
        ({"schedule": {"tilts_deg": ["a"]}}, ["[schedule]", "'a' is not a number"]),
        ({"specimen": None}, ["[specimen]"]),
        ({"specimen": {"name": "moon"}}, ["moon", "pollen"]),
        ({"microscope": {"width_px": 40, "height_px": 30}}, ["pixel size", "exactly one way", "none"]),
        ({"microscope": MINIMAL["microscope"] | {"bar_um": 5}}, ["exactly one way", "bar_um, pixel_size_um"]),
        ({"microscope": {"pixel_size_um": 0, "width_px": 40, "height_px": 30}}, ["pixel_size_um", "positive"]),
        ({"microscope": {"pixel_size_um": 0.2, "width_px": 40}}, ["[microscope]", "height_px"]),
        ({"specimen_seed": "x"}, ["specimen_seed", "number"]),
    ],
)
def test_a_wrong_file_is_answered_by_one_sentence_that_names_file_and_key(change, words, tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text(tomli_w.dumps({key: value for key, value in (MINIMAL | change).items() if value is not None}))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    for word in ["wrong.toml", *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_scene_is_answered_with_the_scenes(tmp_path):
    with pytest.raises(InputError, match="pollen"):
        load_scene("moon")
    path = tmp_path / "b.toml"
    path.write_bytes(b"a = = 3")
    with pytest.raises(InputError, match="not a TOML"):
        load_scene(path)


@pytest.fixture(scope="module")
def capture(ball) -> Capture:
    return simulate(ball, 1)


def test_a_series_folder_has_what_the_design_says_and_nothing_else(capture, tmp_path):
    out = write_series(capture, tmp_path / "deep" / "series", seed=1)
    found = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    truth = {"truth/mesh.ply", "truth/settings.toml", "truth/truth.npz"}
    assert found == {"series.toml", "view_00.tif", "view_01.tif"} | truth
    assert [path.name for path in out.parent.iterdir()] == ["series"]
    series = tomllib.loads((out / "series.toml").read_text())
    assert series["pixel_size_um"] == capture.scene.microscope.pixel_size_um
    assert [view["tilt_deg"] for view in series["view"]] == [0.0, 8.0]
    for view, image in zip(series["view"], capture.images, strict=True):
        assert np.array_equal(tifffile.imread(out / view["image"]), image)
    assert load_scene(out / "truth" / "settings.toml") == capture.scene


def test_the_truth_comes_back_to_the_last_bit(capture, tmp_path):
    truth = read_truth(write_series(capture, tmp_path / "series"))
    assert truth.microscope == capture.truth.microscope
    assert np.array_equal(truth.mesh.vertices_um, capture.truth.mesh.vertices_um)
    assert np.array_equal(truth.mesh.faces, capture.truth.mesh.faces)
    for a, b in zip(truth.buffers, capture.truth.buffers, strict=True):
        for name in ("depth_um", "position_um", "normal", "face"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
    assert np.array_equal(truth.correspondence(0, 1), capture.truth.correspondence(0, 1), equal_nan=True)
    with np.load(tmp_path / "series" / "truth" / "truth.npz") as stored:
        assert np.array_equal(stored["visibility"][0, 1], truth.visibility(0, 1))


def test_a_series_is_replaced_as_a_whole_and_anything_else_is_left_alone(capture, tmp_path):
    out = write_series(capture, tmp_path / "series")
    (out / "view_07.tif").write_bytes(b"from a longer series")
    write_series(capture, out)
    assert not (out / "view_07.tif").exists()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        write_series(capture, out)
    assert (out / "notes.txt").read_text() == "mine"
    real = tmp_path / "real"
    real.mkdir()
    (real / "series.toml").write_text("")
    with pytest.raises(InputError, match="not a series written by semsim"):
        require_free(real)
    with pytest.raises(InputError, match="is a file"):
        require_free(real / "series.toml")


def test_a_failure_while_writing_leaves_nothing_behind(capture, tmp_path, monkeypatch):
    out = write_series(capture, tmp_path / "series")
    before = (out / "view_00.tif").read_bytes()

    def fail(*_):
        raise RuntimeError("the disk is full")

    monkeypatch.setattr("semsim.io.write_ply", fail)
    with pytest.raises(RuntimeError):
        write_series(simulate(capture.scene, 2), out)
    assert [path.name for path in tmp_path.iterdir()] == ["series"]
    assert (out / "view_00.tif").read_bytes() == before


def test_a_mesh_survives_its_file_and_trimesh_reads_it(hill, tmp_path):
    write_ply(hill.truth.mesh, tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply")
    assert np.array_equal(back.vertices_um, hill.truth.mesh.vertices_um)
    assert np.array_equal(back.vertex_yield, hill.truth.mesh.vertex_yield)
    other = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.allclose(other.vertices, back.vertices_um, atol=1e-12)
    assert np.array_equal(other.faces, back.faces)
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match=r"a\.ply"):
        read_ply(tmp_path / "a.ply")


def test_a_folder_without_truth_is_refused(tmp_path):
    with pytest.raises(InputError, match="truth"):
        read_truth(tmp_path)


def test_importing_semsim_imports_nothing_slow():
    code = "import sys, semsim; print(sorted({'open3d', 'pyrender', 'trimesh', 'numba', 'cv2'} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_every_public_name_of_semsim_is_there():
    assert all(getattr(semsim, name) is not None for name in semsim.__all__)
    with pytest.raises(AttributeError):
        _ = semsim.nonsense
