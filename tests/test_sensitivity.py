"""The predicted response: published figures, least squares done numerically, and true matches through the geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.judging.sensitivity import (
    depth_weights,
    noise_gain,
    predicted,
    systematic_error_um,
)
from semrecon.data import Optics, Poses, Tracks
from semrecon.geometry import tilt_rotation
from semrecon.points.triangulation import triangulate
from semsim.capture import Surfaces, prepare
from semsim.imperfections import StageErrors, ViewErrors
from semsim.microscope import TiltSchedule
from semsim.overrides import overridden
from semsim.scan import ScanOptions
from semsim.scene import Scene, scaled
from semsim.scenes import scene

TILTS = (0.0, 6.0, 12.0)
EDGE_UM = 62.8
"""Half the width of 854 pixels of 5/34 um."""


@pytest.mark.parametrize(
    ("tilts_deg", "published"),
    [
        ((0, 3), 27.0),
        ((0, 5), 16.2),
        ((0, 10), 8.1),
        ((0, 15), 5.4),
        ((0, 3, 6, 9), 8.5),
        ((-10, 0, 10), 4.1),
        ((0, 15, 30), 2.6),
        (tuple(np.linspace(-30, 30, 37)), 0.545),
    ],
)
def test_noise_of_the_depth_per_pixel_of_noise(tilts_deg: tuple[float, ...], published: float) -> None:
    assert noise_gain(tilts_deg) == pytest.approx(published, abs=0.051 if published > 1 else 0.0005)


@given(
    tilts=st.lists(st.floats(-60, 60), min_size=2, max_size=6).filter(lambda each: max(each) - min(each) > 0.5),
    x=st.floats(-50, 50),
    z=st.floats(-20, 20),
)
def test_weights_find_the_depth_of_any_point(tilts: list[float], x: float, z: float) -> None:
    angles = np.deg2rad(tilts)
    weights = depth_weights(tilts)
    assert weights @ (x * np.cos(angles) + z * np.sin(angles)) == pytest.approx(z, abs=1e-7)


def test_weights_have_the_least_noise_of_all_that_find_the_depth() -> None:
    angles = np.deg2rad([0.0, 3.0, 9.0])
    other = np.array([-1 / np.tan(angles[2]), 0.0, 1 / np.sin(angles[2])])  # the outer pair alone
    assert other @ np.cos(angles) == pytest.approx(0, abs=1e-12)
    assert noise_gain((0, 3, 9)) < np.linalg.norm(other)


def test_views_at_one_tilt_have_no_parallax() -> None:
    with pytest.raises(ValueError, match="no parallax"):
        depth_weights((5.0, 5.0))


def positions(tilts_deg: Sequence[float], x_um: np.ndarray, z_um: np.ndarray) -> np.ndarray:
    """Place of points across the axis in each view, um, (..., views)."""
    tilts = np.deg2rad(np.asarray(tilts_deg, dtype=np.float64))
    return np.asarray(np.multiply.outer(x_um, np.cos(tilts)) + np.multiply.outer(z_um, np.sin(tilts)))


def tilt_error_um(
    tilts_deg: Sequence[float], errors_deg: Sequence[float], x_um: np.ndarray, z_um: np.ndarray
) -> np.ndarray:
    """Depth error from true minus stated tilts: ``sum_v k_v (z cos t_v - x sin t_v) d t_v``, to first order.

    For two views, the first without error, the depth is scaled by ``1 + cot(t) d t`` and its plane tipped by ``d t``.
    """
    tilts, errors = np.deg2rad(tilts_deg), np.deg2rad(errors_deg)
    weights = depth_weights(tilts_deg) * errors
    return np.asarray(z_um * (weights @ np.cos(tilts)) - x_um * (weights @ np.sin(tilts)))


def magnification_error_um(
    tilts_deg: Sequence[float], errors: Sequence[float], x_um: np.ndarray, z_um: np.ndarray
) -> np.ndarray:
    """Depth error from true over stated magnification, minus 1, of each view: ``sum_v k_v m_v u_v``."""
    return np.asarray(positions(tilts_deg, x_um, z_um) @ (depth_weights(tilts_deg) * np.asarray(errors)))


def rotation_error_um(tilts_deg: Sequence[float], errors_deg: Sequence[float], y_um: np.ndarray) -> np.ndarray:
    """Depth error from pictures turned counter-clockwise: ``-sum_v k_v sin(r_v) y``, y along the axis."""
    return np.asarray(-y_um * (depth_weights(tilts_deg) @ np.sin(np.deg2rad(errors_deg))))


def drift_error_um(
    tilts_deg: Sequence[float], drifts_px: Sequence[float], pixel_size_um: float, share: np.ndarray
) -> np.ndarray:
    """Depth error from a drift of the beam across the tilt axis during each frame.

    Parameters
    ----------
    drifts_px
        From the first line to the last of each view. What all views have alike cancels only in part: sum k is not 0.
    share
        Place of the line in the frame, -0.5 for the first to 0.5 for the last. The picture goes against the beam.
    """
    return np.asarray(-share * (depth_weights(tilts_deg) @ np.asarray(drifts_px)) * pixel_size_um)


def test_published_errors_of_stage_and_column() -> None:
    """0.1 degree scales the depth by 3.3 % at 3 degrees and 0.65 % at 15, and tips the plane by 0.1 degree."""
    zero, one, edge = np.zeros(1), np.ones(1), np.full(1, EDGE_UM)
    assert tilt_error_um((0, 3), (0, 0.1), zero, one) == pytest.approx(0.0333, abs=5e-5)
    assert tilt_error_um((0, 15), (0, 0.1), zero, one) == pytest.approx(0.00651, abs=5e-6)
    assert tilt_error_um((0, 3), (0, 0.1), one, zero) == pytest.approx(-np.deg2rad(0.1), rel=1e-9)
    assert magnification_error_um((0, 3), (0, 1e-3), edge, zero) == pytest.approx(1.2, abs=0.01)
    assert abs(rotation_error_um((0, 3), (0, 1), edge)) == pytest.approx(20.9, abs=0.06)


def height_error_um(surfaces: Surfaces) -> np.ndarray:
    """What perfect matches give at nominal poses, by the reconstruction's own triangulation, less the median."""
    truth, schedule = surfaces.truth, surfaces.scene.schedule
    xy = np.stack([truth.correspondence(0, view) for view in range(len(truth))], axis=2)
    rotations = np.stack([tilt_rotation(tilt, schedule.tilt_axis_deg) for tilt in schedule.tilts_deg])
    poses = Poses(np.diag([1.0, -1.0, -1.0]) @ rotations, np.zeros((len(truth), 3)))
    optics = Optics(truth.microscope.pixel_size_um, truth.microscope.width_px, truth.microscope.height_px)
    known = np.isfinite(xy).all(axis=(2, 3))
    error = np.full(known.shape, np.nan)
    found = triangulate(Tracks(xy[known]), poses, optics).xyz_um[:, 2]
    error[known] = found - truth.buffers[0].position_um[known][:, 2]
    return error - np.nanmedian(error)


