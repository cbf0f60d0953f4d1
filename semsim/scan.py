"""Where the beam really was: drift, wandering, vibration, line jitter and flyback.

All of them displace the beam before its ray is cast, never the finished picture, so that the noise of each pixel stays
its own and occlusion stays right. Errors along x and along y come from different random streams. Lengths are pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from semsim.errors import InputError
from semsim.mesh import Array
from semsim.microscope import Microscope, pixel_grid

FLYBACK_SHARE = 0.1
"""Part of the time of a line in which the beam returns; the rest is spent on its pixels."""


@dataclass(frozen=True)
class ScanOptions:
    """Errors of the scan; all are off by default.

    Parameters
    ----------
    drift_px
        Linear drift (x, y) from the first line to the last; the middle of the frame is undisturbed.
    wander_px
        Standard deviation of a wandering drift, along x and along y.
    wander_frames
        Time after which the wandering has forgotten where it was (falls to 1/e), in frames.
    vibration_px
        Amplitude (x, y) of a vibration; its phases are random.
    vibration_hz
        Its frequency.
    line_time_s
        Time from the start of a line to that of the next.
    line_jitter_px
        Standard deviation of where a whole line lies, along x and along y.
    flyback_px
        How far to the right of its place the beam is when a line starts.
    flyback_columns
        Columns after which that has fallen to 1/e.

    Raises
    ------
    InputError
        A value outside its range.
    """

    drift_px: tuple[float, float] = (0.0, 0.0)
    wander_px: float = 0.0
    wander_frames: float = 0.3
    vibration_px: tuple[float, float] = (0.0, 0.0)
    vibration_hz: float = 50.0
    line_time_s: float = 0.013
    line_jitter_px: float = 0.0
    flyback_px: float = 0.0
    flyback_columns: float = 20.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not np.isfinite(getattr(self, field.name)).all():
                raise InputError(f"scan option {field.name} must be finite, not {getattr(self, field.name)}")
        for name in ("wander_frames", "line_time_s", "flyback_columns"):
            if getattr(self, name) <= 0:
                raise InputError(f"scan option {name} must be positive, not {getattr(self, name)}")
        for name in ("wander_px", "vibration_hz", "line_jitter_px"):
            if getattr(self, name) < 0:
                raise InputError(f"scan option {name} must not be negative: {getattr(self, name)}")
        if abs(self.flyback_px) >= self.flyback_columns:
            raise InputError("scan option flyback_px must stay below flyback_columns, or the beam would turn back")

    @property
    def off(self) -> bool:
        """Whether the beam is where it should be."""
        return not any((*self.drift_px, self.wander_px, *self.vibration_px, self.line_jitter_px, self.flyback_px))


def beam_positions(microscope: Microscope, options: ScanOptions, rng: np.random.Generator) -> Array:
    """Say where the beam really was for each pixel: (rows, columns, 2) image positions (column, row), px."""
    return pixel_grid(microscope) + scan_offsets(microscope, options, rng)


def scan_offsets(microscope: Microscope, options: ScanOptions, rng: np.random.Generator) -> Array:
    """Displacement of the beam from each pixel, (rows, columns, 2), px; exactly 0 where all is off.

    Parameters
    ----------
    rng
        Each error draws from children of its own, along x and along y apart.
    """
    rows, columns = microscope.shape
    lines = (np.arange(columns) / columns * (1 - FLYBACK_SHARE) + np.arange(rows)[:, None]) / rows
    offsets = np.empty((rows, columns, 2))
    for axis, child in enumerate(rng.spawn(2)):
        wandering, shaking, jittering = child.spawn(3)
        offsets[..., axis] = drift(lines, options.drift_px[axis])
        offsets[..., axis] += wander(lines, options.wander_px, options.wander_frames, wandering)
        time_s = lines * rows * options.line_time_s
        offsets[..., axis] += vibration(time_s, options.vibration_px[axis], options.vibration_hz, shaking)
        offsets[..., axis] += line_jitter(rows, options.line_jitter_px, jittering)
    offsets[..., 0] += flyback(columns, options.flyback_px, options.flyback_columns)
    return offsets


def drift(frame_time: Array, drift_px: float) -> Array:
    """Linear drift at times (...) counted in frames, 0 in the middle of the frame."""
    return np.asarray(drift_px * (frame_time - 0.5))


def wander(frame_time: Array, sigma_px: float, memory_frames: float, rng: np.random.Generator) -> Array:
    """Wandering drift at the times (rows, columns) of a frame, counted in frames.

    A stationary Ornstein-Uhlenbeck process, drawn exactly at the start of every line (Gillespie 1996,
    doi:10.1103/PhysRevE.54.2084) and joined by straight lines: nothing wanders faster than the lines are scanned.
    """
    if sigma_px == 0:
        return np.zeros_like(frame_time)
    knots = len(frame_time) + 1
    kept = np.exp(-1 / (len(frame_time) * memory_frames))
    steps = rng.normal(size=knots)
    places = np.empty(knots)
    places[0] = steps[0]
    for i in range(1, knots):
        places[i] = kept * places[i - 1] + np.sqrt(1 - kept**2) * steps[i]
    return np.asarray(sigma_px * np.interp(frame_time * len(frame_time), np.arange(knots), places))


def vibration(time_s: Array, amplitude_px: float, frequency_hz: float, rng: np.random.Generator) -> Array:
    """Sinusoidal vibration of random phase at times (...), s."""
    return np.asarray(amplitude_px * np.sin(2 * np.pi * (frequency_hz * time_s + rng.uniform())))


def line_jitter(rows: int, sigma_px: float, rng: np.random.Generator) -> Array:
    """Independent displacement of each line, (rows, 1)."""
    return np.asarray(sigma_px * rng.normal(size=(rows, 1)))


def flyback(columns: int, flyback_px: float, decay_columns: float) -> Array:
    """Remainder of the return to the start of a line, (columns,): it dies away exponentially."""
    return np.asarray(flyback_px * np.exp(-np.arange(columns) / decay_columns))
