"""Epipolar lines of two views of known rotation: parallel, all in one direction.

Under parallel projection a point seen at m1 in the first view is seen in the second at

    m2 = A m1 + Z r + t,    A = R_rel[:2, :2],  r = R_rel[:2, 2],  R_rel = R_2 R_1^T  (camera axes),

from the image centre. Across r the place is known up to one constant of the pair; along r it tells the depth. (For a
tilt about the vertical axis: rows stay rows.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.data import Array
from semrecon.errors import MethodError


@dataclass(frozen=True)
class Window:
    """Where the second view may show a point, relative to its predicted place for zero depth and no shift, in px.

    Parameters
    ----------
    across
        Least and most offset across the epipolar direction.
    along
        Least and most offset along it: relief and shift together.
    """

    across: tuple[float, float] = (-np.inf, np.inf)
    along: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True)
class Epipolar:
    """Parallel epipolar lines of two views whose relative rotation is known.

    Parameters
    ----------
    linear
        A, (2, 2): pixels of the first view, from the centre, to those of the second at zero depth.
    basis
        Rows are the unit vectors across and along the lines in the second view, (2, 2).
    parallax
        Length of r: shift along the lines per unit of depth; the sine of the tilt between the views.
    centre_px
        Image centre (column, row).
    """

    linear: Array
    basis: Array
    parallax: float
    centre_px: Array

    def offsets_px(self, xy1_px: Array, xy2_px: Array) -> Array:
        """Offset of each pair from the place predicted for zero depth and no shift, (n, 2) as (across, along)."""
        return self.in_second(xy2_px) - self.from_first(xy1_px)

    def from_first(self, xy1_px: Array) -> Array:
        """Predicted places in the second view, (n, 2) as (across, along)."""
        return np.asarray((xy1_px - self.centre_px) @ (self.basis @ self.linear).T)

    def in_second(self, xy2_px: Array) -> Array:
        """Places in the second view, (n, 2) as (across, along)."""
        return np.asarray((xy2_px - self.centre_px) @ self.basis.T)


def epipolar_geometry(rotation1: Array, rotation2: Array, centre_px: Array) -> Epipolar:
    """Epipolar lines of two views from their known rotations R_cam_from_world, each (3, 3).

    Raises
    ------
    MethodError
        Where the views have the same direction, so that there is no parallax.
    """
    relative = rotation2 @ rotation1.T
    parallax = float(np.hypot(*relative[:2, 2]))
    if parallax < 1e-6:
        raise MethodError("two views have the same tilt, so that they have no parallax; leave one of them out")
    along = relative[:2, 2] / parallax
    basis = np.array([[-along[1], along[0]], along])
    return Epipolar(relative[:2, :2], basis, parallax, centre_px)
