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
from scipy.ndimage import map_coordinates

import semsim
from benchmarks.adapt import series_from_capture
from semrecon.input.series import read_series, read_series_file, series_from_file
from semsim.backscatter import BackscatterOptions
from semsim.capture import Capture, Surfaces, channel_contrasts, expose, prepare, simulate
from semsim.charging import ChargingOptions
from semsim.databar import DataBarOptions
from semsim.detector import DetectorOptions, contrasts
from semsim.errors import InputError
from semsim.imperfections import StageErrors, ViewErrors
from semsim.io import read_ply, read_truth, require_free, write_ply, write_series
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, pixel_grid, poses
from semsim.scan import ScanOptions
from semsim.scene import Scene, scaled, scene_from, tables
from semsim.scenes import NAMED, load_scene, scene
from semsim.spot import SpotOptions, blur_by_spot


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


SHAKY = replace(
    HILL,
    scan=ScanOptions(drift_px=(1.5, -1.0), wander_px=0.4, line_jitter_px=0.1, flyback_px=1.0),
    stage_errors=StageErrors(tilt_sigma_deg=0.1),
    view_errors=ViewErrors(magnification_sigma=0.002, rotation_sigma_deg=0.1, skew_sigma=0.001),
)


@pytest.fixture(scope="module")
def shaky() -> Surfaces:
    return prepare(SHAKY)


@pytest.fixture(scope="module")
def ball() -> Scene:
    small = scaled(scene("sphere"), 0.25)
    return replace(small, specimen=replace(small.specimen, subdivisions=4), schedule=TiltSchedule((0.0, 8.0)))


def blurred(rate: np.ndarray) -> np.ndarray:
    """As the default spot does, whose width does not depend on the depth."""
    return blur_by_spot(rate, np.zeros_like(rate), SpotOptions(), HILL.microscope)


