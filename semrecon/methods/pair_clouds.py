"""What methods that work pair by pair have in common: clouds of adjacent pairs, brought together by registration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.clouds.registration import Registration, SequenceRegistration, icp, register_sequence
from semrecon.data import Array, HeightMap, Mask, PointCloud, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.geometry import centred_um, rotations_from_tilts, view_from_world
from semrecon.matches.correspondence import PairMatches, pair_geometry, view_name
from semrecon.numerics.history import CONVERGENCE, history
from semrecon.surface.meshing import height_map_from_points, without_outliers

SLOPE_PX = 1.0
"""Epipolar lines that run apart by more than this over half an image deserve a warning."""


@dataclass(frozen=True)
class PairCloud:
    """Points of one pair.

    Parameters
    ----------
    pair
        Indices of the views.
    cloud
        In the view frame of the first view; its `xy_px` are positions there.
    xy2_px
        Positions in the second view, (points, 2).
    """

    pair: tuple[int, int]
    cloud: PointCloud
    xy2_px: Array


def pair_clouds_of(matches: Sequence[PairMatches], clouds: Sequence[PointCloud]) -> tuple[PairCloud, ...]:
    """Put clouds beside the matches they come from, row by row, without the points that could not be placed."""
    both = zip(matches, clouds, [_known(cloud) for cloud in clouds], strict=True)
    return tuple(PairCloud(m.pair, cloud.keep(known), m.matches.xy2_px[known]) for m, cloud, known in both)


def register_pair_clouds(
    series: TiltSeries,
    clouds: Sequence[PairCloud],
    method: Callable[[PointCloud, PointCloud], Registration] = icp,
) -> tuple[PointCloud, SequenceRegistration]:
    """Bring clouds of adjacent pairs together by ICP, as the seed does (section 4.1, step 6), into the world frame.

    The first cloud stays; its nominal rotation leads to world axes. Where the reference view sees points, their
    positions there fix the origin in the image plane; along its beam the median height becomes zero.

    Raises
    ------
    MethodError
        Where a cloud has too few points to be registered.
    """
    for one in clouds:
        if len(one.cloud) < 3:
            names = " and ".join(view_name(series, i) for i in one.pair)
            raise MethodError(f"{names} have {len(one.cloud)} points in common; registration needs at least three")
    registration = register_sequence([one.cloud for one in clouds], method)
    merged = registration.merged
    rotations = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)
    first, beam = view_from_world(rotations[clouds[0].pair[0]]), rotations[series.reference]
    world = merged.xyz_um @ first
    xy_px = np.concatenate([_seen_by(series.reference, one) for one in clouds])
    seen = np.isfinite(xy_px).all(axis=1)
    camera = world @ beam.T
    shift = np.append(np.median(centred_um(xy_px, series.optics)[seen] - camera[seen, :2], axis=0), 0.0)
    shift[2] = -np.median(camera[:, 2])
    covariance = first.T @ merged.covariance_um2 @ first
    return PointCloud(world + shift @ beam, covariance, merged.residual_px, xy_px), registration


def registration_history(
    clouds: Sequence[PairCloud], registration: SequenceRegistration, pixel_size_um: float
) -> dict[str, Any]:
    """Keep how each registration converged, ready for the report; nothing where the library does not say."""
    found = []
    for one, each in zip(clouds[1:], registration.pairs, strict=True):
        if each.history_um:
            residual_px = [rms_um / pixel_size_um for rms_um in each.history_um]
            found.append(history(f"ICP, pair {one.pair[0]}-{one.pair[1]} to the pair before", residual_px))
    return {CONVERGENCE: found} if found else {}


def heights_of(series: TiltSeries, points: PointCloud, translation_um: Array | None = None) -> HeightMap:
    """Fill the mesh of points in the world frame on the grid of the reference view.

    A wrong point would pull all triangles round it, so points that stand out against their neighbours take no part;
    the cloud itself keeps them. All methods are treated alike.

    Raises
    ------
    MethodError
        Where the points span no surface.
    """
    rotation = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[series.reference]
    points = without_outliers(points, rotation)
    try:
        return height_map_from_points(points, series.optics, rotation, translation_um)
    except InputError as error:
        raise MethodError(f"the {len(points)} points found span no surface: {error}") from error


def match_diagnostics(series: TiltSeries, matches: Sequence[PairMatches]) -> dict[str, Any]:
    """Count features and matches, ready for the report."""
    features = {view: count for one in matches for view, count in zip(one.pair, one.features, strict=True)}
    return {
        "features": {view_name(series, view): features[view] for view in sorted(features)},
        "pairs": [
            {
                "views": list(one.pair),
                "candidates": one.candidates,
                "matches": len(one.matches),
                "shift_across_px": one.shift_px,
                "sigma_across_px": one.sigma_px,
                "skew": list(one.skew),
            }
            for one in matches
        ],
    }


def skew_warnings(series: TiltSeries, matches: Sequence[PairMatches]) -> tuple[str, ...]:
    """Say which adjacent pairs have epipolar lines that are not parallel as stated; depth is sloped by as much.

    Two views show a difference of magnification and a rotation in the image plane, but not a wrong tilt.
    """
    said = []
    for one in matches:
        rotation, magnification = one.skew
        if one.pair[1] != one.pair[0] + 1 or _slope_px(series, one) < SLOPE_PX:
            continue
        said.append(
            f"{view_name(series, one.pair[0])} and {view_name(series, one.pair[1])} do not fit the stated geometry: "
            f"along the tilt axis they differ in magnification by {100 * magnification:+.2f} %, and their axes by "
            f"{np.rad2deg(rotation):+.2f} degrees; the heights of this pair may slope by "
            f"{_slope_um(series, one):.1f} um towards the rim"
        )
    return tuple(said)


def _slope_px(series: TiltSeries, one: PairMatches) -> float:
    """By how much the epipolar lines run apart over half an image, px."""
    return float(np.hypot(*one.skew)) * max(series.optics.shape) / 2


def _slope_um(series: TiltSeries, one: PairMatches) -> float:
    """Turn the same into heights at the rim, um: along the lines it cannot be told from depth."""
    return _slope_px(series, one) * series.optics.pixel_size_um / pair_geometry(series, one.pair).parallax


def _known(cloud: PointCloud) -> Mask:
    return np.asarray(np.isfinite(cloud.xyz_um).all(axis=1))


def _seen_by(view: int, one: PairCloud) -> Array:
    """Positions of a cloud's points in a view, NaN where the pair does not have it."""
    if view == one.pair[0]:
        return one.cloud.xy_px
    return one.xy2_px if view == one.pair[1] else np.full_like(one.xy2_px, np.nan)
