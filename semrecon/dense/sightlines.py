"""Where each view sees a pixel of the reference view whose height is h.

With all lengths in pixels, the image centre as origin and k the inverse working distance (1/px)::

    s = 1 - k h,   X = (x s, y s, -h)            the point in the camera axes of the reference view
    (p, q, r) = M_v (X, 1)                        magnification and rotation in the plane are in the first two rows
    place = centre + (p, q) / (1 + k r)

Under parallel projection (k = 0) that is affine in x, y and h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from semrecon.data import Array, Optics, Poses


@dataclass(frozen=True)
class Sightlines:
    """Geometry of all views, seen from one of them.

    Parameters
    ----------
    matrices
        M_v, (views, 3, 4), lengths in px.
    centre_px
        (column, row) of the image centre.
    k
        Inverse working distance, 1/px.
    reference
        The view on whose grid heights stand.
    """

    matrices: Array
    centre_px: Array
    k: float
    reference: int

    def __len__(self) -> int:
        return len(self.matrices)

    def of(self, view: int) -> Array:
        """All that a kernel needs of one view: M row by row, centre and k, (15,)."""
        return np.array([*self.matrices[view].ravel(), *self.centre_px, self.k])

    def at_level(self, level: int) -> Sightlines:
        """Measure in pixels of a pyramid level, whose pixel i stands on pixel ``2**level * i``."""
        step = 2.0**level
        matrices = self.matrices.copy()
        matrices[:, :, 3] /= step
        return Sightlines(matrices, self.centre_px / step, self.k * step, self.reference)

    def parallax(self) -> Array:
        """How far each view's picture of the image centre moves per height, (views, 2), px a px."""
        x, y = self.centre_px
        return np.array([motion(self.of(view), x, y, 0.0) for view in range(len(self))])


def sightlines(poses: Poses, distortions: Array, optics: Optics, reference: int) -> Sightlines:
    """Geometry from aligned cameras.

    Parameters
    ----------
    poses
        Of the ideal cameras.
    distortions
        Magnification and rotation in the plane of each view, (views, 2, 2).
    """
    relative = poses.rotations @ poses.rotations[reference].T
    shifts = poses.translations_um - relative @ poses.translations_um[reference]
    matrices = np.concatenate([relative, shifts[:, :, None] / optics.pixel_size_um], axis=2)
    undo = np.linalg.inv(distortions[reference])
    matrices[:, :2] = distortions @ matrices[:, :2]
    matrices[:, :, :2] = matrices[:, :, :2] @ undo
    k = optics.inverse_working_distance * optics.pixel_size_um
    return Sightlines(matrices, optics.centre_px, k, reference)


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def place(g: Array, x: float, y: float, h: float) -> tuple[float, float]:
    """Where a view sees pixel (x, y) of the reference view at height h; `g` is `Sightlines.of`."""
    s = 1.0 - g[14] * h
    a, b = (x - g[12]) * s, (y - g[13]) * s
    w = 1.0 / (1.0 + g[14] * (g[8] * a + g[9] * b - g[10] * h + g[11]))
    return g[12] + (g[0] * a + g[1] * b - g[2] * h + g[3]) * w, g[13] + (g[4] * a + g[5] * b - g[6] * h + g[7]) * w


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def motion(g: Array, x: float, y: float, h: float) -> tuple[float, float]:
    """Differentiate `place` by the height."""
    s = 1.0 - g[14] * h
    a, b = (x - g[12]) * s, (y - g[13]) * s
    da, db = -g[14] * (x - g[12]), -g[14] * (y - g[13])
    w = 1.0 / (1.0 + g[14] * (g[8] * a + g[9] * b - g[10] * h + g[11]))
    dw = g[14] * (g[8] * da + g[9] * db - g[10])
    p, q = (g[0] * a + g[1] * b - g[2] * h + g[3]) * w, (g[4] * a + g[5] * b - g[6] * h + g[7]) * w
    return (g[0] * da + g[1] * db - g[2] - p * dw) * w, (g[4] * da + g[5] * db - g[6] - q * dw) * w


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def elevation(g: Array, x: float, y: float, h: float) -> float:
    """Height of the same point along the view's own beam."""
    s = 1.0 - g[14] * h
    return float(-(g[8] * (x - g[12]) * s + g[9] * (y - g[13]) * s - g[10] * h + g[11]))
