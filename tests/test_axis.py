"""Claims on the tilt axis: found from matches alone as a line, with an honest sigma; refused where nothing shows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from semrecon.data import Array, Optics
from semrecon.errors import MethodError
from semrecon.geometry import project, rotations_from_tilts
from semrecon.matches.affine_epipolar import fit_affine_epipolar
from semrecon.pose.axis import (
    AxisEstimate,
    PairAxis,
    axis_contradiction,
    combine,
    difference_deg,
    pair_axis,
    principal_deg,
)

OPTICS = Optics(0.1, 800, 600)
AXES = (0.0, 30.0, 90.0, -60.0)


def matches(
    axis_deg: float, seed: int, *, noise_px: float = 0.3, relief_um: float = 8.0, every: int = 10
) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1, 1, (300, 3)) * [35, 25, relief_um]
    views = [project(xyz, one, np.zeros(3), OPTICS) for one in rotations_from_tilts(np.array([0.0, 8.0]), axis_deg)]
    first, second = (view + rng.normal(0, noise_px, view.shape) for view in views)
    second[::every] = rng.uniform(0, 600, second[::every].shape)  # wrong matches
    return first, second


def found(axis_deg: float, seed: int, **options: Any) -> PairAxis:
    return pair_axis((0, 1), fit_affine_epipolar(*matches(axis_deg, seed, **options), np.random.default_rng(seed)))


@pytest.mark.parametrize("axis_deg", AXES)
def test_exact_matches_give_the_exact_axis(axis_deg: float) -> None:
    assert difference_deg(found(axis_deg, 3, noise_px=1e-6).axis_deg, axis_deg) == pytest.approx(0, abs=1e-3)


def test_sigma_is_the_scatter_of_the_axis() -> None:
    pulls = [
        difference_deg(one.axis_deg, 30) / one.sigma_deg for one in (found(30.0, seed, every=150) for seed in range(30))
    ]
    assert 0.6 < np.std(pulls) < 1.4


def test_a_plane_shows_no_axis() -> None:
    with pytest.raises(MethodError, match="affine map"):
        found(0.0, 1, relief_um=0.0)


def test_lines_have_no_sense() -> None:
    assert principal_deg(-90) == 90
    assert principal_deg(179) == -1
    assert difference_deg(89, -89) == pytest.approx(-2)


def estimate(axis_deg: float, sigma_deg: float, parallax_px: float = 60.0) -> AxisEstimate:
    return combine([PairAxis((0, 1), axis_deg, sigma_deg, 0.0, 100, parallax_px, 0.3)])


def test_contradiction_needs_harm_and_significance() -> None:
    assert "--tilt-axis-deg" in str(axis_contradiction(0.0, estimate(-0.76, 0.1)))
    assert axis_contradiction(0.0, estimate(-0.76, 0.3)) is None
    assert axis_contradiction(0.0, estimate(-0.76, 0.1, parallax_px=5.0)) is None
    assert axis_contradiction(180.0, estimate(0.1, 0.1)) is None
