"""Stage positions and detector directions mean in `semrecon` what they do in the simulated picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_surface import bump_series

from benchmarks.adapt import series_from_capture
from semrecon.data import ChannelGeometry, View
from semrecon.errors import InputError
from semrecon.input.intake import Stated, take_in
from semrecon.input.series import read_series, read_series_file, write_series
from semsim.backscatter import BackscatterOptions
from semsim.capture import Capture, simulate
from semsim.io import write_series as write_simulated
from semsim.microscope import Microscope, TiltSchedule
from semsim.scenes import scene

SHIFTS_UM = ((0.0, 0.0), (6.0, -3.0), (-2.0, 8.0))


def shifted() -> Capture:
    """A ball that the stage moves and does not tilt."""
    schedule = TiltSchedule((0.0, 0.0, 0.0), shifts_um=SHIFTS_UM)
    return simulate(replace(scene("sphere"), microscope=Microscope(1.0, 128, 96), schedule=schedule), 3)


def lit_from_all_sides(segments: int, azimuth_deg: float) -> Capture:
    """A ball under a ring in segments."""
    ball = scene("sphere")
    ring = BackscatterOptions(segments=segments, azimuth_deg=azimuth_deg, shadowing=0.0)
    schedule = TiltSchedule((0.0, 10.0), tilt_axis_deg=90.0)
    microscope = replace(ball.microscope, width_px=96, height_px=96, pixel_size_um=ball.microscope.pixel_size_um * 2)
    signal = replace(ball.signal, backscatter=ring)
    return simulate(replace(ball, microscope=microscope, schedule=schedule, signal=signal), 3)


def seen_shift_px(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whole pixels (right, down) by which the second picture has moved: the peak of their cross-correlation."""
    transforms = [np.fft.rfft2(image - image.mean()) for image in (first.astype(float), second.astype(float))]
    peak = np.fft.fftshift(np.fft.irfft2(transforms[1] * transforms[0].conj(), first.shape))
    row, column = np.unravel_index(peak.argmax(), peak.shape)
    return np.array([column - first.shape[1] // 2, row - first.shape[0] // 2])


def test_a_positive_stage_position_moves_the_picture_right_and_down(tmp_path: Path) -> None:
    series = read_series(write_simulated(shifted(), tmp_path / "s"))
    for view, shift_um in zip(series.views, SHIFTS_UM, strict=True):
        assert view.stage_um == shift_um
        seen = seen_shift_px(series.views[0].image, view.image)
        assert seen.tolist() == (np.array(shift_um) / series.optics.pixel_size_um).tolist()


def test_a_stage_that_only_tilts_states_no_position(tmp_path: Path) -> None:
    series = read_series(write_simulated(lit_from_all_sides(2, 0.0), tmp_path / "s"))
    assert [view.stage_um for view in series.views] == [None, None]


@pytest.mark.parametrize(("segments", "azimuth_deg"), [(2, 0.0), (3, 100.0), (4, 20.0), (4, -45.0)])
def test_a_ball_is_brightest_on_the_side_of_the_detector(tmp_path: Path, segments: int, azimuth_deg: float) -> None:
    """The centre of the light of a channel lies from the centre of the ball as its stated azimuth points."""
    series = read_series(write_simulated(lit_from_all_sides(segments, azimuth_deg), tmp_path / "s"))
    assert set(series.channel_geometry) == {f"bse_{letter}" for letter in "abcd"[:segments]}
    x, y = np.meshgrid(np.arange(96) - 47.5, 47.5 - np.arange(96))
    ball = np.hypot(x, y) < 0.8 * np.hypot(x, y)[series.views[0].image > series.views[0].image.mean()].max()
    ring = series.views[0].channels["bse"].astype(float)
    for name, geometry in series.channel_geometry.items():
        light = (series.views[0].channels[name] - ring / segments)[ball]
        towards = np.array([(light * x[ball]).sum(), (light * y[ball]).sum()])
        assert geometry.elevation_deg == 50.0  # between 20 and 60 degrees from the beam
        off_deg = np.rad2deg(np.arctan2(towards[1], towards[0])) - geometry.azimuth_deg
        assert abs((off_deg + 180) % 360 - 180) < 3.0


@pytest.mark.parametrize("make", [shifted, lambda: lit_from_all_sides(4, 30.0)], ids=["stage", "channels"])
def test_the_seam_says_what_the_files_say(make: Callable[[], Capture], tmp_path: Path) -> None:
    capture = make()
    by_files, by_seam = read_series(write_simulated(capture, tmp_path / "s")), series_from_capture(capture)
    assert by_files.channel_geometry == by_seam.channel_geometry
    assert [view.stage_um for view in by_files.views] == [view.stage_um for view in by_seam.views]


def test_stage_and_channels_come_back(tmp_path: Path) -> None:
    plain = bump_series((0.0, 6.0))
    views = tuple(
        replace(view, stage_um=(0.5 * i, -1.0), channels={"left": view.image, "up": view.image})
        for i, view in enumerate(plain.views)
    )
    geometry = {"left": ChannelGeometry(180.0, 35.0), "up": ChannelGeometry(90.0)}
    series = replace(plain, views=views, channel_geometry=geometry)
    write_series(series, tmp_path / "s")
    for back in (read_series(tmp_path / "s"), take_in([tmp_path / "s"]).series):
        assert back.channel_geometry == geometry
        assert [view.stage_um for view in back.views] == [(0.0, -1.0), (0.5, -1.0)]


def test_the_direction_of_a_channel_is_a_unit_vector_of_the_view_frame() -> None:
    np.testing.assert_allclose(ChannelGeometry(0.0, 0.0).direction, [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(ChannelGeometry(90.0, 0.0).direction, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(ChannelGeometry(17.0, 90.0).direction, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(ChannelGeometry(180.0, 60.0).direction, [-0.5, 0, np.sqrt(0.75)], atol=1e-15)
    assert np.isnan(ChannelGeometry(45.0).direction).all()


HEAD = "pixel_size_um = 0.1\n"
VIEW = "[[view]]\nimage = 'view_00.tif'\ntilt_deg = 0.0\n"
CHANNELS = VIEW + "channels = { left = 'view_00.tif' }\n"


@pytest.mark.parametrize(
    ("toml", "sentence"),
    [
        (HEAD + VIEW + "stage_um = [0.0]", "stage_um must be two numbers"),
        (HEAD + VIEW + "stage_um = [0.0, 1.0, 2.0]", "stage_um must be two numbers"),
        (HEAD + VIEW + "stage_um = 3.0", "stage_um must be two numbers"),
        (HEAD + VIEW + "stage_um = [0.0, 'far']", "stage_um must be a number"),
        (HEAD + VIEW + "stage_um = [0.0, nan]", "stage position that is no pair of numbers"),
        (HEAD + "[channel.left]\nazimuth_deg = 0.0\n" + VIEW, r"channel left is in no \[\[view\]\]; none is named"),
        (HEAD + "[channel.up]\nazimuth_deg = 0.0\n" + CHANNELS, "channel up is in no .*; those named are left"),
        (HEAD + "[channel.left]\nazimuth = 0.0\n" + CHANNELS, "unknown key azimuth in channel left"),
        (HEAD + "[channel.left]\nelevation_deg = 0.0\n" + CHANNELS, "missing: channel left azimuth_deg"),
        (HEAD + "[channel.left]\nazimuth_deg = 400.0\n" + CHANNELS, "channel left azimuth_deg must be an angle"),
        (HEAD + "[channel.left]\nazimuth_deg = nan\n" + CHANNELS, "channel left azimuth_deg must be an angle"),
        (
            HEAD + "[channel.left]\nazimuth_deg = 0\nelevation_deg = 120\n" + CHANNELS,
            "channel left elevation_deg must be",
        ),
    ],
)
def test_what_cannot_be_is_one_sentence(tmp_path: Path, toml: str, sentence: str) -> None:
    write_series(bump_series((0.0,)), tmp_path / "s")
    (tmp_path / "s" / "series.toml").write_text(toml)
    with pytest.raises(InputError, match=sentence):
        read_series(tmp_path / "s")


@pytest.mark.parametrize("stage_um", [(np.nan, 0.0), (0.0, np.inf)])
def test_a_stage_position_is_a_pair_of_numbers(stage_um: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="no pair of numbers"):
        View(np.zeros((2, 2), np.uint8), 0.0, stage_um=stage_um)


# --- the tilt axis ----------------------------------------------------------------------------------------------------


def without_axis(folder: Path) -> Path:
    write_series(bump_series((0.0, 6.0)), folder)
    lines = (folder / "series.toml").read_text().splitlines()
    (folder / "series.toml").write_text("\n".join(line for line in lines if "tilt_axis_deg" not in line))
    return folder


def test_an_axis_that_nobody_states_is_told_from_one_of_0_degrees(tmp_path: Path) -> None:
    silent = take_in([without_axis(tmp_path / "silent")])
    assert (silent.axis_stated, silent.series.tilt_axis_deg) == (False, 0.0)
    write_series(bump_series((0.0, 6.0)), tmp_path / "stated")
    assert take_in([tmp_path / "stated"]).axis_stated
    by_user = take_in([tmp_path / "silent"], Stated(tilt_axis_deg=90.0))
    assert (by_user.axis_stated, by_user.series.tilt_axis_deg) == (True, 90.0)
    assert read_series_file(tmp_path / "silent").tilt_axis_deg is None


def test_plain_images_state_no_axis(tmp_path: Path) -> None:
    images = sorted(without_axis(tmp_path / "s").glob("*.tif"))
    assert not take_in(images, Stated((0.0, 6.0), 0.1)).axis_stated
    assert take_in(images, Stated((0.0, 6.0), 0.1, 0.0)).axis_stated
