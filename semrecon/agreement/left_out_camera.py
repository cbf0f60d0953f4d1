"""Where a view sees a surface whose heights stand on another view's grid.

The rotation is given; what nobody states of a view, its shift, is fitted to its picture, in the same way whichever
method made the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.agreement.left_out_windows import smoothed
from semrecon.agreement.resampling import draw_grid
from semrecon.data import Array, Mask, Optics
from semrecon.errors import MethodError
from semrecon.geometry import back_project, project

Indices = NDArray[np.intp]
Free = Literal["shift", "similarity"]
"""What is fitted in the image plane: the shift alone, or magnification and rotation as well."""
COARSE_PX = 256
"""Longer side of the pictures on which the shift is looked for first."""
LEAST_OVERLAP, LEAST_DRAWN = 0.3, 0.03
"""Share of the smaller picture that must overlap, and share of the frame to be known for the shift to be looked for."""
BLURS_PX = (6.0, 3.0, 1.5, 0.8)
"""Blurs of both pictures, from coarse to fine, as the shift is refined; the last keeps noise from locking to pixels."""
WINDOW_PX, WINDOW_BLURS = 4.0, 3.0
"""Brightness is evened out over a Gaussian window of so many pixels, or so many blurs where that is more.

Small, because light and dark of large forms travel with the tilt while texture stays where it is: on a simulated sphere
a window of 8 px draws the shift by 0.18 px to that of the bright rim, one of 4 px by 0.09.
"""
MOST_ASKED = 150_000
ROUNDS, SMALL_STEP_PX = 15, 2e-3
TAIL = 2.4
"""Residuals of so many robust deviations weigh half."""
BEHIND_PX = 1.5
"""A surface hides what lies by more than this behind it, beside what its slope brings about within a pixel."""
TURNED = 0.2
"""A patch that a view sees at less than this share of its area in the reference view is turned away."""


@dataclass(frozen=True)
class Sight:
    """What a view sees of a surface, before its shift is known; both on the grid of the reference view.

    Parameters
    ----------
    xy_px
        Where the view sees each pixel, (rows, columns, 2); NaN where there is no height.
    elevation_px
        Height along the view's own beam, (rows, columns).
    flat
        How the view draws a level surface, (2, 2).
    """

    xy_px: Array
    elevation_px: Array
    flat: Array


@dataclass(frozen=True)
class InPlane:
    """Motion of a picture in its plane, about the image centre: ``xy -> centre + linear (xy - centre) + shift``."""

    shift_px: Array = field(default_factory=lambda: np.zeros(2))
    linear: Array = field(default_factory=lambda: np.eye(2))

    @property
    def magnification(self) -> float:
        """Relative to the reference view."""
        return float(np.sqrt(np.linalg.det(self.linear)))

    @property
    def rotation_deg(self) -> float:
        """Clockwise as seen (columns to rows)."""
        return float(np.rad2deg(np.arctan2(self.linear[1, 0], self.linear[0, 0])))

    def apply(self, xy_px: Array, centre_px: Array) -> Array:
        """Move positions, (..., 2)."""
        return np.asarray(centre_px + (xy_px - centre_px) @ self.linear.T + self.shift_px)


def sight_of(z_um: Array, relative: Array, optics: Optics) -> Sight:
    """Project heights on the grid of the reference view into another.

    Parameters
    ----------
    z_um
        (rows, columns), along the beam of the reference view; NaN where there is none.
    relative
        R_view_from_reference of the cameras, (3, 3).
    """
    rows, columns = np.indices(z_um.shape, dtype=np.float64)
    xyz = back_project(np.stack([columns, rows], axis=-1), -z_um, np.eye(3), np.zeros(3), optics)
    xy_px = project(xyz, relative, np.zeros(3), optics)
    return Sight(xy_px, -(xyz @ relative[2]) / optics.pixel_size_um, relative[:2, :2])


def visible(xy_px: Array, elevation_px: Array) -> Mask:
    """Tell which pixels of the reference grid a view sees: inside its frame, turned to it and not hidden.

    Parameters
    ----------
    xy_px, elevation_px
        As in `Sight`, with the shift of the view applied.
    """
    shape = elevation_px.shape
    column, row = np.moveaxis(np.rint(np.where(np.isfinite(xy_px), xy_px, -1.0)), -1, 0)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    front = draw_grid(xy_px, elevation_px[..., None], shape)[0]
    i, j = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
    across, down = _slope(xy_px, 1), _slope(xy_px, 0)
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    steep = np.fmax(np.abs(_slope(elevation_px, 1)), np.abs(_slope(elevation_px, 0)))
    hidden = front[i, j] - elevation_px > BEHIND_PX + np.nan_to_num(steep)
    return np.asarray(inside & ~hidden & ~(area <= TURNED))


@dataclass(frozen=True)
class Paint:
    """Grey values on a surface, on the grid of the reference view.

    Parameters
    ----------
    grey, known
        Values and where there are any, (rows, columns).
    """

    grey: Array
    known: Mask


@dataclass(frozen=True)
class Target:
    """A painted surface ready for fitting several views to it: also evened at every blur of `BLURS_PX`."""

    paint: Paint
    levels: tuple[Array, ...]


def target_of(paint: Paint) -> Target:
    """Even a painted surface at every blur."""
    return Target(paint, tuple(evened(paint, blur_px) for blur_px in BLURS_PX))


def fit_in_plane(target: Target, picture: Paint, sight: Sight, free: Free) -> InPlane:
    """Fit the motion in the plane by which a picture agrees best with a painted surface.

    Coarse to fine Gauss-Newton on locally evened pictures. Gradients are those of the painted surface, whose noise has
    nothing to do with the picture's: those of the picture itself would bias the shift.

    Parameters
    ----------
    target
        The surface.
    picture
        The view, on its own grid.

    Raises
    ------
    MethodError
        Nothing of the surface is painted.
    """
    asked = np.flatnonzero(target.paint.known.ravel() & np.isfinite(sight.xy_px).all(axis=-1).ravel())
    if asked.size == 0:
        raise MethodError("the surface has no height where the views used have a picture; nothing can be predicted")
    asked = np.asarray(asked[:: max(1, asked.size // MOST_ASKED)])
    found = InPlane(_coarse_shift(target.paint, picture, sight.xy_px))
    for level, blur_px in zip(target.levels, BLURS_PX, strict=True):
        found = _refined(found, level, picture, sight, asked, blur_px, free)
    return found


def _refined(
    found: InPlane, target: Array, picture: Paint, sight: Sight, asked: Indices, blur_px: float, free: Free
) -> InPlane:
    """Fit at one blur, with the pixels `asked` (n,)."""
    down, across = (part.ravel()[asked] for part in np.gradient(target))
    slope = np.stack([across, down], axis=1) @ np.linalg.inv(sight.flat)
    coefficients = ndimage.spline_filter(evened(picture, blur_px), order=3, mode="mirror")
    centre = centre_of(picture.grey)
    from_centre = sight.xy_px.reshape(-1, 2)[asked] - centre
    for _ in range(ROUNDS):
        q = from_centre @ found.linear.T
        xy = centre + q + found.shift_px
        seen = _readable(xy, picture.known)
        sampled = ndimage.map_coordinates(coefficients, xy[seen].T[::-1], order=3, mode="mirror", prefilter=False)
        step = _step(target.ravel()[asked][seen], sampled, slope[seen], q[seen], free)
        size = float(np.abs(step[:2]).max())
        step *= min(1.0, 2 * blur_px / max(size, 1e-12))
        grow, turn = step[2:] if free == "similarity" else (0.0, 0.0)
        found = InPlane(
            found.shift_px + step[:2], _similar(np.array([[1 + grow, -turn], [turn, 1 + grow]]) @ found.linear)
        )
        if max(size, (abs(grow) + abs(turn)) * max(target.shape) / 10) < SMALL_STEP_PX:
            break
    return found


def _step(target: Array, sampled: Array, slope: Array, q: Array, free: Free) -> Array:
    """Solve one round of Gauss-Newton with Cauchy weights for shift, growth and turn, (2,) or (4,)."""
    likeness = np.clip(target @ sampled / max(float(target @ target), 1e-12), 0.2, 1.0)
    residual = target - sampled / likeness
    deviation = 1.4826 * float(np.median(np.abs(residual))) if residual.size else 1.0
    weight = 1 / (1 + (residual / max(TAIL * deviation, 1e-12)) ** 2)
    columns = [slope[:, 0], slope[:, 1]]
    if free == "similarity":
        columns += [(slope * q).sum(axis=1), slope[:, 1] * q[:, 0] - slope[:, 0] * q[:, 1]]
    design = np.stack(columns, axis=1)
    normal = design.T @ (weight[:, None] * design)
    return np.asarray(np.linalg.pinv(normal, hermitian=True) @ (design.T @ (weight * residual)))


def _similar(linear: Array) -> Array:
    """Make a matrix that nearly is one a magnification times a rotation."""
    c, s = (linear[0, 0] + linear[1, 1]) / 2, (linear[1, 0] - linear[0, 1]) / 2
    return np.array([[c, -s], [s, c]])


def evened(picture: Paint, blur_px: float) -> Array:
    """Blur a picture and bring its local mean to 0 and its local spread to 1; 0 where nothing is known."""
    window, known = max(WINDOW_PX, WINDOW_BLURS * blur_px), picture.known
    soft = smoothed(picture.grey, known, blur_px)
    soft = soft - smoothed(soft, known, window)
    spread = np.sqrt(smoothed(soft**2, known, window))
    least = 0.05 * float(np.median(spread[known])) if known.any() else 0.0
    return np.asarray(np.where(known, soft / np.maximum(spread, max(least, 1e-9)), 0.0))


def _readable(xy_px: Array, valid: Mask) -> Mask:
    """Tell positions (n, 2) inside the frame, on a pixel that is valid."""
    rows, columns = valid.shape
    x, y = xy_px[:, 0], xy_px[:, 1]
    inside = (x >= 1) & (y >= 1) & (x <= columns - 2) & (y <= rows - 2)
    column, row = (np.rint(np.where(inside, one, 0)).astype(np.int64) for one in (x, y))
    return np.asarray(inside & valid[row, column])


def _coarse_shift(paint: Paint, picture: Paint, xy_px: Array) -> Array:
    """Find the shift to a few pixels by masked cross correlation of small pictures, over all shifts, (2,) px."""
    from skimage.registration import phase_cross_correlation

    step = max(1, -(-max(picture.grey.shape) // COARSE_PX))
    small = _small(picture, step)
    moving = _drawn_small(paint, xy_px, step, small.grey.shape)
    if min(moving.known.mean(), small.known.mean()) < LEAST_DRAWN:
        return np.zeros(2)
    shift, _, _ = phase_cross_correlation(
        evened(small, 1.0),
        evened(moving, 1.0),
        reference_mask=small.known,
        moving_mask=moving.known,
        overlap_ratio=LEAST_OVERLAP,
    )
    return np.asarray(step * shift[::-1], dtype=np.float64)


def _drawn_small(paint: Paint, xy_px: Array, step: int, shape: tuple[int, ...]) -> Paint:
    """Draw the painted surface into a small picture of the view: the mean of what falls on each pixel."""
    known = paint.known & np.isfinite(xy_px).all(axis=-1)
    column, row = np.rint(xy_px[known] / step).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    place = (row[inside] * shape[1] + column[inside]).astype(np.int64)
    size = shape[0] * shape[1]
    count = np.bincount(place, minlength=size).reshape(shape)
    total = np.bincount(place, paint.grey[known][inside], minlength=size).reshape(shape)
    return Paint(total / np.maximum(count, 1), count > 0)


def _small(picture: Paint, step: int) -> Paint:
    """Thin out a blurred picture; pixel i of it stands on pixel ``step * i``."""
    soft = smoothed(picture.grey, picture.known, step / 2) if step > 1 else picture.grey
    return Paint(np.ascontiguousarray(soft[::step, ::step]), np.ascontiguousarray(picture.known[::step, ::step]))


def centre_of(image: Array) -> Array:
    """(column, row) of the middle of an image, (2,)."""
    return np.asarray((np.array(image.shape[::-1]) - 1) / 2)


def _slope(values: Array, axis: int) -> Array:
    """Mean of the differences to the neighbours on either side that are known; NaN where none is."""
    forward = np.diff(values, axis=axis, append=np.nan)
    backward = np.diff(values, axis=axis, prepend=np.nan)
    both = np.where(np.isnan(backward), forward, (forward + backward) / 2)
    return np.where(np.isnan(forward), backward, both)
