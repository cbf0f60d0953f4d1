"""Features: places that can be found again in another view, with a description of what they look like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semrecon.data import Array, Image, Mask, View
from semrecon.errors import MethodError

Keypoint = Any
"""cv2.KeyPoint; OpenCV brings no types."""


@dataclass(frozen=True)
class FeatureOptions:
    """How to look for features.

    Parameters
    ----------
    max_features
        Keep at most so many places a view, the strongest first.
    contrast_threshold, edge_threshold, sigma_px
        As in Lowe's SIFT, in OpenCV's units; micrographs are noisy and soft, so the contrast threshold is low.
    upright
        Describe every feature with the image's own axes. A stage tilt does not turn the picture in its plane, so
        that the orientation is known, too; False estimates it from the gradients, several a place where it is unsure.
    mask_margin_px
        Stay so far away from pixels that may not be used.
    percentiles
        Grey values (percent of the pixels) that become black and white.
    """

    max_features: int = 8000
    contrast_threshold: float = 0.02
    edge_threshold: float = 12.0
    sigma_px: float = 1.6
    upright: bool = True
    mask_margin_px: int = 5
    percentiles: tuple[float, float] = (0.1, 99.9)


@dataclass(frozen=True)
class Features:
    """Features of one view, in reading order.

    Parameters
    ----------
    xy_px
        (features, 2) as (column, row).
    scale_px
        Diameter of the neighbourhood that is described, (features,).
    descriptors
        RootSIFT, (features, 128) float32 of unit length.
    place
        Index of the first feature at the same position, (features,): one place may have several orientations.
    """

    xy_px: Array
    scale_px: Array
    descriptors: NDArray[np.float32]
    place: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.xy_px)


def detect_features(view: View, options: FeatureOptions = FeatureOptions()) -> Features:
    """Find and describe the features of a view: SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic 2012).

    The answer does not depend on threads or on the detector's own order.

    Raises
    ------
    MethodError
        Where the usable part of the view is blank.
    """
    import cv2

    usable = usable_pixels(view)
    grey = normalised_grey(view.image, usable, options.percentiles, view.name)
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        nfeatures=0,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        sigma=options.sigma_px,
        enable_precise_upscale=True,  # otherwise every position is off by a quarter of a pixel
    )
    allowed = ndimage.binary_erosion(usable, iterations=options.mask_margin_px, border_value=1)
    keypoints = _strongest(list(sift.detect(grey, allowed.astype(np.uint8))), options.max_features)
    if not keypoints:
        return _no_features()
    if options.upright:
        keypoints = _upright(keypoints)
    keypoints, descriptors = sift.compute(grey, keypoints)
    xy = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    scale = np.array([keypoint.size for keypoint in keypoints], dtype=np.float64)
    return Features(xy, scale, root_sift(descriptors), _first_at_place(xy))


def usable_pixels(view: View) -> Mask:
    """Tell which pixels carry a picture, (rows, columns): inside the mask, finite, not in an empty row.

    Scanners and converters leave rows that are black or white but for a few values; the edge of such a row would look
    like a feature. A row is empty where its grey values spread over less than 2 % of what the whole view has.
    """
    finite = np.isfinite(view.image) if view.mask is None else view.mask & np.isfinite(view.image)
    if not finite.any():
        return np.asarray(finite)
    spread = np.subtract(*np.percentile(view.image[finite], (99, 1)))
    return np.asarray(finite & (_row_spread(view.image, finite) > 0.02 * spread)[:, None])


def _row_spread(image: Image, usable: Mask) -> Array:
    """Range of the middle 90 % of the usable grey values of each row, (rows,); 0 where there are none."""
    rows = np.sort(np.where(usable, image, np.nan), axis=1)  # NaN comes last
    count = usable.sum(axis=1)
    low, high = (rows[np.arange(len(rows)), (share * np.maximum(count - 1, 0)).astype(int)] for share in (0.05, 0.95))
    return np.where(count > 0, high - low, 0.0)


def normalised_grey(image: Image, usable: Mask, percentiles: tuple[float, float], name: str = "") -> NDArray[np.uint8]:
    """Stretch the usable grey values to 8 bits, (rows, columns); what is not usable takes the median.

    Raises
    ------
    MethodError
        Where there is no contrast to stretch.
    """
    values = image[usable].astype(np.float64)
    black, white = np.percentile(values, percentiles) if values.size else (0.0, 0.0)
    if not white > black:
        raise MethodError(
            f"{name or 'a view'} is blank: its usable pixels all have the grey value {black:g}; a picture with "
            "contrast is needed"
        )
    filled = np.where(usable, image, np.median(values)).astype(np.float64)
    return np.asarray(np.clip(np.rint((filled - black) * (255 / (white - black))), 0, 255).astype(np.uint8))


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn SIFT descriptors (n, 128) into RootSIFT: the square root of the histogram's shares, of unit length."""
    total = descriptors.sum(axis=1, keepdims=True, dtype=np.float64)
    return np.asarray(np.sqrt(descriptors / np.maximum(total, 1e-12)).astype(np.float32))


def _strongest(keypoints: list[Keypoint], most: int) -> list[Keypoint]:
    """Keep the keypoints of the strongest places, in reading order; both orders are total, so that ties cannot move."""
    keypoints = sorted(keypoints, key=lambda k: (-k.response, k.pt[1], k.pt[0], k.size, k.angle))
    places = set(list(dict.fromkeys(k.pt for k in keypoints))[:most])
    return sorted((k for k in keypoints if k.pt in places), key=lambda k: (k.pt[1], k.pt[0], k.size, k.angle))


def _upright(keypoints: list[Keypoint]) -> list[Keypoint]:
    """One keypoint for each position and scale, with the image's own axes."""
    import cv2

    found = dict.fromkeys((k.pt[0], k.pt[1], k.size, k.octave, k.class_id) for k in keypoints)
    return [cv2.KeyPoint(x, y, size, 0.0, 0.0, octave, class_id) for x, y, size, octave, class_id in found]


def _first_at_place(xy_px: Array) -> NDArray[np.int64]:
    _, first, inverse = np.unique(xy_px, axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[inverse.reshape(-1)], dtype=np.int64)


def _no_features() -> Features:
    return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), dtype=np.float32), np.zeros(0, dtype=np.int64))
