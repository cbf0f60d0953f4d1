"""Rectification: two views resampled so that what one row shows, the same row of the other shows too.

Under parallel projection (`semrecon.matches.epipolar`) a point at m1 in the first view is at ``m2 = A m1 + Z r + t``
in the second. Let B be the turn that brings ``A^-1 r``, the direction of the epipolar lines in the first view, onto
the rows. Then ``left = B m1`` and ``right = B A^-1 m2`` differ by ``|A^-1 r| Z`` along the rows, and across them by
one constant of the pair, which matches tell and which is taken out. So the first view is only turned, not stretched,
and a flat specimen has one disparity. This is exact; nothing is left to search but the column.

Resampling is by cubic B-spline: the cubic interpolation of image libraries shifts by up to 0.03 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, View
from semrecon.matches.epipolar import Epipolar
from semrecon.matches.features import usable_pixels

Picture = NDArray[np.float32]


@dataclass(frozen=True)
class Rectification:
    """Where the pixels of two views go. A position is (column, row), an affine map a matrix (2, 3) on (x, y, 1).

    Parameters
    ----------
    left_from_first, right_from_second
        Maps of positions into the rectified frames.
    shape
        (rows, columns) of both rectified frames.
    depths_px
        Disparity, right less left column, for a depth of one pixel; negative depths are raised.
    """

    left_from_first: Array
    right_from_second: Array
    shape: tuple[int, int]
    depths_px: float

    def to_left(self, xy1_px: Array) -> Array:
        """Places of the first view in the left frame, (..., 2)."""
        return _mapped(self.left_from_first, xy1_px)

    def to_right(self, xy2_px: Array) -> Array:
        """Places of the second view in the right frame, (..., 2)."""
        return _mapped(self.right_from_second, xy2_px)

    def to_second(self, right_px: Array) -> Array:
        """Places of the right frame in the second view, (..., 2)."""
        return _mapped(inverted(self.right_from_second), right_px)


def rectify(epipolar: Epipolar, shape: tuple[int, int], across_px: float, span: tuple[float, float]) -> Rectification:
    """Find the rectified frames of a pair.

    Parameters
    ----------
    epipolar
        Lines of the two views.
    shape
        (rows, columns) of the views.
    across_px
        Offset across the lines that all points share, in the second view (`PairMatches.shift_px`).
    span
        Least and most disparity, left less right column, that is looked for. The right frame is shifted by the least,
        so that in the frames disparities begin at 0; both have as many columns to spare on the left as there are.
    """
    back = np.linalg.inv(epipolar.linear)
    lines = back @ (epipolar.basis[1] * epipolar.parallax)
    gain = float(np.hypot(*lines))
    along = lines / gain
    turn = np.array([along, [-along[1], along[0]]])
    corners = _corners(shape) @ turn.T
    low, high = np.floor(corners.min(axis=0) + 1e-9), np.ceil(corners.max(axis=0) - 1e-9)
    origin = low - np.array([np.ceil(span[1] - span[0]), 0.0])
    size = high - origin + 1
    shared = turn @ back @ (epipolar.basis[0] * across_px)  # along the rows it is part of the disparity
    left = _about_centre(turn, -origin, epipolar.centre_px)
    right_origin = -origin + np.array([span[0], -shared[1]])
    right = _about_centre(turn @ back, right_origin, epipolar.centre_px)
    return Rectification(left, right, (int(size[1]), int(size[0])), gain)


def disparity_of(rectification: Rectification, xy1_px: Array, xy2_px: Array) -> Array:
    """Left less right column of matches in the rectified frames, (n,)."""
    return np.asarray(rectification.to_left(xy1_px)[..., 0] - rectification.to_right(xy2_px)[..., 0])


def resampled(view: View, frame_from_view: Array, shape: tuple[int, int]) -> Picture:
    """Resample a view into a rectified frame, (rows, columns); NaN outside of it and where it is not usable."""
    known = usable_pixels(view)
    image = np.asarray(view.image, dtype=np.float32)
    filled = np.where(known, image, np.median(image[known]) if known.any() else 0).astype(np.float32)
    inverse = inverted(frame_from_view)
    # SciPy counts (row, column)
    matrix, offset = inverse[::-1, 1::-1], inverse[::-1, 2]
    answer = ndimage.affine_transform(filled, matrix, offset, shape, order=3, mode="mirror", output=np.float32)
    inside = ndimage.affine_transform(
        known.astype(np.float32), matrix, offset, shape, order=1, mode="constant", cval=0.0, output=np.float32
    )
    answer[inside < 1 - 1e-4] = np.nan
    return np.asarray(answer)


def inverted(affine: Array) -> Array:
    """Inverse of an affine map (2, 3)."""
    inverse = np.linalg.inv(affine[:, :2])
    return np.column_stack([inverse, -inverse @ affine[:, 2]])


def _mapped(affine: Array, xy_px: Array) -> Array:
    return np.asarray(xy_px @ affine[:, :2].T + affine[:, 2])


def _about_centre(linear: Array, origin: Array, centre_px: Array) -> Array:
    """Affine map of positions from a linear map of offsets from the centre, and where the centre's origin falls."""
    return np.column_stack([linear, origin - linear @ centre_px])


def _corners(shape: tuple[int, int]) -> Array:
    """Corner pixels of an image from its centre, (4, 2)."""
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    return np.array([[-x, -y], [x, -y], [-x, y], [x, y]])
