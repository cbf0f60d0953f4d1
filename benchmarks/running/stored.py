"""Estimates as bytes: small enough to keep all of them, whole enough to judge and to draw them again."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Estimate, HeightMap, PointCloud, Poses
from semrecon.numerics.history import CONVERGENCE, histories

MOST_POINTS = 40_000
"""Of a cloud that is kept; of a larger one every so-many-th point is (it is the height map that says the rest)."""


def packed(estimate: Estimate) -> bytes:
    """Write heights, points, poses and how iterations converged, compressed: lengths as float32, rotations in full."""
    arrays: dict[str, NDArray[Any]] = {}
    if estimate.heights is not None:
        arrays["z_um"] = estimate.heights.z_um.astype(np.float32)
        arrays["z_sigma_um"] = estimate.heights.sigma_um.astype(np.float32)
        arrays["pixel_size_um"] = np.array(estimate.heights.pixel_size_um)
    if estimate.points is not None:
        kept = estimate.points.keep(np.arange(0, len(estimate.points), -(-max(1, len(estimate.points)) // MOST_POINTS)))
        arrays["xyz_um"] = kept.xyz_um.astype(np.float32)
        arrays["variance_um2"] = kept.covariance_um2[:, 2, 2].astype(np.float32)
        arrays["residual_px"] = kept.residual_px.astype(np.float32)
        arrays["xy_px"] = kept.xy_px.astype(np.float32)
    if estimate.poses is not None:
        arrays["rotations"] = estimate.poses.rotations
        arrays["translations_um"] = estimate.poses.translations_um
    if converged := histories(estimate.diagnostics):
        arrays[CONVERGENCE] = np.array(json.dumps(converged))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # names are ours, none is `file`
    return buffer.getvalue()


def unpacked(blob: bytes) -> Estimate:
    """Read what `packed` wrote; of the covariances there is the variance along z, of diagnostics the convergence."""
    with np.load(io.BytesIO(blob)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    heights = points = poses = None
    if "z_um" in arrays:
        z_um, sigma_um = (arrays[name].astype(np.float64) for name in ("z_um", "z_sigma_um"))
        heights = HeightMap(z_um, sigma_um, float(arrays["pixel_size_um"]))
    if "xyz_um" in arrays:
        covariance = np.full((len(arrays["xyz_um"]), 3, 3), np.nan)
        covariance[:, 2, 2] = arrays["variance_um2"]
        xyz_um, residual_px, xy_px = (arrays[name].astype(np.float64) for name in ("xyz_um", "residual_px", "xy_px"))
        points = PointCloud(xyz_um, covariance, residual_px, xy_px)
    if "rotations" in arrays:
        poses = Poses(arrays["rotations"], arrays["translations_um"])
    diagnostics = {CONVERGENCE: json.loads(str(arrays[CONVERGENCE]))} if CONVERGENCE in arrays else {}
    return Estimate(points, heights, poses, diagnostics=diagnostics)
