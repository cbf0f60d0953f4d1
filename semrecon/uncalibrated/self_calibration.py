"""Cameras and points of a series from its images alone: tracks, factorization, metric upgrade, frames and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semrecon.data import Array, PointCloud, Poses, TiltSeries, Tracks
from semrecon.errors import MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.matches.correspondence import PairMatches
from semrecon.matches.tracks import join_matches
from semrecon.numerics.history import CONVERGENCE, history
from semrecon.points.triangulation import triangulate
from semrecon.uncalibrated.factorization import factorize
from semrecon.uncalibrated.metric_upgrade import Tilts, tilts_of, upgrade, with_sign
from semrecon.uncalibrated.parallel_bundle import Adjusted, TurnedCameras

DOUBTFUL, HOPELESS = 0.05, 0.5
"""Relative standard deviation of the scale of heights that deserves a warning, and that is no answer."""


@dataclass(frozen=True)
class SelfCalibration:
    """What the images alone tell of a series.

    Parameters
    ----------
    adjusted
        Cameras and points in px, in camera axes of the reference view.
    tilts
        The same rotations as tilts about a common axis.
    poses
        Of ideal cameras in the world frame, um. The stated tilt of the reference view alone says how that lies.
    points
        Tracks that count, in the world frame; their median height along the reference beam is 0. Covariances hold the
        matching noise and the uncertainty of the scale of heights.
    diagnostics, warnings
        For `Estimate`.
    """

    adjusted: Adjusted[TurnedCameras]
    tilts: Tilts
    poses: Poses
    points: PointCloud
    diagnostics: dict[str, Any]
    warnings: tuple[str, ...]


def calibrate(
    series: TiltSeries, matches: Sequence[PairMatches], *, scaled: bool = True, sigmas: float = 3.5
) -> SelfCalibration:
    """Find cameras and points from matches of views of unknown tilt.

    Parameters
    ----------
    scaled
        Give every view a magnification of its own (scaled orthographic); otherwise all have the stated one.
    sigmas
        Leave out tracks whose misses are as unlikely as so many standard deviations.

    Raises
    ------
    MethodError
        With fewer than three views, too few points in common, or tilts too small to tell the scale of heights.
    """
    if len(series) < 3:
        raise MethodError(
            f"{len(series)} views do not tell the scale of heights without known tilts (bas-relief ambiguity); "
            "three or more are needed"
        )
    joined = join_matches(matches, len(series))
    tracks = Tracks(joined.xy_px - series.optics.centre_px)
    affine = factorize(tracks, series.reference, sigmas=sigmas)
    adjusted = with_sign(upgrade(tracks, affine, scaled=scaled, sigmas=sigmas))
    tilts = tilts_of(adjusted)
    if not tilts.depth_sigma <= HOPELESS:
        raise MethodError(
            "the images do not tell by how much the views are tilted (the scale of heights is uncertain by "
            f"{100 * tilts.depth_sigma:.0f} %): larger tilts or more views are needed, or a method that knows the tilts"
        )
    adjusted = _depth_held(adjusted)
    poses, points = _in_world(series, joined, adjusted, tilts)
    return SelfCalibration(
        adjusted, tilts, poses, points, _diagnostics(tracks, affine.sigma_px, adjusted, tilts), _warnings(series, tilts)
    )


def _depth_held(adjusted: Adjusted[TurnedCameras]) -> Adjusted[TurnedCameras]:
    """Move the whole along the reference beam to median depth zero, and the shifts with it: no image changes."""
    depth = float(np.nanmedian(adjusted.points[:, 2]))
    model = adjusted.model
    offsets = model.offsets + depth * model.cameras.matrices[:, :, 2]
    return replace(adjusted, model=replace(model, offsets=offsets), points=adjusted.points - [0.0, 0.0, depth])


def _in_world(
    series: TiltSeries, tracks: Tracks, adjusted: Adjusted[TurnedCameras], tilts: Tilts
) -> tuple[Poses, PointCloud]:
    """Poses and points in um, in the frame of the stated reference view."""
    model, optics = adjusted.model, replace(series.optics, inverse_working_distance=0.0)
    scales = np.exp(model.log_scales)[:, None]
    frame = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[series.reference]
    shifts = np.pad(model.offsets / scales * optics.pixel_size_um, ((0, 0), (0, 1)))
    poses = Poses(model.rotations @ frame, shifts)
    corrected = Tracks(optics.centre_px + (tracks.xy_px[adjusted.inliers] - optics.centre_px) / scales)
    cloud = triangulate(corrected, poses, optics, sigma_px=adjusted.sigma_px, reference=series.reference)
    cloud = cloud.keep(np.asarray(np.isfinite(cloud.xyz_um).all(axis=1)))
    return poses, _with_scale_sigma(cloud, frame[2], tilts.depth_sigma)


def _with_scale_sigma(cloud: PointCloud, beam: Array, depth_sigma: float) -> PointCloud:
    """Add what a wrong scale of heights does, along the beam."""
    variance = (depth_sigma * (cloud.xyz_um @ beam)) ** 2
    return replace(cloud, covariance_um2=cloud.covariance_um2 + variance[:, None, None] * np.outer(beam, beam))


def _diagnostics(
    tracks: Tracks, affine_sigma_px: float, adjusted: Adjusted[TurnedCameras], tilts: Tilts
) -> dict[str, Any]:
    views = tracks.seen.sum(axis=1)
    return {
        "tracks": len(tracks),
        "tracks_by_views": {str(n): int((views == n).sum()) for n in np.unique(views)},
        "rejected": int((~adjusted.inliers).sum()),
        "sigma_px": adjusted.sigma_px,
        "affine_sigma_px": affine_sigma_px,
        "tilts_deg": tilts.tilts_deg,
        "tilt_sigma_deg": tilts.sigma_deg,
        "tilt_axis_deg": tilts.axis_deg,
        "off_axis_deg": tilts.off_axis_deg,
        "magnifications": np.exp(adjusted.model.log_scales),
        "depth_scale_sigma": tilts.depth_sigma,
        CONVERGENCE: [history("bundle adjustment", adjusted.history_px)],
    }


def _warnings(series: TiltSeries, tilts: Tilts) -> tuple[str, ...]:
    said = ["the sign of the relief is a convention: the images of parallel views do not tell hills from valleys"]
    if tilts.depth_sigma > DOUBTFUL:
        said.append(
            f"the tilts come from the images alone, and the scale of heights is uncertain by "
            f"{100 * tilts.depth_sigma:.0f} %: larger tilts or more views would help"
        )
    if series.optics.inverse_working_distance:
        said.append("the views are stated to be perspective; the cameras of this method are parallel projections")
    return tuple(said)