def erring(axis_deg: float = 0.0, **errors: object) -> Scene:
    small = overridden(scaled(scene("sphere"), 0.25), {"specimen.subdivisions": 5})
    return replace(small, schedule=TiltSchedule(TILTS, axis_deg), **errors)  # type: ignore[arg-type]


WRONG = {
    "tilt": {"stage_errors": StageErrors(tilts_deg=(0.0, 0.1, 0.3))},
    "magnification": {"view_errors": ViewErrors(magnifications=(0.0, 1e-3, -2e-3))},
    "rotation": {"view_errors": ViewErrors(rotations_deg=(0.0, 0.2, 0.4))},
    "drift": {"scan": ScanOptions(drift_px=(0.7, 0.0))},
}


@pytest.mark.parametrize("axis_deg", [0.0, 90.0])
@pytest.mark.parametrize("what", WRONG)
def test_the_response_is_what_perfect_matches_and_triangulation_give(what: str, axis_deg: float) -> None:
    surfaces = prepare(erring(axis_deg, **WRONG[what]))
    expected = height_error_um(surfaces)
    found = systematic_error_um(surfaces)
    both = np.isfinite(expected) & np.isfinite(found)
    assert both.mean() > 0.3
    assert np.abs(found - expected)[both].max() < 0.02 * np.std(expected[both]) + 1e-3


def test_formulas_and_the_response_of_a_scene_agree() -> None:
    named = {name: prepare(erring(**errors)) for name, errors in WRONG.items()}
    points = named["tilt"].truth.buffers[0].position_um
    x, y, z = np.moveaxis(points, -1, 0)
    rows = np.linspace(-0.5, 0.5, points.shape[0])[:, None] + 0 * x
    size_um = named["drift"].scene.microscope.pixel_size_um
    formula = {
        "tilt": tilt_error_um(TILTS, (0.0, 0.1, 0.3), x, z),
        "magnification": magnification_error_um(TILTS, (0.0, 1e-3, -2e-3), x, z),
        "rotation": rotation_error_um(TILTS, (0.0, 0.2, 0.4), y),
        "drift": drift_error_um(TILTS, (0.7,) * 3, size_um, rows),
    }
    for name, expected in formula.items():
        found = systematic_error_um(named[name])
        difference = found - expected
        assert np.nanstd(difference) < 0.08 * np.nanstd(expected), name  # a line takes its time too, 1 of 48


def test_a_perfect_instrument_leaves_nothing_but_noise() -> None:
    surfaces = prepare(erring())
    assert predicted(surfaces, 0.0).median_abs_um < 1e-6
    noisy = predicted(surfaces, 0.4)
    sigma = noise_gain(TILTS) * 0.4 * surfaces.scene.microscope.pixel_size_um
    assert noisy.rms_um == pytest.approx(sigma, rel=1e-6)
    assert noisy.median_abs_um == pytest.approx(0.6745 * sigma, rel=0.02)


def test_noise_and_systematic_errors_add_in_squares() -> None:
    surfaces = prepare(erring(**WRONG["tilt"]))
    alone, both = predicted(surfaces, 0.0), predicted(surfaces, 0.4)
    noise = predicted(prepare(erring()), 0.4)
    assert alone.rms_um == pytest.approx(alone.systematic_rms_um, rel=0.05)
    assert both.rms_um == pytest.approx(np.hypot(alone.rms_um, noise.rms_um), rel=1e-3)