def centre_of(image: np.ndarray) -> np.ndarray:
    """Column and row of the brightest place, as the centroid of what is above the middle grey."""
    weight = np.clip(image - (image.min() + image.max()) / 2, 0, None)
    rows, columns = np.indices(image.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def test_a_raised_feature_moves_right_as_the_tilt_grows(hill):
    plain = replace(HILL, signal=replace(HILL.signal, yield_exponent=0.0, asymmetry=0.0, shadowing=0.0))
    left, middle, right = (
        centre_of(rate["se"]) for rate in prepare(replace(plain, schedule=TiltSchedule((-10.0, 0.0, 10.0)))).rates
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
    still, moved = still["se"], moved["se"]
    assert np.allclose(moved[:-3, 4:], still[3:, :-4], atol=1e-6)
    assert np.abs(moved - still).max() > 0.1


def test_repetitions_have_the_mean_and_variance_of_counting(hill):
    """Grey = offset + gain N: over 200 exposures mean and variance follow, two-sided, within 5 standard errors."""
    options = DetectorOptions(dose_e=100.0, bits=16, gain_per_e=20.0, offset_grey=500.0)
    electrons = (np.stack([expose(hill, seed, options).images[1] for seed in range(200)]) - 500.0) / 20.0
    expected = 100.0 * blurred(hill.rates[1]["se"])
    n = electrons.size
    z_mean = ((electrons - expected) / np.sqrt(expected)).mean() * np.sqrt(n)
    assert abs(z_mean) < 5
    chi2 = ((electrons - expected) ** 2 / expected).mean() - 1
    assert abs(chi2) < 5 * np.sqrt((2 + 1 / expected.mean()) / n) * 1.2


def test_noise_is_uncorrelated_between_pixels_views_and_seeds(hill):
    options = DetectorOptions(bits=16, gain_per_e=20.0)
    a, b = expose(hill, 1, options).images, expose(hill, 2, options).images
    expected = [200 * 20 * blurred(rate["se"]) for rate in hill.rates]
    noise = [(image - mean) / np.sqrt(20 * mean) for image, mean in zip(a + b, expected * 2, strict=True)]
    pairs = [(noise[0], noise[1]), (noise[0], noise[3]), (noise[0][:, 1:], noise[0][:, :-1])]
    for left, right in pairs:
        assert abs((left * right).mean()) < 4.5 / np.sqrt(left.size)
    assert np.var(noise[0]) == pytest.approx(1, abs=0.15)


def test_noise_is_white_though_the_beam_drifts(shaky):
    """The picture is bent by the scan, the noise is not: its power is 1 at every frequency (5 standard errors)."""
    options = DetectorOptions(bits=16, gain_per_e=20.0)
    expected = [200 * blurred(view["se"]) for view in shaky.rates]
    power = np.zeros(expected[0].shape)
    for seed in range(40):
        for image, mean in zip(expose(shaky, seed, options).images, expected, strict=True):
            power += np.abs(np.fft.fft2((image / 20 - mean) / np.sqrt(mean))) ** 2 / mean.size / 120
    rows, columns = np.meshgrid(*(np.abs(np.fft.fftfreq(n)) for n in power.shape), indexing="ij")
    for band in (rows, columns, np.hypot(rows, columns)):
        for low in np.arange(0, 0.5, 0.1):
            inside = (band >= low) & (band < low + 0.1)
            assert power[inside].mean() == pytest.approx(1, abs=5 * np.sqrt(2 / (120 * inside.sum())))


def test_scan_errors_bend_the_picture_as_the_truth_says(hill):
    """The picture with errors is the perfect one read where the beam was."""
    bent = prepare(replace(HILL, scan=SHAKY.scan))
    for straight, rates, offset in zip(hill.rates, bent.rates, bent.truth.scan_offsets_px, strict=True):
        beam = pixel_grid(HILL.microscope) + offset
        read = map_coordinates(straight["se"], np.moveaxis(beam, -1, 0)[::-1], order=3)
        inner = (slice(4, -4), slice(4, -4))
        assert np.sqrt(np.mean((read - rates["se"])[inner] ** 2)) < 0.01
        assert np.sqrt(np.mean((straight["se"] - rates["se"])[inner] ** 2)) > 0.02


def test_repetitions_share_the_scan_and_instruments_do_not(shaky):
    again, other = prepare(SHAKY), prepare(replace(SHAKY, instrument_seed=1))
    scans = (surfaces.truth.scan_offsets_px for surfaces in (shaky, again, other))
    for a, b, c in zip(*scans, strict=True):
        assert np.array_equal(a, b)
        assert not np.array_equal(a, c)
    assert not np.array_equal(*shaky.truth.scan_offsets_px[:2])
    assert not np.array_equal(shaky.truth.poses[1].rotation, other.truth.poses[1].rotation)
    assert all(np.array_equal(a["se"], b["se"]) for a, b in zip(shaky.rates, again.rates, strict=True))


def test_without_errors_the_instrument_seed_changes_nothing(hill):
    other = prepare(replace(HILL, instrument_seed=5))
    assert other.truth.scan_offsets_px == ()
    assert all(np.array_equal(a["se"], b["se"]) for a, b in zip(hill.rates, other.rates, strict=True))


def test_the_truth_has_the_true_poses_and_the_scene_the_nominal_ones(shaky):
    assert shaky.scene.schedule == HILL.schedule
    for nominal, true in zip(poses(HILL.schedule), shaky.truth.poses, strict=True):
        assert not np.allclose(nominal.rotation, true.rotation, atol=1e-5)
        assert true.distorted


def test_the_seam_hands_over_nominal_values_only(shaky):
    capture = simulate(SHAKY, 0, shaky)
    series = series_from_capture(capture)
    assert series.tilts_deg.tolist() == list(HILL.schedule.tilts_deg)
    assert series.tilt_axis_deg == HILL.schedule.tilt_axis_deg
    assert series.optics.pixel_size_um == HILL.microscope.pixel_size_um
    straight = series_from_capture(replace(capture, scene=HILL, truth=None))
    for ours, plain in zip(series.views, straight.views, strict=True):
        assert np.array_equal(ours.image, plain.image)
        assert (ours.tilt_deg, ours.name, ours.mask, dict(ours.channels)) == (plain.tilt_deg, plain.name, None, {})


@pytest.fixture(scope="module")
def many() -> Surfaces:
    return prepare(replace(HILL, signal=replace(HILL.signal, backscatter=BackscatterOptions(segments=3))))


def test_other_detectors_stand_beside_the_image_and_leave_it_alone(hill, many):
    options = DetectorOptions(gain_per_e=0.4)
    plain, full = expose(hill, 4, options), expose(many, 4, options)
    assert all(np.array_equal(a, b) for a, b in zip(plain.images, full.images, strict=True))
    assert all(not channels for channels in plain.channels)
    for channels, image in zip(full.channels, full.images, strict=True):
        assert set(channels) == {"bse_a", "bse_b", "bse_c", "bse"}
        assert all(channel.shape == image.shape and channel.dtype == image.dtype for channel in channels.values())
    assert all(set(view.channels) == set(full.channels[0]) for view in series_from_capture(full).views)


def test_the_whole_ring_counts_the_electrons_of_its_segments(many):
    options = DetectorOptions(bits=16, gain_per_e=3.0)
    for channels in expose(many, 4, options).channels:
        parts = sum(channels[f"bse_{letter}"].astype(int) for letter in "abc")
        assert np.array_equal(channels["bse"], parts)


def test_noise_of_segments_is_independent(many):
    capture = expose(many, 4, DetectorOptions(bits=16, gain_per_e=20.0))
    pictures = {"se": capture.images[0], **capture.channels[0]}
    noise = {}
    for name, picture in pictures.items():
        mean = 200 * blurred(many.rates[0][name])
        noise[name] = (picture / 20 - mean) / np.sqrt(mean)
        assert np.var(noise[name]) == pytest.approx(1, abs=5 * np.sqrt(2 / mean.size) * 1.2)
    for a, b in (("bse_a", "bse_b"), ("bse_a", "se")):
        assert abs((noise[a] * noise[b]).mean()) < 4.5 / np.sqrt(noise[a].size)


@pytest.mark.parametrize("contrast", ["series", "view"])
def test_segments_share_a_contrast_so_that_they_can_be_compared(many, contrast):
    expected = [{name: 200 * rate for name, rate in view.items()} for view in many.rates]
    for view in channel_contrasts(expected, DetectorOptions(contrast=contrast)):
        assert view["bse_a"] == view["bse_b"] == view["bse_c"]
        assert len({view["bse_a"], view["bse"], view["se"]}) == 3


def test_charging_streaks_the_image_and_no_other_channel(many):
    still = expose(many, 4, DetectorOptions(gain_per_e=0.4))
    charging = replace(many.scene, charging=ChargingOptions(strength=3.0, threshold=0.5))
    streaked = expose(replace(many, scene=charging), 4, DetectorOptions(gain_per_e=0.4))
    assert streaked.images[0].mean() < 0.98 * still.images[0].mean()
    assert np.array_equal(streaked.channels[0]["bse_a"], still.channels[0]["bse_a"])


def test_a_capture_remembers_the_options_it_was_taken_with(hill):
    detector, spot = DetectorOptions(dose_e=9.0), SpotOptions(sigma_px=2.0)
    taken = expose(hill, 0, detector, spot)
    assert (taken.scene.detector, taken.scene.spot) == (detector, spot)
    assert np.array_equal(taken.images[1], simulate(replace(HILL, detector=detector, spot=spot), 0).images[1])


def test_same_seed_same_bits_and_another_seed_other_bits(hill):
    first, again, other = simulate(HILL, 7, hill), simulate(HILL, 7, hill), simulate(HILL, 8, hill)
    assert all(np.array_equal(a, b) for a, b in zip(first.images, again.images, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(first.images, other.images, strict=True))


def test_seeds_of_every_kind_agree(hill):
    images = [expose(hill, seed).images[2] for seed in (5, np.random.SeedSequence(5), np.random.default_rng(5))]
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_a_view_keeps_its_noise_whatever_other_views_there_are(hill):
    fixed = DetectorOptions(gain_per_e=0.4)
    fewer = Surfaces(HILL, hill.truth, hill.rates[:2])
    assert np.array_equal(expose(hill, 3, fixed).images[1], expose(fewer, 3, fixed).images[1])


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
    assert np.array_equal(one.rates[0]["se"], prepare(ball).rates[0]["se"])


def test_contrast_is_shared_by_the_series_and_untouched_by_the_seed(hill):
    expected = [200 * blurred(rate["se"]) for rate in hill.rates]
    assert len(set(contrasts(expected, HILL.detector))) == 1
    levels = [[np.median(image) for image in expose(hill, seed).images] for seed in range(5)]
    assert np.ptp(levels, axis=0).max() <= 3


def test_both_backends_give_the_same_picture_within_a_grey_level():
    options = replace(HILL, signal=replace(HILL.signal, shadowing=0.0))
    cast, drawn = prepare(options), prepare(options, backend="pyrender")
    for a, b in zip(cast.rates, drawn.rates, strict=True):
        assert np.abs(a["se"] - b["se"]).max() < 1e-3


def test_all_backends_bend_the_picture_alike():
    bent = replace(
        HILL, signal=replace(HILL.signal, shadowing=0.0), view_errors=ViewErrors((0.02,) * 3, (3.0,) * 3, (0.01,) * 3)
    )
    cast, drawn, rastered = (prepare(bent, backend=backend) for backend in ("raycast", "pyrender", "zbuffer"))
    for a, b, c in zip(cast.rates, drawn.rates, rastered.rates, strict=True):
        assert np.abs(a["se"] - b["se"]).max() < 2e-3
        assert np.abs(a["se"] - c["se"]).max() < 1e-6
    assert np.abs(cast.rates[0]["se"] - prepare(replace(bent, view_errors=ViewErrors())).rates[0]["se"]).max() > 0.03


def test_progress_counts_every_step_to_the_end():
    told = []
    prepare(HILL, lambda step, done, total: told.append((done, total)))
    assert told == [(i, 7) for i in range(1, 8)]


@pytest.mark.parametrize("name", NAMED)
def test_named_scenes_survive_a_toml_file(name, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(tomli_w.dumps(tables(scene(name))))
    assert load_scene(path) == scene(name) == load_scene(name)


@pytest.mark.parametrize("name", NAMED)
def test_the_reference_view_of_a_named_scene_has_the_origin_in_its_middle(name):
    schedule = scene(name).schedule
    assert not poses(schedule)[schedule.reference].translation_um.any()


def test_only_the_translation_scene_slides_and_it_is_in_perspective():
    assert [name for name in NAMED if scene(name).schedule.shifts_um] == ["translation"]
    sliding = scene("translation")
    assert set(sliding.schedule.tilts_deg) == {0.0}
    assert sliding.microscope.working_distance_um is not None


def test_table_1_of_the_seed():
    pollen, diatom = scene("pollen"), scene("diatom")
    assert pollen.microscope == Microscope(5 / 34, 854, 640)
    assert pollen.schedule == TiltSchedule((0.0, 3.0, 6.0, 9.0))
    assert diatom.microscope == Microscope(5 / 60, 2560, 1920)
    assert diatom.schedule == TiltSchedule((0.0, -15.0, -30.0))


def test_a_scene_with_everything_on_survives_a_toml_file(tmp_path):
    full = replace(
        scene("plane"),
        signal=replace(HILL.signal, backscatter=BackscatterOptions(segments=2)),
        scan=SHAKY.scan,
        stage_errors=StageErrors((0.1, 0.0, -0.2), 0.05, 1.0, (0.0, 1.0, -2.0), 0.1),
        view_errors=SHAKY.view_errors,
        spot=SpotOptions(astigmatism=0.2, convergence_mrad=3.0),
        charging=ChargingOptions(strength=1.0),
        data_bar=DataBarOptions(height_px=40),
        instrument_seed=9,
    )
    path = tmp_path / "a.toml"
    path.write_text(tomli_w.dumps(tables(full)))
    assert load_scene(path) == full


def test_scaling_keeps_spot_and_scan_errors_in_pixels_and_the_stage_in_um():
    half = scaled(replace(SHAKY, stage_errors=StageErrors(axis_point_um=(0.0, 0.0, -3.0))), 0.5)
    assert (half.spot, half.scan, half.stage_errors.axis_point_um) == (HILL.spot, SHAKY.scan, (0.0, 0.0, -3.0))


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
        ({"instrument_seed": -1}, ["instrument_seed", "negative"]),
        ({"scan": {"drift_um": [1, 1]}}, ["[scan]", "drift_um", "drift_px"]),
        ({"scan": {"drift_px": [1, 1, 1]}}, ["[scan]", "drift_px"]),
        ({"scan": {"drift_px": 3}}, ["[scan]", "drift_px"]),
        ({"stage_errors": {"axis_point_um": [1, 2]}}, ["[stage_errors]", "axis_point_um"]),
        ({"view_errors": {"skew": 1}}, ["[view_errors]", "skew", "skews"]),
        ({"spot": {"sigma_px": -1}}, ["spot", "sigma_px"]),
        ({"data_bar": {"height_px": 3}}, ["height_px", "24"]),
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


def test_a_series_with_everything_on_is_read_by_the_other_side_and_its_truth_comes_back(tmp_path):
    full = replace(
        SHAKY,
        specimen=scene("sphere").specimen,
        microscope=Microscope(1.0, 48, 40, working_distance_um=5000.0),
        signal=replace(HILL.signal, backscatter=BackscatterOptions(segments=2)),
        data_bar=DataBarOptions(height_px=24),
    )
    capture = simulate(full, 1)
    out = write_series(capture, tmp_path / "series", seed=1)
    series = series_from_file(out, read_series_file(out), crop_bottom_px=24)
    for view, image, channels in zip(series.views, capture.images, capture.channels, strict=True):
        assert np.array_equal(view.image, image)
        assert view.channels.keys() == channels.keys() == {"bse_a", "bse_b", "bse"}
        assert all(np.array_equal(view.channels[name], channels[name]) for name in channels)
    assert read_series(out).optics.height_px == 40 + 24
    assert "lowest 24 rows" in (out / "series.toml").read_text()
    truth = read_truth(out)
    for field in ("rotation", "translation_um", "distortion"):
        for a, b in zip(truth.poses, capture.truth.poses, strict=True):
            assert np.array_equal(getattr(a, field), getattr(b, field))
    assert np.array_equal(truth.scan_offsets_px, capture.truth.scan_offsets_px)
    for a, b in zip(truth.buffers, capture.truth.buffers, strict=True):
        for name in ("depth_um", "position_um", "normal", "face"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
    assert np.array_equal(truth.correspondence(0, 2), capture.truth.correspondence(0, 2), equal_nan=True)
    assert load_scene(out / "truth" / "settings.toml") == full
    write_series(capture, out)  # a series with channels is recognised as ours


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
