"""What the last stages of the dense method make of a perfect start: cameras and shading, begun at the true surface.

Where they end no nearer to it than from what the sweeps found, a better sweep would not help: it is what they believe
of brightness that leads away. Where they end nearer, the start is what is missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.bars.derived import Numbers
from benchmarks.judging.evaluate import true_heights
from benchmarks.running.bench_ledger import BenchLedger
from benchmarks.running.case import Case, handed
from benchmarks.running.stored import unpacked
from semrecon.data import Array, Mask, TiltSeries
from semrecon.dense.pictures import filled, prepared
from semrecon.dense.shading import ShadingOptions, shaded
from semrecon.dense.sightlines import sightlines
from semrecon.dense.spline import spline_of
from semrecon.errors import MethodError
from semrecon.methods.cameras_from_tones import with_tones
from semrecon.methods.dense_multiview import DenseMultiview
from semrecon.pose.alignment import Alignment, align
from semsim.truth import GroundTruth

SEED = 0
"""Of the random choices among features."""


def begun_at_truth(ledger: Path, case: Case) -> tuple[tuple[str, str], Numbers]:
    """Begin the last stages at the true surface, and judge that beside the answer on record; by a worker.

    Returns
    -------
    Names of scene and method; `from_truth_ratio` and `from_truth_rms_ratio`, median absolute and rms error from the
    true start over those of the answer, at the pixels that both have, each less the median of its errors; nothing where
    one of them has none.
    """
    source, series = case.scene.source, handed(case.scene.series(case.repetition), case.method)
    answer = unpacked(BenchLedger(ledger).answer(case).estimate).heights
    true_um = source.truth().height_map(series.reference)
    others = tuple(view for view in range(len(series)) if view != series.reference)
    judged = source.judgeable((series.reference, *others), 1) & np.isfinite(true_um)
    if answer is None or not (judged & np.isfinite(answer.z_um)).any():
        return (case.scene.name, case.method.name), {}
    both = judged & np.isfinite(answer.z_um)
    try:
        begun_um = from_truth(DenseMultiview(), series, source.truth())
    except MethodError:  # no features: the line is told of the other specimens
        return (case.scene.name, case.method.name), {}
    ours, given = (_errors(each, true_um, both) for each in (answer.z_um, begun_um))
    numbers = {
        "from_truth_ratio": float(np.median(np.abs(given)) / np.median(np.abs(ours))),
        "from_truth_rms_ratio": float(np.sqrt(np.mean(given**2) / np.mean(ours**2))),
    }
    return (case.scene.name, case.method.name), numbers


def from_truth(method: DenseMultiview, series: TiltSeries, truth: GroundTruth) -> Array:
    """Take cameras from features as the method does, and let its last stages begin at the true surface.

    Shading counts everywhere: a choice between it and where it began would be one between it and the truth.

    Returns
    -------
    Heights (rows, columns), um, a number everywhere.

    Raises
    ------
    MethodError
        There are no features that would tell how high the true surface stands in those cameras.
    """
    aligned = align(series, method.correspondence, method.refinement, np.random.default_rng(SEED))
    pictures = [prepared(view) for view in series.views]
    true_px = truth.height_map(series.reference) / series.optics.pixel_size_um
    heights = filled(true_px, np.isfinite(true_px)) + _offset_px(series, aligned, truth)
    splines = [spline_of(picture) for picture in pictures]
    tilt_sigma_deg = method.refinement.tilt_sigma_deg
    aligned, heights = with_tones(series, aligned, splines, heights, method.parallax, tilt_sigma_deg)
    lines = sightlines(aligned.poses, aligned.distortions, series.optics, series.reference)
    found = shaded(series, pictures, lines, heights, method.parallax, ShadingOptions(), everywhere=True)
    return np.asarray(found.heights * series.optics.pixel_size_um)


def _offset_px(series: TiltSeries, aligned: Alignment, truth: GroundTruth) -> float:
    """Median height of the features over the true surface, px: the zero of the cameras that they gave."""
    if aligned.points is None:
        raise MethodError("there are no features to tell how high the surface stands")
    beam, size_um = aligned.poses.rotations[series.reference, 2], series.optics.pixel_size_um
    found_um = -(aligned.points.xyz_um @ beam)
    true_um = true_heights(truth, series.reference, aligned.points.xy_px)
    return float(np.nanmedian(found_um - true_um)) / size_um


def _errors(heights_um: Array, true_um: Array, where: Mask) -> Array:
    errors = (heights_um - true_um)[where]
    return np.asarray(errors - np.median(errors))
