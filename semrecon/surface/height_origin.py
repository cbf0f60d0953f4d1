"""Where height 0 lies: at the median of what was measured, as parallel views cannot tell (docs/conventions.md)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semrecon.data import Estimate, PointCloud, Poses


def with_median_zero(estimate: Estimate, reference: int) -> Estimate:
    """Move the world along the beam of the reference view until the median height is 0; no image changes by it.

    Under parallel projection only: with perspective, height 0 is the plane on which the pixel size holds.

    Parameters
    ----------
    estimate
        With heights and poses; its points and ties move along.
    reference
        Index of the view on whose grid the heights are.
    """
    heights, poses = estimate.heights, estimate.poses
    if heights is None or poses is None or not np.isfinite(heights.z_um).any():
        return estimate
    middle = float(np.nanmedian(heights.z_um))
    shift = middle * poses.rotations[reference, 2]
    moved = poses.translations_um - poses.rotations @ shift
    moved[:, 2] = poses.translations_um[:, 2]  # along the beam nothing can be seen
    return replace(
        estimate,
        heights=replace(heights, z_um=heights.z_um - middle),
        poses=Poses(poses.rotations, moved),
        points=_moved(estimate.points, shift),
        ties=_moved(estimate.ties, shift),
    )


def _moved(points: PointCloud | None, shift: np.ndarray) -> PointCloud | None:
    return None if points is None else replace(points, xyz_um=points.xyz_um + shift)
