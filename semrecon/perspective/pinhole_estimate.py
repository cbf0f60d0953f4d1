"""The answer of a method that takes the microscope for a pinhole camera, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from semrecon.data import Estimate, HeightMap, PointCloud, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.matches.correspondence import view_name
from semrecon.perspective.pinhole import PinholeReconstruction, in_series
from semrecon.surface.meshing import height_map_from_points, without_outliers

CLEAR = 3.0
"""Perspective over the relief must move points so many times the noise to count as seen."""


def estimate_of(
    series: TiltSeries, found: PinholeReconstruction, extra: dict[str, Any], warnings: Sequence[str] = ()
) -> Estimate:
    """Bring a reconstruction into the frame of the series, with heights and warnings.

    Raises
    ------
    MethodError
        Where the points span no surface.
    """
    points, poses = in_series(series, found)
    return Estimate(
        points=points,
        heights=_heights(series, points),
        poses=poses,
        diagnostics=extra | _diagnostics(found, series.reference),
        warnings=(*warnings, *_warnings(series, found, points)),
    )


def _heights(series: TiltSeries, points: PointCloud) -> HeightMap:
    rotation = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[series.reference]
    try:
        return height_map_from_points(without_outliers(points, rotation), series.optics, rotation)
    except InputError as error:
        raise MethodError(f"the {len(points)} points found span no surface: {error}") from error


def _diagnostics(found: PinholeReconstruction, reference: int) -> dict[str, Any]:
    """Count points and views; the turns are those from the reference view, in no sign."""
    cameras, seen = found.cameras, np.isfinite(found.xy_px).all(axis=2)
    relative = cameras.rotations @ cameras.rotations[reference].T
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    views = seen.sum(axis=1)
    return {
        "points": len(found.xyz),
        "points_by_views": {str(n): int((views == n).sum()) for n in np.unique(views)},
        "views_placed": np.flatnonzero(cameras.placed),
        "start_pair": None if found.start is None else list(found.start),
        "turns_deg": np.rad2deg(np.arccos(np.clip(cosine, -1, 1))),
        "focal_px": cameras.focal_px,
        "sigma_px": found.sigma_px,
    }


def _warnings(series: TiltSeries, found: PinholeReconstruction, points: PointCloud) -> tuple[str, ...]:
    said = []
    if not series.optics.inverse_working_distance:
        said.append(
            "no working distance is stated, so the views count as parallel; this method took them for perspective with "
            f"a focal length of {found.cameras.focal_px / series.optics.width_px:.3g} image widths, and its tilts and "
            "heights rest on that"
        )
    relief = float(np.ptp(np.percentile(points.xyz_um[:, 2], (5, 95)))) / series.optics.pixel_size_um
    shift = series.optics.width_px / 2 * relief / found.cameras.focal_px
    if shift < CLEAR * found.sigma_px:
        said.append(
            f"perspective moves points at the rim by {shift:.2g} px over the relief found, and the noise is "
            f"{found.sigma_px:.2g} px: too little to tell tilts and relief apart, or hills from valleys"
        )
    lost = [view_name(series, int(view)) for view in np.flatnonzero(~found.cameras.placed)]
    if lost:
        said.append(f"{', '.join(lost)} could not be placed and took no part")
    return tuple(said)
