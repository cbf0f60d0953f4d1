"""A measured reflectance map: normals from what the detectors made of a body whose shape is known.

Ikeuchi (1981) photographs a ball of the same material under the same lamps and keeps, for each triple of brightness,
the normal that gave it; an unknown surface is then looked up. No law of emission is assumed: the lobe of backscattered
electrons, the true solid angles of the detectors and their gains are all in the table. Ikeuchi's objects have one
reflectance; we look up the *shares* of the channels in their sum, in which a yield that differs from place to place
cancels, and which make his triple a place in a plane (four channels: in a space; the normals are a sheet in it).
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from semrecon.data import Array, HeightMap, Mask, TiltSeries
from semrecon.errors import InputError
from semrecon.photometry.photometric import usable

STEEPEST_DEG = 75.0
"""Steeper than this no map is made: the pixel holds a range of normals there."""
STEP = 0.04
"""Edge of a cell of the map in the level parts of the unit normal."""
LEAST_PIXELS, LEAST_CELLS = 4, 100
"""Pixels that make a cell, and cells that make a map."""
NEIGHBOURS = 6
FARTHEST = 3.0
"""Signals farther from the map than so many typical distances of its cells show no normal that it knows."""


@dataclass(frozen=True)
class ReflectanceMap:
    """What each channel makes of a normal.

    Parameters
    ----------
    channels
        Names, in the order of `shares`.
    shares
        Each channel's share in the sum of all, (cells, channels).
    slopes
        dz/dx and dz/dy (y up) that go with them, (cells, 2).
    """

    channels: tuple[str, ...]
    shares: Array
    slopes: Array

    def __post_init__(self) -> None:
        count = len(self.channels)
        if count < 3 or self.shares.shape != (len(self.slopes), count) or self.slopes.shape[1:] != (2,):
            raise InputError("a reflectance map needs the shares of three channels or more and two slopes a cell")
        if len(self.slopes) < LEAST_CELLS or not (np.isfinite(self.shares).all() and np.isfinite(self.slopes).all()):
            raise InputError(f"a reflectance map needs {LEAST_CELLS} cells of numbers, this one has {len(self.slopes)}")

    def save(self, path: Path) -> None:
        """Write a file that `load` reads."""
        with path.open("wb") as file:
            np.savez(file, channels=np.array(self.channels), shares=self.shares, slopes=self.slopes)

    def look_up(self, signals: Array, trusted: Mask) -> tuple[Array, Array]:
        """Find the slopes whose shares are nearest, between the nearest cells by inverse square distance.

        Parameters
        ----------
        signals
            Grey values over the black level, (channels, rows, columns), in the order of `channels`.
        trusted
            Where each may be used.

        Returns
        -------
        dz/dx and dz/dy (y up), (rows, columns); NaN where a channel is missing or the map knows no such signals.
        """
        total = signals.sum(axis=0)
        known = trusted.all(axis=0) & (total > 0)
        tree = cKDTree(self.shares)
        spacing = float(np.median(tree.query(self.shares, k=2)[0][:, 1]))
        found = np.full((2, *total.shape), np.nan)
        if known.any():
            away, which = tree.query((signals[:, known] / total[known]).T, k=NEIGHBOURS)
            weight = 1 / (away**2 + (0.5 * spacing) ** 2)
            mean = np.einsum("nk,nkj->jn", weight / weight.sum(axis=1, keepdims=True), self.slopes[which])
            found[:, known] = np.where(away[:, 0] <= FARTHEST * max(spacing, 1e-3), mean, np.nan)
        return found[0], found[1]


def measure(
    series: TiltSeries,
    heights: HeightMap,
    channels: tuple[str, ...] = (),
    black_level: float = 0.0,
    smooth_px: float = 1.0,
) -> ReflectanceMap:
    """Make a map from a picture of a body whose shape is known, such as a ball.

    Parameters
    ----------
    series
        Its reference view has the channels, recorded at the settings that will be used; all with a known direction, or
        those named.
    heights
        Of the body on the grid of that view (rows, columns) um; NaN where it is not known, as beside a ball, where the
        ball throws shadows.
    black_level, smooth_px
        Grey value of no electron; blur of signals and heights alike before slopes are taken, px.

    Raises
    ------
    InputError
        Sizes differ, fewer than three channels, or too few normals are shown.
    """
    view = series.views[series.reference]
    names = channels or tuple(name for name in view.channels if name in series.channel_geometry)
    if len(names) < 3 or any(name not in view.channels for name in names):
        raise InputError(f"a reflectance map needs three channels that the view has, not {', '.join(names) or 'none'}")
    if heights.z_um.shape != view.image.shape:
        raise InputError(f"the known heights are {heights.z_um.shape}, but the picture is {view.image.shape}")
    images = [view.channels[name] for name in names]
    known = np.isfinite(heights.z_um) & np.all([usable(image) for image in images], axis=0)
    signals = np.stack([_blurred(image.astype(np.float64) - black_level, known, smooth_px) for image in images])
    down, across = (
        np.asarray(one) for one in np.gradient(_blurred(heights.z_um, known, smooth_px), heights.pixel_size_um)
    )
    inner = ndimage.binary_erosion(known, iterations=1 + int(np.ceil(2 * smooth_px))) & (signals.sum(axis=0) > 0)
    inner = np.asarray(inner & (np.hypot(across, down) < np.tan(np.deg2rad(STEEPEST_DEG))))
    shown = signals[:, inner]
    return _in_cells(names, np.asarray(shown / shown.sum(axis=0)).T, across[inner], -down[inner])


def load(path: Path) -> ReflectanceMap:
    """Read a map; raises `InputError` with a sentence for a file that is none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            channels = tuple(str(name) for name in file["channels"])
            return ReflectanceMap(channels, file["shares"].astype(np.float64), file["slopes"].astype(np.float64))
    except FileNotFoundError as error:
        raise InputError(f"{path} is not there; name a file that ReflectanceMap.save wrote") from error
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{path} is no reflectance map; name a file that ReflectanceMap.save wrote") from error


def _in_cells(names: tuple[str, ...], shares: Array, slope_x: Array, slope_y: Array) -> ReflectanceMap:
    """Average the shares of like normals: cells even in the level parts of the unit normal."""
    upright = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    cell = np.rint(np.column_stack([slope_x, slope_y]) * upright[:, None] / STEP).astype(np.int64)
    _, index, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    index, full = index.ravel(), count >= LEAST_PIXELS

    def mean(values: Array) -> Array:
        total = np.asarray(np.bincount(index, values), dtype=np.float64)
        return np.asarray(total[full] / count[full])

    if full.sum() < LEAST_CELLS:
        raise InputError(f"the known body shows {int(full.sum())} normals, too few for a map; take a whole ball")
    table = np.column_stack([mean(share) for share in shares.T])
    return ReflectanceMap(names, table, np.column_stack([mean(slope_x), mean(slope_y)]))


def _blurred(values: Array, known: Mask, blur_px: float) -> Array:
    share = ndimage.gaussian_filter(known.astype(np.float64), blur_px)
    blurred = ndimage.gaussian_filter(np.where(known, values, 0.0), blur_px)
    return np.where(known, blurred / np.maximum(share, 1e-9), np.nan)
