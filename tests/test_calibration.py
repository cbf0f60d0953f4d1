"""Claims on scale: the seed's numbers come out, and perspective is warned of."""

from __future__ import annotations

import numpy as np
import pytest

from semrecon.data import Optics
from semrecon.errors import InputError
from semrecon.geometry import project, tilt_rotation
from semrecon.input.calibration import (
    magnification_at_dpi,
    perspective_bowl_um,
    perspective_shift_px,
    perspective_warning,
    pixel_size_from_bar,
)

POLLEN_UM, DIATOM_UM = 5 / 34, 5 / 60


def test_data_bars_of_table_1() -> None:
    assert 1 / pixel_size_from_bar(5, 34) == pytest.approx(6.8)
    assert 1 / pixel_size_from_bar(5, 60) == pytest.approx(12.0)


def test_a_of_table_1_is_a_print_magnification() -> None:
    assert magnification_at_dpi(POLLEN_UM, 512) == pytest.approx(337.3438, abs=5e-5)
    assert magnification_at_dpi(DIATOM_UM, 512) == pytest.approx(595.3125, abs=5e-5)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_what_is_not_a_length_is_refused(bad: float) -> None:
    with pytest.raises(InputError, match="positive"):
        pixel_size_from_bar(5, bad)


def test_perspective_shifts_of_the_seeds_images() -> None:
    assert perspective_shift_px(854, 30, 10_000) == pytest.approx(1.28, abs=0.01)
    assert perspective_shift_px(2560, 30, 10_000) == pytest.approx(3.84, abs=0.01)


@pytest.mark.parametrize("relief_um", [1.0, -30.0, 30.0])
def test_the_shift_is_that_of_the_projection_itself(relief_um: float) -> None:
    wd_um, width = 10_000.0, 854
    parallel, perspective = Optics(POLLEN_UM, width, 640), Optics(POLLEN_UM, width, 640, 1 / wd_um)
    corner = np.array([width / 2 * POLLEN_UM, 0.0, relief_um])
    rotation = np.diag([1.0, -1.0, -1.0]) @ tilt_rotation(0.0)
    shift = project(corner, rotation, np.zeros(3), perspective) - project(corner, rotation, np.zeros(3), parallel)
    assert abs(shift[0]) == pytest.approx(perspective_shift_px(width, relief_um, wd_um), rel=2 * 30 / wd_um)


def test_the_warning_depends_on_relief_distance_and_noise() -> None:
    optics = Optics(POLLEN_UM, 854, 640)
    assert perspective_warning(optics, 30, 10_000, noise_px=1.3) is None
    assert "perspective" in str(perspective_warning(optics, 30, 10_000, noise_px=1.2))
    assert perspective_warning(optics, 3, 10_000, noise_px=0.2) is None


@pytest.mark.parametrize("tilt_deg", [-9.0, 3.0, 9.0])
def test_a_plane_in_perspective_is_a_bowl_to_parallel_stereo(tilt_deg: float) -> None:
    wd_um, x_um, tilt = 10_000.0, 60.0, np.deg2rad(tilt_deg)
    optics = Optics(POLLEN_UM, 854, 640, 1 / wd_um)
    views = [np.diag([1.0, -1.0, -1.0]) @ tilt_rotation(angle) for angle in (0.0, tilt_deg)]
    plane = np.array([[-x_um, 0, 0], [0.0, 0, 0], [x_um, 0, 0]])
    u1, u2 = ((project(plane, view, np.zeros(3), optics) - optics.centre_px)[:, 0] * POLLEN_UM for view in views)
    z_um = (u2 - np.cos(tilt) * u1) / np.sin(tilt)
    sag = z_um[1] - (z_um[0] + z_um[2]) / 2
    assert sag == pytest.approx(perspective_bowl_um(x_um, wd_um), rel=0.02)
