"""Judge clouds, registrations and height maps against the truth of a simulated series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from semrecon.clouds.registration import SequenceRegistration
from semrecon.data import Array, HeightMap, Mask, PointCloud
from semrecon.judging.gauge import gauge_residual
from semrecon.judging.metrics import DepthErrors, depth_errors, relative_rotation_error_deg, rmse_um
from semrecon.methods.base import Gauge
from semsim.truth import GroundTruth


@dataclass(frozen=True)
class CloudScore:
    """Depth of a cloud against truth at its own points.

    Parameters
    ----------
    errors_um
        Estimated minus true height along the beam of the view, after removal of the gauge, (points,).
    offset_um
        How far the cloud as a whole lay above the truth before that; along the beam.
    summary
        The errors in numbers; its completeness counts points, not the surface (see `map_score`).
    """

    errors_um: Array
    offset_um: float
    summary: DepthErrors


def true_heights(truth: GroundTruth, view: int, xy_px: Array) -> Array:
    """Elevation in the view frame of what a view sees at sub-pixel positions (points, 2): (points,) um."""
    return np.asarray(truth.surface_at(view, xy_px) @ truth.poses[view].view_from_world[2])


def cloud_score(cloud: PointCloud, truth: GroundTruth, view: int, gauge: Sequence[Gauge] = ("offset",)) -> CloudScore:
    """Judge a cloud in the view frame of `view`; only the declared gauge is removed."""
    true = true_heights(truth, view, cloud.xy_px)
    xy_um = cloud.xyz_um[:, :2]
    heights = cloud.xyz_um[:, 2]
    errors = gauge_residual(heights, true, gauge, xy_um, "absolute")
    offset = float(np.nanmedian(heights - true - errors))
    return CloudScore(errors, offset, depth_errors(heights, true, gauge, xy_um))


def commonly_visible(truth: GroundTruth, view: int, others: Sequence[int], step: int = 1) -> Mask:
    """Tell which pixels of a view, every `step`-th row and column, show a surface that all of `others` see too."""
    positions = truth.buffers[view].position_um[::step, ::step]
    seen = np.isfinite(positions).all(axis=-1)
    for other in others:
        seen &= truth.visible(other, positions)
    return np.asarray(seen)


def map_score(
    heights: HeightMap, truth: GroundTruth, view: int, judged: Mask, gauge: Sequence[Gauge] = ("offset",)
) -> DepthErrors:
    """Judge a height map on the grid of `view`, or on every n-th pixel of it, where `judged` is True.

    Parameters
    ----------
    heights
        Of the shape of `judged`.
    judged
        `commonly_visible` of the views that the estimate rests on: what could have been measured.
    """
    step = round(truth.microscope.height_px / judged.shape[0])
    true = np.where(judged, truth.height_map(view)[::step, ::step], np.nan)
    rows, columns = np.indices(judged.shape) * (step * truth.microscope.pixel_size_um)
    return depth_errors(heights.z_um, true, gauge, np.stack([columns, -rows], axis=-1))


@dataclass(frozen=True)
class RegistrationScore:
    """What the seed measures (section 5.1), each the mean over the registrations of neighbouring clouds.

    Parameters
    ----------
    rmse_um, rmse_back_um
        Eq. 7, moving to fixed as `pcregistericp` reports it, and fixed to moving.
    rre_deg
        Eq. 8, against the rotation between the frames of the two clouds.
    """

    rmse_um: float
    rmse_back_um: float
    rre_deg: float


def registration_score(
    clouds: Sequence[PointCloud], registered: SequenceRegistration, views_from_world: Array
) -> RegistrationScore:
    """Judge a sequence of registrations.

    Parameters
    ----------
    clouds
        Each in the view frame of its first view.
    views_from_world
        Rotation of that view frame for each cloud, (clouds or more, 3, 3): the seed's "true rotation" comes from these.
    """
    errors, forth, back = [], [], []
    for k, ((fixed, moving), pair) in enumerate(zip(pairwise(clouds), registered.pairs, strict=True)):
        fixed_from_moving = views_from_world[k] @ views_from_world[k + 1].T
        errors.append(relative_rotation_error_deg(fixed_from_moving, pair.rotation))
        distances = rmse_um(moving.xyz_um @ pair.rotation.T + pair.translation_um, fixed.xyz_um)
        forth.append(distances.moving_to_fixed_um)
        back.append(distances.fixed_to_moving_um)
    return RegistrationScore(_mean(forth), _mean(back), _mean(errors))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
