"""What an error does to the depth, predicted by formula: noise of matching, stage, magnification, rotation, drift.

In the frame across the tilt axis, a point (x, z) is seen by view v at ``u_v = x cos t_v + z sin t_v``. Least squares
over the views makes z a weighted sum of the positions, ``z = sum_v k_v u_v``, with ``sum_v k_v cos t_v = 0`` and
``sum_v k_v sin t_v = 1``. So whatever displaces the picture of view v by e_v raises the depth by ``sum_v k_v e_v``, and
independent noise of standard deviation sigma by ``|k| sigma``. For two views, 0 and t: k = (-cot t, 1 / sin t).
A constant is gauge. `systematic_error_um` is this one sentence with all the e_v of a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semsim.capture import Surfaces
from semsim.mesh import Array
from semsim.microscope import poses, project

DRAWS = 100_000
"""Normal numbers by which noise is mixed with a systematic error, at least."""


@dataclass(frozen=True)
class Predicted:
    """Depth error to be expected, um, its constant part taken away.

    Parameters
    ----------
    median_abs_um, rms_um
        Over the pixels that all views see, systematic and random errors together.
    systematic_rms_um
        Of the systematic part alone: what more electrons do not cure.
    """

    median_abs_um: float
    rms_um: float
    systematic_rms_um: float


def depth_weights(tilts_deg: Sequence[float]) -> Array:
    """k: change of the depth for a displacement of each view across the tilt axis, um for um, (views,).

    Raises
    ------
    ValueError
        All tilts are the same: there is no parallax.
    """
    tilts = np.deg2rad(np.asarray(tilts_deg, dtype=np.float64))
    design = np.stack([np.cos(tilts), np.sin(tilts)], axis=1)
    if np.ptp(tilts) < 1e-9:
        raise ValueError("views at one and the same tilt have no parallax")
    return np.asarray(np.linalg.pinv(design)[1])


def noise_gain(tilts_deg: Sequence[float]) -> float:
    """Return the standard deviation of the depth for a unit of independent position noise in every view: |k|."""
    return float(np.linalg.norm(depth_weights(tilts_deg)))


def systematic_error_um(surfaces: Surfaces) -> Array:
    """Depth error that stage, column and scan of a scene leave in a perfect match, (rows, columns), um.

    Each view's displacement is the true image position of the surface of a reference pixel minus that by the nominal
    pose, so all errors count, to first order. A constant is taken away. NaN where a view does not see the surface.
    """
    scene, truth = surfaces.scene, surfaces.truth
    microscope, schedule = scene.microscope, scene.schedule
    axis = np.deg2rad(schedule.tilt_axis_deg)
    across = np.array([np.cos(axis), np.sin(axis)])  # camera x, y: across the axis in the image, rows downwards
    points = truth.buffers[schedule.reference].position_um
    error = np.zeros(points.shape[:2])
    for view, (weight, nominal) in enumerate(zip(depth_weights(schedule.tilts_deg), poses(schedule), strict=True)):
        seen = truth.correspondence(schedule.reference, view)
        moved_px = seen - project(microscope, nominal, points)
        error += weight * microscope.pixel_size_um * (moved_px @ across)
    return np.asarray(error - np.nanmedian(error)) if np.isfinite(error).any() else error


def predicted(surfaces: Surfaces, matching_noise_px: float) -> Predicted:
    """Predict the depth error of points matched with independent noise in every view, at nominal poses.

    Parameters
    ----------
    matching_noise_px
        Standard deviation of a point's position in one view, across the tilt axis.
    """
    error = systematic_error_um(surfaces)
    error = error[np.isfinite(error)]
    if not error.size:
        return Predicted(np.nan, np.nan, np.nan)
    scene = surfaces.scene
    sigma = noise_gain(scene.schedule.tilts_deg) * matching_noise_px * scene.microscope.pixel_size_um
    normal = np.random.default_rng(0).normal(size=(max(1, DRAWS // error.size), error.size))
    total = error + sigma * normal
    return Predicted(
        float(np.median(np.abs(total))), float(np.hypot(error.std(), sigma)), float(np.sqrt(np.mean(error**2)))
    )
