"""Large systems of a surface from coarse to fine: the normal equations are averaged, the images are not.

Conjugate gradients carry a change over about one pixel a step, so that what is wrong over a hundred pixels stays wrong.
A correction on a grid of blocks costs nothing beside that. Its equations are sums of the fine ones over blocks; a bend
of a block in its corners is that of its height over the block's width, hence the third power.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from semrecon.data import Array
from semrecon.dense.smoothness import solved

BLOCKS_PX = (32, 16, 8, 4, 2)
LEAST_BLOCKS = 6
COARSE_STEPS = 40
TINY = 1e-9


def corrected(
    system: Callable[[Array], Array],
    right: Array,
    information: Array,
    weights: Array,
    diagonal: Array,
    *,
    steps: int,
    blocks_px: Sequence[int] = BLOCKS_PX,
) -> Array:
    """Solve ``system(z) = right`` for z, (rows, columns).

    Parameters
    ----------
    system
        Symmetric and positive; at coarse sizes it is taken for ``information`` plus second differences.
    information
        (rows, columns).
    weights
        Of the second differences, (2, rows, columns).
    diagonal
        About that of the system, positive: it preconditions the fine steps.
    steps
        Conjugate gradients at full size.
    blocks_px
        Widths of the blocks, from coarse to fine.
    """
    z, residual = np.zeros_like(right), right.copy()
    for width in blocks_px:
        if min(right.shape) // width < LEAST_BLOCKS:
            continue
        blocks = block_sums(information, width) + TINY
        bends = np.stack([block_sums(one, width) for one in weights]) / width**3
        found = solved(blocks, block_sums(residual, width), bends, np.zeros_like(blocks), COARSE_STEPS)
        direction = spread(found, width, right.shape)
        image = system(direction)
        length = np.vdot(direction, residual) / max(float(np.vdot(direction, image)), TINY**3)  # best along it
        z += length * direction
        residual -= length * image
    return z + _conjugate_gradients(system, residual, diagonal, steps)


def block_sums(picture: Array, width: int) -> Array:
    """Sum over square blocks; those at the far edges may reach beyond the picture."""
    rows, columns = (-(-size // width) for size in picture.shape)
    padding = [(0, rows * width - picture.shape[0]), (0, columns * width - picture.shape[1])]
    padded = np.pad(np.asarray(picture, dtype=np.float64), padding)
    return np.asarray(padded.reshape(rows, width, columns, width).sum(axis=(1, 3)))


def spread(blocks: Array, width: int, shape: tuple[int, ...]) -> Array:
    """Interpolate between the middles of blocks, (rows, columns) of `shape`."""
    import cv2

    rows, columns = blocks.shape
    large = cv2.resize(blocks, (columns * width, rows * width), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[: shape[0], : shape[1]], dtype=np.float64)


def _conjugate_gradients(system: Callable[[Array], Array], residual: Array, diagonal: Array, steps: int) -> Array:
    """Improve on zero; `residual` is used up."""
    z = np.zeros_like(residual)
    scaled = residual / diagonal
    direction, rho = scaled.copy(), float(np.vdot(residual, scaled))
    for _ in range(steps):
        if rho <= 0:
            break
        image = system(direction)
        length = rho / float(np.vdot(direction, image))
        z += length * direction
        residual -= length * image
        scaled = residual / diagonal
        before, rho = rho, float(np.vdot(residual, scaled))
        direction *= rho / before
        direction += scaled
    return z
