"""Where the beam really was: each error against its formula, its statistics, and the way back from beam to pixel."""

from dataclasses import replace

import numpy as np
import pytest

from semsim.errors import InputError
from semsim.microscope import Microscope, pixel_grid
from semsim.recorded import offset_at, recorded_at
from semsim.scan import ScanOptions, beam_positions, scan_offsets

SCOPE = Microscope(0.2, 80, 120)
LONG = Microscope(0.2, 4, 4000)
ROUGH = ScanOptions(
    drift_px=(1.5, -0.8),
    wander_px=0.5,
    vibration_px=(0.3, 0.2),
    vibration_hz=3.0,
    line_jitter_px=0.1,
    flyback_px=2.0,
)


def offsets(seed: int = 0, scope: Microscope = SCOPE, **options: object) -> np.ndarray:
    return scan_offsets(scope, ScanOptions(**options), np.random.default_rng(seed))


def test_a_perfect_scan_is_exactly_the_pixel_grid():
    assert ScanOptions().off
    assert np.array_equal(beam_positions(SCOPE, ScanOptions(), np.random.default_rng(0)), pixel_grid(SCOPE))


@pytest.mark.parametrize(
    "options",
    [
        {"drift_px": (0.0, 1.0)},
        {"wander_px": 0.1},
        {"vibration_px": (0.1, 0.0)},
        {"line_jitter_px": 0.1},
        {"flyback_px": -1.0},
    ],
)
def test_each_error_alone_moves_the_beam(options):
    assert not ScanOptions(**options).off
    assert np.abs(offsets(**options)).max() > 0.05


def test_same_seed_same_scan_and_another_seed_another():
    assert np.array_equal(*(scan_offsets(SCOPE, ROUGH, np.random.default_rng(4)) for _ in range(2)))
    assert not np.array_equal(*(scan_offsets(SCOPE, ROUGH, np.random.default_rng(seed)) for seed in (4, 5)))


def test_an_error_more_leaves_the_others_as_they_were():
    alone, both = offsets(3, wander_px=0.4), offsets(3, wander_px=0.4, line_jitter_px=0.2)
    assert np.allclose(both - alone, offsets(3, line_jitter_px=0.2), atol=1e-12)


def test_linear_drift_is_linear_in_time_and_centred_on_the_frame():
    moved = offsets(drift_px=(2.0, -1.0))
    assert np.allclose(np.diff(moved, axis=0), np.array([2.0, -1.0]) / 120)
    # A line takes 9/10 of its time for its pixels and the rest to return.
    assert np.allclose(np.diff(moved, axis=1), np.array([2.0, -1.0]) / 120 / 80 * 0.9)
    assert np.abs(moved.mean(axis=(0, 1))).max() < 2.0 / 120


def test_vibration_has_its_amplitude_and_frequency():
    moved = offsets(scope=LONG, vibration_px=(0.7, 0.0), vibration_hz=10.0, line_time_s=0.01)
    assert not moved[..., 1].any()
    assert moved[:, 0, 0].std() == pytest.approx(0.7 / np.sqrt(2), rel=1e-9)  # over 400 whole periods
    spectrum = np.abs(np.fft.rfft(moved[:, 0, 0]))
    assert np.argmax(spectrum) == 10.0 * 0.01 * 4000


def test_line_jitter_is_white_from_line_to_line_and_constant_along_it():
    moved = offsets(scope=LONG, line_jitter_px=0.3)
    assert np.ptp(moved, axis=1).max() == 0
    lines = moved[:, 0]
    # 4000 lines: the standard error of a standard deviation is sigma / sqrt(2 n), of a correlation 1 / sqrt(n).
    assert lines.std(axis=0) == pytest.approx(0.3, abs=5 * 0.3 / np.sqrt(8000))
    for axis in (0, 1):
        assert abs(np.corrcoef(lines[1:, axis], lines[:-1, axis])[0, 1]) < 4.5 / np.sqrt(4000)


def test_wandering_has_its_variance_and_its_memory():
    """Over 300 frames; of each, lines a tenth of a frame apart, whose correlation is exp(-0.1 / memory)."""
    scope = Microscope(0.2, 2, 40)
    frames = np.stack([offsets(seed, scope, wander_px=0.8, wander_frames=0.2)[:, 0] for seed in range(300)])
    ends = frames[:, [0, -1]]  # far enough apart to be nearly independent
    assert ends.var() == pytest.approx(0.64, rel=5 * np.sqrt(2 / 1200) * 1.1)
    alike = (frames[:, 4:] * frames[:, :-4]).mean() / (frames**2).mean()
    assert alike == pytest.approx(np.exp(-0.1 / 0.2), abs=0.06)


