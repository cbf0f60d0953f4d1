"""Affine structure and motion from tracks with missing sightings: rank three, whatever the cameras.

Tomasi & Kanade (1992) factor the table of all positions, less their means, into cameras and points by its first three
singular values; that takes a full table. With gaps it becomes weighted low-rank approximation: a full part of the
table, a pair of views, is factored, the other views are added by linear resection on its points, and damped Wiberg
steps (`parallel_bundle`) lead from there to the least squares over all sightings.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from semrecon.data import Array, Tracks
from semrecon.errors import MethodError
from semrecon.uncalibrated.affine_cameras import AffineCameras, intersect, weights_of
from semrecon.uncalibrated.parallel_bundle import Adjusted, FreeCameras, adjust

LEAST = 8
"""Points that a view must share with those before it; four determine a camera."""


def factorize(tracks: Tracks, reference: int = 0, *, sigmas: float = 3.5) -> Adjusted[FreeCameras]:
    """Factor tracks into affine cameras and points.

    Parameters
    ----------
    tracks
        Positions in px, NaN where missing.
    reference
        View whose camera becomes ``[1 0 0; 0 1 0]`` with offset 0; the frame is affine, of unknown third axis.

    Raises
    ------
    MethodError
        A view shares too few points with two others.
    """
    start = in_frame_of(first_cameras(tracks), reference)
    return adjust(tracks, FreeCameras(start, reference), sigmas=sigmas)


def first_cameras(tracks: Tracks) -> AffineCameras:
    """Cameras from the pair of most parallax, then view by view from the points that are known already."""
    xy, seen = tracks.xy_px, weights_of(tracks) > 0
    views = xy.shape[1]
    pair = max(combinations(range(views), 2), key=lambda one: _parallax(xy[seen[:, one[0]] & seen[:, one[1]]][:, one]))
    matrices, offsets = np.zeros((views, 2, 3)), np.zeros((views, 2))
    rows, middle = _factored(xy[seen[:, pair[0]] & seen[:, pair[1]]][:, pair])
    matrices[list(pair)], offsets[list(pair)] = rows, middle
    known = list(pair)
    while len(known) < views:
        weights = np.where(np.isin(np.arange(views), known), seen, 0.0)
        points, ranks = intersect(xy, weights, AffineCameras(matrices, offsets))
        shared = {v: seen[:, v] & (ranks == 3) for v in range(views) if v not in known}
        best = max(shared, key=lambda v: int(shared[v].sum()))
        if shared[best].sum() < LEAST:
            raise MethodError(
                f"view {best} shares {int(shared[best].sum())} points with two others; {LEAST} are needed to place it "
                "without known tilts: smaller tilt steps or more views would help"
            )
        matrices[best], offsets[best] = _resected(points[shared[best]], xy[shared[best], best])
        known.append(best)
    return AffineCameras(matrices, offsets)


def in_frame_of(cameras: AffineCameras, reference: int) -> AffineCameras:
    """Change the affine frame so that the reference camera drops the third coordinate and has no offset."""
    rows = cameras.matrices[reference]
    across = np.cross(rows[0], rows[1])
    frame = np.linalg.inv(np.vstack([rows, across / np.sqrt(np.linalg.norm(across))]))
    shift = frame[:, :2] @ cameras.offsets[reference]
    matrices = cameras.matrices @ frame
    matrices[reference] = np.eye(2, 3)
    offsets = cameras.offsets - cameras.matrices @ shift
    offsets[reference] = 0.0
    depth = np.delete(np.linalg.norm(matrices[:, :, 2], axis=1), reference).max()
    if depth > 0:  # the third axis has no unit of its own: let it move no image by more than the others do
        matrices[:, :, 2] /= depth
    return AffineCameras(matrices, offsets)


def _parallax(xy_px: Array) -> float:
    """Third singular value of the positions in two views (n, 2, 2): how much they say beyond a plane's affine map."""
    if len(xy_px) < LEAST:
        return 0.0
    table = (xy_px - xy_px.mean(axis=0)).reshape(len(xy_px), -1)
    return float(np.linalg.svd(table, compute_uv=False)[2])


def _factored(xy_px: Array) -> tuple[Array, Array]:
    """Factor a full table (n, views, 2): matrices (views, 2, 3) and offsets (views, 2), Tomasi & Kanade 1992."""
    if len(xy_px) < LEAST:
        raise MethodError(f"no two views share {LEAST} points; images with more contrast or smaller steps would help")
    middle = xy_px.mean(axis=0)
    _, values, axes = np.linalg.svd((xy_px - middle).reshape(len(xy_px), -1), full_matrices=False)
    rows = (axes[:3].T * (values[:3] / np.sqrt(len(xy_px)))).reshape(-1, 2, 3)
    return rows, middle


def _resected(points: Array, xy_px: Array) -> tuple[Array, Array]:
    """Affine camera from points (n, 3) and their positions (n, 2), by reweighted least squares."""
    design = np.column_stack([points, np.ones(len(points))])
    weights = np.ones(len(points))
    for _ in range(10):
        solved = np.linalg.lstsq(design * weights[:, None], xy_px * weights[:, None], rcond=None)[0]
        lengths = np.linalg.norm(xy_px - design @ solved, axis=1)
        scale = max(float(np.median(lengths)), 1e-9)
        weights = 1 / np.sqrt(1 + (lengths / (2 * scale)) ** 2)
    return np.asarray(solved[:3].T), np.asarray(solved[3])
