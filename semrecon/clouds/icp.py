"""Iterative closest point (ICP) by the rules of MATLAB's ``pcregistericp``, the seed's choice (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semrecon.data import Array, PointCloud
from semrecon.errors import InputError
from semrecon.numerics.motion import RigidMotion, fit_motion, rotation_angle_rad
from semrecon.numerics.neighbours import NearestNeighbours, distances_um


@dataclass(frozen=True)
class PcregistericpStop:
    """When ``pcregistericp`` stops; the defaults are the seed's ``'MaxIterations', 10000, 'Tolerance', [1e-5, 1e-3]``.

    Parameters
    ----------
    max_iterations
        Most iterations.
    tolerance
        Largest mean step of the translation, in units of the cloud (um), and of the rotation in degrees. The rotation
        step is counted as that function counts it: the arccos of the product of two quaternions, which is *half* the
        angle between the two rotations.
    """

    max_iterations: int = 10_000
    tolerance: tuple[float, float] = (1e-5, 1e-3)

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations must be at least 1, not {self.max_iterations}")

    def reached(self, steps: Sequence[tuple[float, float]]) -> bool:
        """Tell whether the mean over the last three steps (over all, where there are fewer) is within both tolerances.

        Parameters
        ----------
        steps
            Of every iteration so far: translation step in um and half rotation step in degrees (`step`).
        """
        mean = np.mean(steps[-3:], axis=0)
        return bool(mean[0] <= self.tolerance[0] and mean[1] <= self.tolerance[1])


@dataclass(frozen=True)
class Registration:
    """Answer of a registration: ``X_fixed = rotation @ X_moving + translation``.

    Parameters
    ----------
    rotation, translation_um
        fixed_from_moving, (3, 3) and (3,).
    rmse_um
        RMS distance of every moved point to its nearest fixed point (Eq. 7, moving to fixed).
    iterations
        How many were run; None where the library does not say.
    converged
        Whether the stopping rule was met before the iterations ran out; None where the library does not say.
    method
        What registered.
    history_um
        RMS distance of every moved point to its pair before the first step and after each of them; empty where the
        library does not say.
    """

    rotation: Array
    translation_um: Array
    rmse_um: float
    iterations: int | None
    converged: bool | None
    method: str
    history_um: tuple[float, ...] = ()

    @property
    def fixed_from_moving(self) -> RigidMotion:
        """The motion, ready to be applied or chained."""
        return RigidMotion(self.rotation, self.translation_um)


def step(new: RigidMotion, old: RigidMotion) -> tuple[float, float]:
    """Length of the translation step (um) and half the angle of the rotation step (degrees) between two motions."""
    half_angle_deg = np.rad2deg(rotation_angle_rad(new.rotation @ old.rotation.T)) / 2
    return float(np.linalg.norm(new.translation_um - old.translation_um)), float(half_angle_deg)


def icp(
    moving: PointCloud | Array,
    fixed: PointCloud | Array,
    stop: PcregistericpStop = PcregistericpStop(),
    initial: RigidMotion | None = None,
) -> Registration:
    """Register by point-to-point ICP as ``pcregistericp`` does by default: every moving point keeps its pair.

    Parameters
    ----------
    moving, fixed
        Clouds, or (points, 3) arrays in um.
    stop
        When to stop.
    initial
        First guess of fixed_from_moving; the identity if None, as in the seed.

    Returns
    -------
    Deterministic: the same clouds give the same bits.

    Raises
    ------
    InputError
        If a cloud has fewer than three points, or points that are not finite.

    Notes
    -----
    Besl and McKay (1992). Each motion is fitted from the original moving points, so rounding does not pile up. The
    `rmse_um` pairs the points anew after the last step; ``pcregistericp`` prints the last pairing's, never smaller.
    """
    start, target = cloud_positions(moving, "moving"), cloud_positions(fixed, "fixed")
    nearest = NearestNeighbours(target)
    motion = initial or RigidMotion.identity()
    steps: list[tuple[float, float]] = []
    history: list[float] = []
    converged = False
    while not converged and len(steps) < stop.max_iterations:
        previous, moved = motion, motion.apply(start)
        pairs = target[nearest(moved)]
        history.append(float(np.sqrt(np.mean(((moved - pairs) ** 2).sum(axis=1)))))
        motion = fit_motion(start, pairs)
        steps.append(step(motion, previous))
        converged = stop.reached(steps)
    found = answer(motion, start, target, len(steps), converged, "icp")
    return replace(found, history_um=(*history, found.rmse_um))


def cloud_positions(cloud: PointCloud | Array, role: str) -> Array:
    """Positions of a cloud as contiguous float64; raise `InputError` where ICP cannot work with them."""
    xyz = cloud.xyz_um if isinstance(cloud, PointCloud) else cloud
    xyz = np.ascontiguousarray(xyz, dtype=np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(f"the {role} cloud must be of shape (points, 3), not {xyz.shape}")
    if len(xyz) < 3:
        raise InputError(f"the {role} cloud has {len(xyz)} points; registration needs at least three")
    bad = int((~np.isfinite(xyz)).any(axis=1).sum())
    if bad:
        raise InputError(f"the {role} cloud has {bad} of {len(xyz)} points that are not finite; leave them out first")
    return xyz


def answer(
    motion: RigidMotion, moving: Array, fixed: Array, iterations: int | None, converged: bool | None, method: str
) -> Registration:
    """Registration by a motion found, with its RMSE over all moving points."""
    rmse_um = float(np.sqrt(np.mean(distances_um(motion.apply(moving), fixed) ** 2)))
    return Registration(motion.rotation, motion.translation_um, rmse_um, iterations, converged, method)
