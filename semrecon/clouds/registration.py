"""Registration of point clouds: one interface to every ICP, and sequences of clouds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from semrecon.clouds.icp import PcregistericpStop, Registration, icp
from semrecon.clouds.open3d_icp import Open3dKind, icp_open3d
from semrecon.data import PointCloud
from semrecon.errors import InputError
from semrecon.numerics.motion import RigidMotion

__all__ = [
    "Open3dKind",
    "PcregistericpStop",
    "Registration",
    "RigidMotion",
    "SequenceRegistration",
    "icp",
    "icp_open3d",
    "register_sequence",
]


@dataclass(frozen=True)
class SequenceRegistration:
    """Clouds of a series brought into the frame of the first.

    Parameters
    ----------
    pairs
        Registration of every cloud but the first (moving) to the one before it (fixed), clouds - 1 of them.
    first_from_each
        Motion of every cloud into the frame of the first, the identity for the first itself.
    merged
        All points in the frame of the first cloud, in order; `xy_px` is kept for the first cloud only.
    """

    pairs: tuple[Registration, ...]
    first_from_each: tuple[RigidMotion, ...]
    merged: PointCloud

    @property
    def rmse_um(self) -> float:
        """Mean of the pairs' RMSE, as the seed averages them (section 5.1.1); NaN for a single cloud."""
        return float(np.mean([pair.rmse_um for pair in self.pairs])) if self.pairs else float("nan")


def register_sequence(
    clouds: Sequence[PointCloud], method: Callable[[PointCloud, PointCloud], Registration] = icp
) -> SequenceRegistration:
    """Register each cloud to its predecessor and chain the motions.

    Parameters
    ----------
    clouds
        In order, each in its own frame.
    method
        Called as ``method(moving, fixed)``; `functools.partial` fixes the options.

    Raises
    ------
    InputError
        If there is no cloud.
    """
    if not clouds:
        raise InputError("a sequence to register needs at least one point cloud")
    pairs = tuple(method(moving, fixed) for fixed, moving in pairwise(clouds))
    chain = [RigidMotion.identity()]
    for pair in pairs:
        chain.append(chain[-1] @ pair.fixed_from_moving)
    moved = [clouds[0], *(motion.carry(cloud) for motion, cloud in zip(chain[1:], clouds[1:], strict=True))]
    return SequenceRegistration(pairs, tuple(chain), _merge(moved))


def _merge(clouds: Sequence[PointCloud]) -> PointCloud:
    return PointCloud(
        np.concatenate([cloud.xyz_um for cloud in clouds]),
        np.concatenate([cloud.covariance_um2 for cloud in clouds]),
        np.concatenate([cloud.residual_px for cloud in clouds]),
        np.concatenate([cloud.xy_px for cloud in clouds]),
    )
