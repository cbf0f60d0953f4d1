"""Iterations say how they came to their end, and what they say is what they did."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.running.stored import packed, unpacked
from semrecon.adjustment.refinement import refine
from semrecon.clouds.icp import PcregistericpStop, icp
from semrecon.clouds.registration import SequenceRegistration
from semrecon.data import Estimate, Optics, Tracks
from semrecon.geometry import rotations_from_tilts
from semrecon.methods.pair_clouds import PairCloud, registration_history
from semrecon.numerics.history import CONVERGENCE, MOST, histories, history
from semrecon.uncalibrated.affine_cameras import AffineCameras, loss
from semrecon.uncalibrated.parallel_bundle import FreeCameras, adjust, descend

OPTICS = Optics(0.1, 400, 300)
TILTS = np.array([-10.0, 0.0, 10.0])


def tracks(noise_px: float, seed: int = 5, points: int = 200) -> Tracks:
    """Points of a rough surface as three tilted views see them, with noise."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-15, -10, -3], [15, 10, 3], (points, 3))
    rotations = rotations_from_tilts(TILTS)
    seen = np.einsum("vij,nj->nvi", rotations[:, :2], xyz) / OPTICS.pixel_size_um + OPTICS.centre_px
    return Tracks(seen + rng.normal(0, noise_px, seen.shape))


def test_a_long_history_keeps_its_ends_and_says_which_steps_it_shows() -> None:
    values = np.geomspace(1.0, 1e-3, 5000).tolist()
    found = history("long", values)
    assert len(found["steps"]) == len(found["residual_px"]) == MOST
    assert (found["steps"][0], found["steps"][-1]) == (0, 4999)
    assert found["residual_px"] == [values[step] for step in found["steps"]]
    assert history("short", values[:3]) == {"stage": "short", "steps": [0, 1, 2], "residual_px": values[:3]}
    assert history("none", [])["steps"] == []
    assert json.loads(json.dumps(found)) == found


def test_histories_of_stages_are_found_too_and_survive_the_ledger() -> None:
    one, other = history("one", [2.0, 1.0]), history("other", [3.0])
    diagnostics = {"points": 3, CONVERGENCE: [one], "alignment": {"sigma_px": 0.1, CONVERGENCE: [other]}}
    assert histories(diagnostics) == [one, other]
    assert unpacked(packed(Estimate(diagnostics=diagnostics))).diagnostics == {CONVERGENCE: [one, other]}
    assert unpacked(packed(Estimate(diagnostics={"points": 3}))).diagnostics == {}


def test_the_distance_of_pairs_never_rises_in_icp_and_ends_at_the_rmse() -> None:
    """Besl and McKay's theorem of convergence: neither pairing nor fitting can make the sum of squares larger."""
    rng = np.random.default_rng(3)
    fixed = rng.uniform(-10, 10, (400, 3))
    turn = rotations_from_tilts(np.array([4.0]))[0] @ rotations_from_tilts(np.array([0.0]))[0].T
    moving = fixed[:300] @ turn.T + [0.5, -0.2, 0.1] + rng.normal(0, 0.05, (300, 3))
    found = icp(moving, fixed)
    assert found.iterations is not None
    assert len(found.history_um) == found.iterations + 1
    assert np.all(np.diff(found.history_um) <= 1e-12)
    assert found.history_um[-1] == found.rmse_um < 0.5 * found.history_um[0]
    (first,) = icp(moving, fixed, PcregistericpStop(max_iterations=1)).history_um[:1]
    assert first == pytest.approx(np.sqrt(np.mean(((moving[:, None] - fixed) ** 2).sum(axis=2).min(axis=1))))


def test_a_registration_is_told_in_pixels_of_the_image() -> None:
    rng = np.random.default_rng(4)
    fixed = rng.uniform(-10, 10, (50, 3))
    found = icp(fixed + 0.3, fixed)
    clouds = [PairCloud(pair, None, np.empty((0, 2))) for pair in ((0, 1), (1, 2))]  # type: ignore[arg-type]
    sequence = SequenceRegistration((found,), (), None)  # type: ignore[arg-type]  # clouds take no part
    (told,) = registration_history(clouds, sequence, 0.1)[CONVERGENCE]
    assert told["stage"] == "ICP, pair 1-2 to the pair before"
    np.testing.assert_allclose(told["residual_px"], np.array(found.history_um) / 0.1)


def test_a_bundle_adjustment_ends_at_the_noise() -> None:
    """The squares of what is left over those of the noise are the numbers measured less those fitted."""
    sigma_px = 0.3
    left = tracks(sigma_px)
    found = refine(left, TILTS + [0.3, 0.0, -0.2], OPTICS)
    assert len(found.history_px) == found.iterations + 1
    counted = int(found.tracks.seen.sum())
    points = int(np.isfinite(found.points.xyz_um).all(axis=1).sum())
    expected = sigma_px * np.sqrt((2 * counted - 3 * points) / counted)
    assert found.history_px[-1] == pytest.approx(expected, rel=0.1)
    assert abs(found.history_px[-1] - found.history_px[-2]) < 1e-4 * found.history_px[-1]


def test_cameras_of_unknown_tilt_descend() -> None:
    sigma_px = 0.2
    xy = tracks(sigma_px).xy_px - OPTICS.centre_px
    rng = np.random.default_rng(6)
    matrices = rotations_from_tilts(TILTS)[:, :2] @ rotations_from_tilts(TILTS)[1].T
    start = FreeCameras(AffineCameras(matrices + rng.normal(0, 0.02, matrices.shape), np.zeros((3, 2))), 1)
    weights = np.ones(xy.shape[:2])
    model, misses = descend(xy, weights, start)
    assert misses[0] == pytest.approx(np.sqrt(loss(xy, weights, start.cameras) / weights.sum()))
    assert misses[-1] == pytest.approx(np.sqrt(loss(xy, weights, model.cameras) / weights.sum()))
    assert np.all(np.diff(misses) <= 0)
    assert misses[0] > 5 * sigma_px
    assert misses[-1] == pytest.approx(sigma_px, rel=0.1)  # six numbers of a point measure three
    assert adjust(Tracks(xy), start).history_px[-1] == pytest.approx(misses[-1], rel=0.05)
