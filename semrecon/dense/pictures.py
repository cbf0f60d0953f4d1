"""Pictures as the dense stages want them: noise of one unit everywhere, gaps filled and marked, in several sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from semrecon.data import Array, Mask, View
from semrecon.matches.features import usable_pixels

Picture = NDArray[np.float32]

BLOCK = 8
"""Edge of the blocks whose variance is measured, px."""
QUANTILE, DEVIATE = 0.2, -0.8416
"""Share of the blocks taken for free of texture, and the normal deviate of it."""
SPREAD = float(np.sqrt(2 * 3.78) / BLOCK)
"""Relative spread of a block's variance: 64 values, correlated by the stencil (sum of squared correlations 3.78)."""
BINS = 12
ROUNDING = 1 / 12
"""Variance of rounding to whole grey levels."""
HALVING_BLUR_PX = 0.9
MARGIN_PX = 2


@dataclass(frozen=True)
class NoiseModel:
    """Variance of the noise at grey value g: ``gain * (g - dark) + floor`` (photon transfer)."""

    gain: float
    dark: float
    floor: float

    def stabilised(self, image: Array) -> Picture:
        """Grey values on a scale on which noise has variance one: ``2/gain (sqrt(variance) - sqrt(floor))``."""
        above = np.maximum(image - self.dark, 0.0)
        root = np.sqrt(self.floor)
        # the same as above without the difference of like numbers, so that it holds for gain = 0, too
        return np.asarray(2 * above / (np.sqrt(self.gain * above + self.floor) + root), dtype=np.float32)


@dataclass(frozen=True)
class Level:
    """A view at one size.

    Parameters
    ----------
    values
        (rows, columns); `valid` tells where they are measured.
    """

    values: Picture
    valid: Mask


def noise_model(image: Array, valid: Mask) -> NoiseModel:
    """Estimate how the noise grows with the grey value from the quietest blocks of each range of grey values."""
    import cv2

    stencil = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6
    rough = cv2.filter2D(image, cv2.CV_64F, stencil) ** 2
    usable = _blocks(ndimage.binary_erosion(valid, iterations=1, border_value=0).astype(np.float64)) > 1 - 1e-9
    mean, variance = _blocks(image)[usable], _blocks(rough)[usable]
    dark = float(image[valid].min()) if valid.any() else 0.0
    least = max(ROUNDING if np.all(image == np.rint(image)) else 0.0, 1e-6 * float(image[valid].var()), 1e-12)
    if mean.size < 2 * BINS:
        return NoiseModel(0.0, dark, least if mean.size == 0 else max(float(np.median(variance)), least))
    parts = np.array_split(np.argsort(mean, kind="stable"), BINS)
    grey = np.array([mean[part].mean() for part in parts]) - dark
    noise = np.array([np.quantile(variance[part], QUANTILE) for part in parts]) / (1 + DEVIATE * SPREAD)
    weight = 1 / np.maximum(noise, least)
    design = np.column_stack([grey, np.ones(BINS)]) * weight[:, None]
    (gain, floor), _ = optimize.nnls(design, noise * weight)
    return NoiseModel(float(gain), dark, max(float(floor), least))


def prepared(view: View) -> Level:
    """Bring a view to unit noise; what is masked or not a number is filled from around it and marked."""
    image = np.asarray(view.image, dtype=np.float64)
    valid = usable_pixels(view)
    if not valid.any():
        return Level(np.zeros(image.shape, np.float32), valid)
    image = filled(image, valid)
    return Level(noise_model(image, valid).stabilised(image), valid)


def filled(image: Array, valid: Mask) -> Array:
    """Put the nearest measured value where there is none."""
    if valid.all():
        return image
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(nearest)])


def pyramid(full: Level, levels: int) -> tuple[Level, ...]:
    """Halve a picture again and again; pixel i of level n stands on pixel ``2**n * i`` of the full one."""
    import cv2

    sizes = [full]
    for _ in range(levels):
        last = sizes[-1]
        blurred = cv2.GaussianBlur(last.values, (0, 0), HALVING_BLUR_PX, borderType=cv2.BORDER_REFLECT_101)
        sizes.append(Level(np.ascontiguousarray(blurred[::2, ::2]), np.ascontiguousarray(last.valid[::2, ::2])))
    return tuple(sizes)


def shrunk(valid: Mask, margin_px: int = MARGIN_PX) -> Mask:
    """Keep valid pixels whose neighbours are valid, too: what an interpolation may rest on."""
    if valid.all():
        return valid
    return np.asarray(ndimage.binary_erosion(valid, np.ones((3, 3)), margin_px, border_value=1))


def noise_variance(level: int) -> float:
    """Variance of the noise left at a level of the pyramid, in units of the full picture's."""
    return 1.0 if level == 0 else 0.32 / 4.0**level


def _blocks(image: Array) -> Array:
    rows, columns = (size // BLOCK for size in image.shape)
    return np.asarray(
        image[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).mean(axis=(1, 3)).ravel()
    )
