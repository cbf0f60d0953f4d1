"""From affine to metric: the cameras must be rotations with a magnification, and that fixes the affine frame.

In the frame of the reference camera (first two coordinates are its image) all that is unknown is how the third axis of
the metric frame lies: ``T = [[1, 0, 0], [0, 1, 0], [q1, q2, l]]``. The rows of ``P_v T`` must be orthogonal and of
equal length (scaled orthographic, Poelman & Kanade 1997), which is linear in q1, q2 and ``q3 = q1^2 + q2^2 + l^2``.

Two views leave a one-parameter family (bas-relief, Koenderink & van Doorn 1991). Three suffice, also for tilts about
one axis: each view then adds ``a^2 + 2 a b mu + b^2 q3 = 1`` along the parallax, and two such equations have one
solution. What decides is how well, for small tilts it is of second order in them: so the linear solution is only one
start of several for the bundle adjustment, and what it answers comes with a standard deviation. The sign of l, and so
of the relief, no image tells (Necker).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semrecon.data import Array, Tracks
from semrecon.errors import MethodError
from semrecon.uncalibrated.affine_cameras import AffineCameras, loss, weights_of
from semrecon.uncalibrated.parallel_bundle import Adjusted, FreeCameras, TurnedCameras, adjust, minimise

START_TILTS_DEG = (6.0, 30.0)
"""Largest tilts that the other starts assume: the relief then follows from the parallax."""
START_ROUNDS = 8
START_TRACKS = 1000
"""Tracks of three views or more that choose between the starts."""
MIRROR = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Tilts:
    """Rotations of a series as a stage would name them.

    Parameters
    ----------
    tilts_deg
        Angle between the beams of each view and the reference view, signed by the common axis, (views,).
    axis_deg
        Direction of that axis in the reference view, as `TiltSeries.tilt_axis_deg` counts, in (-45, 135].
    off_axis_deg
        How far the beam of each view lies off the plane at right angles to that axis, (views,).
    sigma_deg
        Standard deviation of each tilt, (views,).
    depth_sigma
        Relative standard deviation of all heights, as the wrong angle would scale them.
    """

    tilts_deg: Array
    axis_deg: float
    off_axis_deg: Array
    sigma_deg: Array
    depth_sigma: float


def linear_upgrade(cameras: AffineCameras, reference: int, *, scaled: bool = True) -> Array:
    """Solve the metric constraints by linear least squares: (q1, q2, q3).

    Parameters
    ----------
    cameras
        In the frame of the reference camera.
    scaled
        Ask for rows of equal length, instead of length one.

    Raises
    ------
    MethodError
        With fewer than three views.
    """
    if len(cameras) < 3:
        raise MethodError(
            "two views do not tell the scale of heights (bas-relief ambiguity); without tilts three are needed"
        )
    left, right = [], []
    for v in range(len(cameras)):
        if v == reference:
            continue
        a, b = cameras.matrices[v, :, :2], cameras.matrices[v, :, 2]
        plain = a @ a.T
        # coefficients of q1, q2, q3 in each entry of P Q P^T
        entries = {
            (i, j): np.array([a[i, 0] * b[j] + b[i] * a[j, 0], a[i, 1] * b[j] + b[i] * a[j, 1], b[i] * b[j]])
            for i, j in ((0, 0), (1, 1), (0, 1))
        }
        left.append(entries[0, 1])
        right.append(-plain[0, 1])
        if scaled:
            left.append((entries[0, 0] - entries[1, 1]) / 2)
            right.append((plain[1, 1] - plain[0, 0]) / 2)
        else:
            left += [entries[0, 0] / 2, entries[1, 1] / 2]
            right += [(1 - plain[0, 0]) / 2, (1 - plain[1, 1]) / 2]
    return np.asarray(np.linalg.lstsq(np.array(left), np.array(right), rcond=1e-12)[0])


def turned(cameras: AffineCameras, q1: float, q2: float, depth: float, reference: int, scaled: bool) -> TurnedCameras:
    """Take the nearest rotations with a magnification in the metric frame ``T = [[1,0,0],[0,1,0],[q1,q2,depth]]``."""
    frame = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [q1, q2, depth]])
    u, values, vt = np.linalg.svd(cameras.matrices @ frame, full_matrices=False)
    rows = u @ vt
    rotations = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], axis=1)
    rotations[reference] = np.eye(3)
    scales = np.log(values.mean(axis=1)) if scaled else np.zeros(len(cameras))
    scales[reference] = 0.0
    return TurnedCameras(rotations, scales, cameras.offsets, reference, scaled)


def upgrade(
    tracks: Tracks, affine: Adjusted[FreeCameras], *, scaled: bool = True, sigmas: float = 3.5
) -> Adjusted[TurnedCameras]:
    """Find the metric cameras and points that explain the tracks best, starting from affine ones.

    The linear solution, made positive where it is not, and a few fixed reliefs are stepped towards the least squares;
    the best of them is then adjusted with all tracks.

    Raises
    ------
    MethodError
        With fewer than three views, or hardly any tracks.
    """
    reference = affine.model.reference
    long = np.flatnonzero(affine.inliers & (tracks.seen.sum(axis=1) > 2))
    few = Tracks(tracks.xy_px[long[:: max(1, len(long) // START_TRACKS)]])
    weights = weights_of(few)
    starts = _starts(affine.model.cameras, reference, scaled)
    tried = [minimise(few.xy_px, weights, start, rounds=START_ROUNDS) for start in starts]
    losses = [loss(few.xy_px, weights, one.cameras) for one in tried]
    return adjust(tracks, tried[int(np.argmin(losses))], sigmas=sigmas)


def _starts(cameras: AffineCameras, reference: int, scaled: bool) -> list[TurnedCameras]:
    """Metric cameras from the linear solutions and from fixed largest tilts."""
    found = []
    for constraints in sorted({scaled, True}):
        q1, q2, q3 = linear_upgrade(cameras, reference, scaled=constraints)
        if q3 > q1**2 + q2**2:
            found.append((q1, q2, float(np.sqrt(q3 - q1**2 - q2**2))))
    parallax = np.linalg.norm(cameras.matrices[:, :, 2], axis=1).max()
    found += [(0.0, 0.0, float(np.sin(np.deg2rad(tilt)) / parallax)) for tilt in START_TILTS_DEG]
    return [turned(cameras, *one, reference, scaled) for one in found]


def mirrored(adjusted: Adjusted[TurnedCameras]) -> Adjusted[TurnedCameras]:
    """Turn the relief inside out: the images stay the same (Necker reversal)."""
    model = replace(adjusted.model, rotations=MIRROR @ adjusted.model.rotations @ MIRROR)
    signs = np.tile(np.append([-1.0, -1.0, 1.0], np.ones(model.local - 3)), len(model.rotations) - 1)
    covariance = adjusted.covariance * np.outer(signs, signs)
    return replace(adjusted, model=model, points=adjusted.points @ MIRROR, covariance=covariance)


def with_sign(adjusted: Adjusted[TurnedCameras]) -> Adjusted[TurnedCameras]:
    """Choose the sign of the relief by convention.

    The last view in order whose tilt is at least half of the largest counts as tilted in the positive sense.
    """
    tilts = tilts_of(adjusted).tilts_deg
    far = np.flatnonzero(np.abs(tilts) >= 0.5 * np.abs(tilts).max())
    return adjusted if tilts[far[-1]] >= 0 else mirrored(adjusted)


def tilts_of(adjusted: Adjusted[TurnedCameras]) -> Tilts:
    """Name the rotations by a common axis in the image plane of the reference view."""
    model = adjusted.model
    # beams in view axes (y up, z to the gun) of the reference view: (-sin t cos phi, sin t sin phi, cos t)
    beams = model.rotations[:, 2] * np.array([-1.0, 1.0, 1.0])
    direction = np.linalg.svd(beams[:, :2])[2][0]
    axis = -float(np.rad2deg(np.arctan2(direction[1], direction[0])))
    if not -45 < axis <= 135:
        axis += 180 if axis <= -45 else -180
    along = np.array([np.cos(np.deg2rad(axis)), -np.sin(np.deg2rad(axis))])
    tilts = np.rad2deg(np.arctan2(-beams[:, :2] @ along, beams[:, 2]))
    off = np.rad2deg(np.arcsin(np.clip(beams[:, :2] @ [-along[1], along[0]], -1, 1)))
    sigma = _tilt_sigma_deg(adjusted)
    far = int(np.argmax(np.abs(tilts)))
    slope = np.tan(np.deg2rad(min(abs(float(tilts[far])), 89.0)))
    depth_sigma = float(np.deg2rad(sigma[far]) / slope) if slope > 0 else np.inf
    return Tilts(tilts, axis, off, sigma, depth_sigma)


def _tilt_sigma_deg(adjusted: Adjusted[TurnedCameras]) -> Array:
    """Propagate the covariance to the angle between each beam and the reference beam, (views,)."""
    model = adjusted.model
    sigma = np.zeros(len(model.rotations))
    others = [v for v in range(len(sigma)) if v != model.reference]
    for k, v in enumerate(others):
        # the beam of view v in its own axes is e_z; a turn w moves the reference beam there by w x R e_z
        seen = model.rotations[v, :, 2]
        flat = np.hypot(seen[0], seen[1])
        if flat > 0:
            gradient = np.array([-seen[1], seen[0], 0.0]) / flat
            start = k * model.local
            sigma[v] = np.sqrt(gradient @ adjusted.covariance[start : start + 3, start : start + 3] @ gradient)
    return np.rad2deg(sigma)
