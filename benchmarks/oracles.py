"""Contenders that are handed part of the truth, and say so: they cannot stand among the methods."""

from __future__ import annotations

import numpy as np

from semrecon.data import Estimate, HeightMap, PointCloud, Poses
from semsim.truth import GroundTruth


def truth_as_estimate(truth: GroundTruth, view: int) -> Estimate:
    """Submit the truth itself: judging is right only if this scores zero error and full completeness.

    Parameters
    ----------
    view
        Reference view of the height map; points are in its view frame, one for every pixel that shows the surface.
    """
    buffer, pose = truth.buffers[view], truth.poses[view]
    rows, columns = np.nonzero(~buffer.miss)
    xy_px = np.column_stack([columns, rows]).astype(np.float64)
    xyz_um = buffer.position_um[rows, columns] @ pose.view_from_world.T
    unknown = np.zeros((len(xyz_um), 3, 3))
    points = PointCloud(xyz_um, unknown, np.zeros(len(xyz_um)), xy_px)
    heights = truth.height_map(view)
    poses = Poses(
        np.stack([each.rotation for each in truth.poses]), np.stack([each.translation_um for each in truth.poses])
    )
    return Estimate(points, HeightMap(heights, np.zeros_like(heights), truth.microscope.pixel_size_um), poses)
