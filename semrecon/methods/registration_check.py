"""Registration of pairwise clouds beside the poses of all views, which need none: by how much they differ.

Each cloud of an adjacent pair stands in the frame of its first view, at a depth of its own (the gauge of its linear
system). The poses say how one frame moves into the next; registration finds the same motion from the shapes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.clouds.icp import PcregistericpStop, Registration, icp
from semrecon.data import Optics, PointCloud, Poses, Tracks
from semrecon.geometry import CAM_FROM_VIEW, view_from_world
from semrecon.methods.pair_clouds import PairCloud
from semrecon.numerics.motion import RigidMotion, rotation_angle_rad
from semrecon.numerics.neighbours import distances_um
from semrecon.points.triangulation import triangulate

MOST = 2000
"""Most points of a cloud that take part: the comparison must not cost more than what it compares."""
LEAST = 3
QUICK_ICP = partial(icp, stop=PcregistericpStop(max_iterations=300))


@dataclass(frozen=True)
class RegistrationCheck:
    """Two motions of one cloud to the one before it.

    Parameters
    ----------
    pairs
        Views of the fixed and of the moving cloud.
    rotation_deg
        Angle between the rotation that registration finds and that of the poses.
    shift_um
        Distance between the two places of the moving cloud's centre.
    registration_rmse_um, poses_rmse_um
        RMS distance of the moved points to the nearest fixed one (Eq. 7) by either motion. Registration makes this
        small by itself, so that the smaller number is not the better motion.
    """

    pairs: tuple[tuple[int, int], tuple[int, int]]
    rotation_deg: float
    shift_um: float
    registration_rmse_um: float
    poses_rmse_um: float

    @property
    def reported(self) -> dict[str, Any]:
        """As a report has it."""
        return {
            "views": [list(pair) for pair in self.pairs],
            "rotation_deg": self.rotation_deg,
            "shift_um": self.shift_um,
            "registration_rmse_um": self.registration_rmse_um,
            "poses_rmse_um": self.poses_rmse_um,
        }


def compare_with_registration(
    clouds: Sequence[PairCloud],
    poses: Poses,
    optics: Optics,
    method: Callable[[PointCloud, PointCloud], Registration] = QUICK_ICP,
    *,
    most: int = MOST,
) -> tuple[RegistrationCheck, ...]:
    """Register each cloud to the one before it, and hold the motion against that of the poses.

    Parameters
    ----------
    clouds
        Of adjacent pairs, in order; those of fewer than three finite points take no part.
    poses
        Of all views.
    method
        Called as ``method(moving, fixed)``.
    most
        Points of a cloud that take part, evenly picked.

    Returns
    -------
    One for each two clouds that follow each other.
    """
    usable = [kept for kept in (_finite(one) for one in clouds) if len(kept.cloud) >= LEAST]
    thinned = [_thinned(one, most) for one in usable]
    return tuple(_check(fixed, moving, poses, optics, method) for fixed, moving in pairwise(thinned))


def _check(
    fixed: PairCloud,
    moving: PairCloud,
    poses: Poses,
    optics: Optics,
    method: Callable[[PointCloud, PointCloud], Registration],
) -> RegistrationCheck:
    expected = world_from_cloud(fixed, poses, optics).inverse @ world_from_cloud(moving, poses, optics)
    found = method(moving.cloud, fixed.cloud).fixed_from_moving
    centre = moving.cloud.xyz_um.mean(axis=0)
    return RegistrationCheck(
        (fixed.pair, moving.pair),
        float(np.rad2deg(rotation_angle_rad(found.rotation @ expected.rotation.T))),
        float(np.linalg.norm(found.apply(centre) - expected.apply(centre))),
        _rmse_um(found, moving, fixed),
        _rmse_um(expected, moving, fixed),
    )


def world_from_cloud(one: PairCloud, poses: Poses, optics: Optics) -> RigidMotion:
    """Motion from the frame of a pair's cloud to the world, its depth offset taken from the same matches by the poses.

    Parameters
    ----------
    one
        Cloud in the view frame of the first view of its pair, finite.
    """
    both = list(one.pair)
    pair = Poses(poses.rotations[both], poses.translations_um[both])
    world = triangulate(Tracks(np.stack([one.cloud.xy_px, one.xy2_px], axis=1)), pair, optics).xyz_um
    turn, shift = view_from_world(pair.rotations[0]), CAM_FROM_VIEW @ pair.translations_um[0]
    depth = float(np.nanmedian((world @ turn.T + shift)[:, 2] - one.cloud.xyz_um[:, 2]))
    return RigidMotion(turn.T, turn.T @ (np.array([0.0, 0.0, depth]) - shift))


def _rmse_um(motion: RigidMotion, moving: PairCloud, fixed: PairCloud) -> float:
    return float(np.sqrt(np.mean(distances_um(motion.apply(moving.cloud.xyz_um), fixed.cloud.xyz_um) ** 2)))


def _finite(one: PairCloud) -> PairCloud:
    return _kept(one, np.flatnonzero(np.isfinite(one.cloud.xyz_um).all(axis=1)))


def _thinned(one: PairCloud, most: int) -> PairCloud:
    return _kept(one, np.unique(np.linspace(0, len(one.cloud) - 1, min(most, len(one.cloud))).astype(np.intp)))


def _kept(one: PairCloud, rows: NDArray[np.intp]) -> PairCloud:
    return PairCloud(one.pair, one.cloud.keep(rows), one.xy2_px[rows])
