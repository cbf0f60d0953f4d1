"""Claims on the oracles: the truth leaves no error, each stage costs what it costs, and no method can be one."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.adapt import series_from_capture
from benchmarks.judging.evaluate import true_heights
from benchmarks.oracles import ORACLES, OracleMatches, OracleRegistration, OracleTranslation, label, true_motions
from semrecon.data import Array, Estimate, TiltSeries
from semrecon.geometry import view_from_world
from semrecon.judging.gauge import gauge_residual
from semrecon.matches.correspondence import CorrespondenceOptions, match_adjacent_pairs
from semrecon.methods import METHODS, KnownRotation
from semrecon.methods.known_rotation import reconstruct_pair
from semsim.capture import simulate
from semsim.microscope import TiltSchedule
from semsim.scenes import scene
from semsim.truth import GroundTruth


@lru_cache
def photographed() -> tuple[TiltSeries, GroundTruth]:
    made = scene("sphere")
    schedule = TiltSchedule((0.0, 6.0, 12.0), 0.0, ((0.0, 0.0), (3.1, -1.7), (-2.2, 2.6)))
    made = replace(made, schedule=schedule, detector=replace(made.detector, dose_e=800.0))
    made = replace(made, specimen=replace(made.specimen, contrast=0.25))
    capture = simulate(made, seed=11)
    return series_from_capture(capture), capture.truth


def errors_um(estimate: Estimate, truth: GroundTruth) -> Array:
    """Errors of the points, world heights at zero tilt, after the offset is removed."""
    assert estimate.points is not None
    xyz = estimate.points.xyz_um
    place = truth.microscope.centre_px + xyz[:, :2] * [1, -1] / truth.microscope.pixel_size_um
    return gauge_residual(xyz[:, 2], true_heights(truth, 0, place), ("offset",), norm="absolute")


def median_error(estimate: Estimate, truth: GroundTruth) -> float:
    return float(np.nanmedian(np.abs(errors_um(estimate, truth))))


@lru_cache
def answered(name: str) -> Estimate:
    series, truth = photographed()
    rng = np.random.default_rng(2)
    for oracle in ORACLES:
        if oracle.name == name:
            return oracle(series, truth, rng=rng)
    return KnownRotation(merge="icp" if name == "icp" else "poses")(series, rng=rng)


def test_true_matches_leave_no_error() -> None:
    """At the level of the ray caster's rounding: a thousandth of a pixel where the method has a quarter."""
    _, truth = photographed()
    estimate = answered("oracle_matches")
    assert estimate.points is not None
    assert len(estimate.points) > 200
    assert median_error(estimate, truth) < 1e-3
    assert median_error(estimate, truth) < 0.02 * median_error(answered("known_rotation"), truth)


def test_true_matches_recover_the_true_translations_to_the_gauge() -> None:
    _, truth = photographed()
    poses = answered("oracle_matches").poses
    assert poses is not None
    true = np.stack([pose.translation_um for pose in truth.poses])
    gap = poses.translations_um - true
    np.testing.assert_allclose(gap[:, 1], 0, atol=1e-3)  # along the axis nothing is free
    sines = np.sin(np.deg2rad(photographed()[0].tilts_deg))
    np.testing.assert_allclose(gap[:, 0], gap[2, 0] / sines[2] * sines, atol=1e-3)  # what a height offset does


def test_matching_is_what_costs_most() -> None:
    """Handing over the translations changes little; handing over the matches changes all."""
    _, truth = photographed()
    whole, without = (
        median_error(answered("known_rotation"), truth),
        median_error(answered("oracle_translation"), truth),
    )
    assert without == pytest.approx(whole, rel=0.25)
    assert median_error(answered("oracle_matches"), truth) < without / 20


def test_true_registration_is_no_worse_than_icp() -> None:
    _, truth = photographed()
    assert median_error(answered("oracle_registration"), truth) < 1.02 * median_error(answered("icp"), truth)


def test_true_motions_lay_clouds_on_each_other() -> None:
    """Each cloud, moved to the first, lies on the true surface to its own noise; in the wrong order it does not."""
    series, truth = photographed()
    matches = match_adjacent_pairs(series, CorrespondenceOptions(), np.random.default_rng(2))
    clouds = [reconstruct_pair(series, one) for one in matches]
    (motion,) = true_motions(matches, clouds, truth)
    relative = view_from_world(truth.poses[0].rotation) @ view_from_world(truth.poses[1].rotation).T
    np.testing.assert_allclose(motion.rotation, relative, atol=1e-12)
    moved = motion.apply(clouds[1].xyz_um)
    place = truth.microscope.centre_px + moved[:, :2] * [1, -1] / truth.microscope.pixel_size_um
    gap = moved[:, 2] - true_heights(truth, 0, place)
    back = motion.inverse.apply(clouds[1].xyz_um)
    place = truth.microscope.centre_px + back[:, :2] * [1, -1] / truth.microscope.pixel_size_um
    wrong = back[:, 2] - true_heights(truth, 0, place)
    right = np.nanmedian(np.abs(gap - np.nanmedian(gap)))
    assert right < 1.0
    assert np.nanmedian(np.abs(wrong - np.nanmedian(wrong))) > 2 * right


def test_an_oracle_says_what_it_was_given_and_is_no_method() -> None:
    names = {method.name for method in METHODS}
    for oracle in ORACLES:
        assert oracle.name.startswith("oracle_")
        assert oracle.name not in names
        assert "given true" in label(oracle)
    series, _ = photographed()
    with pytest.raises(TypeError):
        OracleMatches()(series, rng=np.random.default_rng(0))  # type: ignore[call-arg]
    for kind in (OracleMatches, OracleTranslation, OracleRegistration):
        assert kind.__module__ == "benchmarks.oracles"  # which test_laws keeps out of semrecon
