"""Points before a camera of short working distance, as tracks: what methods that need perspective are made for."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from semrecon.data import Array, Optics, Poses, TiltSeries, View
from semrecon.geometry import project, rotations_from_tilts
from semrecon.matches.correspondence import PairMatches
from semrecon.matches.matching import Matches

NEAR = Optics(0.5, 400, 300, 1 / 400)
TILTS = (0.0, 15.0, -15.0, 30.0)
SHIFTS_UM = np.array([[0.0, 0.0, 0.0], [5.0, -3.0, 8.0], [2.0, 4.0, -6.0], [0.0, 7.0, 3.0]])


def scattered(count: int = 300, seed: int = 0) -> Array:
    """Points in a box of 160 x 120 x 50 um."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)) * [80.0, 60.0, 25.0]


def blank_series(optics: Optics = NEAR, tilts_deg: tuple[float, ...] = TILTS) -> TiltSeries:
    """Views without a picture: matches come from elsewhere."""
    return TiltSeries(tuple(View(np.zeros(optics.shape), tilt) for tilt in tilts_deg), optics)


def true_poses(tilts_deg: tuple[float, ...] = TILTS) -> Poses:
    """Poses of the views."""
    return Poses(rotations_from_tilts(np.array(tilts_deg)), SHIFTS_UM[: len(tilts_deg)])


def seen(xyz_um: Array, poses: Poses, optics: Optics, noise_px: float, seed: int = 1) -> Array:
    """Sightings (points, views, 2) with noise."""
    both = zip(poses.rotations, poses.translations_um, strict=True)
    xy_px = np.stack([project(xyz_um, rotation, shift, optics) for rotation, shift in both], axis=1)
    return xy_px + np.random.default_rng(seed).normal(0, noise_px, xy_px.shape) if noise_px else xy_px


def matches_of(xy_px: Array) -> tuple[PairMatches, ...]:
    """All pairs of views, every point matched."""
    count, views = xy_px.shape[:2]
    index = np.arange(count)
    return tuple(
        PairMatches(
            (a, b),
            Matches(xy_px[:, a], xy_px[:, b], index, index, np.zeros(count)),
            count,
            (count, count),
            0,
            0,
            (0, 0),
        )
        for a, b in combinations(range(views), 2)
    )