def test_wandering_is_no_faster_than_the_lines():
    moved = offsets(wander_px=0.8, wander_frames=0.05)
    assert np.abs(np.diff(moved, n=2, axis=1)).max() < 1e-12  # straight within a line
    across = moved[1:, 0] - moved[:-1, -1]
    assert np.abs(across).max() < 0.2 * np.abs(np.diff(moved[:, 0], axis=0)).max()  # a tenth of the time remains


def test_flyback_dies_away_along_every_line_alike():
    moved = offsets(flyback_px=3.0, flyback_columns=10.0)
    assert not moved[..., 1].any()
    assert np.allclose(moved[..., 0], 3.0 * np.exp(-np.arange(80) / 10.0))


@pytest.mark.parametrize("options", [{"line_jitter_px": 1.0}, {"wander_px": 1.0, "wander_frames": 0.003}])
def test_errors_along_x_and_along_y_are_uncorrelated(options):
    lines = offsets(scope=LONG, **options)[:, 0]
    memory = 2 * 0.003 * 4000 if "wander_px" in options else 1.0  # lines of which one is worth as much as all
    assert abs(np.corrcoef(lines.T)[0, 1]) < 4.5 * np.sqrt(memory / 4000)


def test_phases_of_vibration_along_x_and_y_are_independent():
    moved = [offsets(seed, Microscope(0.2, 2, 2), vibration_px=(1.0, 1.0))[0, 0] for seed in range(500)]
    assert abs(np.corrcoef(np.transpose(moved))[0, 1]) < 4.5 / np.sqrt(500)


@pytest.mark.parametrize("seed", range(4))
def test_the_pixel_that_records_a_place_is_found_again(seed):
    moved = scan_offsets(SCOPE, ROUGH, np.random.default_rng(seed))
    pixels = np.random.default_rng(seed).uniform([2, 2], [77, 117], (2000, 2))
    back = recorded_at(moved, pixels + offset_at(moved, pixels))
    assert np.abs(back - pixels).max() < 1e-8
    beam = pixel_grid(SCOPE) + moved
    assert np.abs(recorded_at(moved, beam) - pixel_grid(SCOPE)).max() < 1e-8


def test_the_way_back_holds_where_lines_part_by_more_than_a_pixel():
    moved = np.zeros((40, 30, 2))
    moved[20:, :, 1] = 1.8
    pixels = np.array([[5.0, 19.4], [5.0, 19.9], [7.3, 20.2], [0.0, 0.0]])
    assert np.abs(recorded_at(moved, pixels + offset_at(moved, pixels)) - pixels).max() < 1e-7


def test_where_lines_cross_the_first_time_counts():
    moved = np.zeros((40, 30, 2))
    moved[20:, :, 1] = -3.0  # the beam steps back: rows 17 to 19 are scanned twice
    assert np.allclose(recorded_at(moved, np.array([[5.0, 18.0]])), [[5.0, 18.0]])
    assert np.allclose(recorded_at(moved, np.array([[5.0, 19.5]])), [[5.0, 22.5]])


def test_a_place_that_is_nowhere_is_recorded_nowhere():
    moved = offsets(drift_px=(1.0, 1.0))
    assert np.isnan(recorded_at(moved, np.array([[np.nan, 3.0], [2.0, np.nan]]))).all()
    assert recorded_at(moved, np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"drift_px": (float("nan"), 0.0)}, "drift_px"),
        ({"wander_px": -1.0}, "wander_px"),
        ({"wander_frames": 0.0}, "wander_frames"),
        ({"line_time_s": 0.0}, "line_time_s"),
        ({"line_jitter_px": -0.1}, "line_jitter_px"),
        ({"vibration_hz": -1.0}, "vibration_hz"),
        ({"flyback_px": 20.0}, "flyback_px"),
        ({"flyback_columns": -1.0}, "flyback_columns"),
    ],
)
def test_impossible_values_are_named(options, word):
    with pytest.raises(InputError, match=word):
        replace(ScanOptions(), **options)
