"""Cameras from the grey values of all pixels: what views that are drawn onto the surface still differ by.

With a_p the brightness that pixel p has in all views, J_v(p) what view v shows where the present cameras and heights
put it, G its gradient, and du_v = E_v dz + D_v dc the motion by a change of height dz and of the cameras dc::

    -J_v(p) = G . (E_v dz_p + D_v dc) - a_p + noise

Every pixel has a brightness and a height of its own, and both are eliminated exactly: what is constant over the views,
and what goes with the parallax, tells nothing of the cameras. So does brightness that changes in proportion to the
tilt. Left over is how far the views bend away from that, to which the tilts owe all that images say of them.

The noise has variance one. That of the answer is larger where the views differ by more than noise: neighbouring pixels
err together. It is told from how the tiles of the picture contradict one another (a cluster-robust covariance, Liang
and Zeger 1986, doi:10.1093/biomet/73.1.13).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semrecon.adjustment.camera_model import LOCAL, Cameras, rotation_derivatives
from semrecon.adjustment.tone_kernel import LEAST_INFORMATION, LEAST_VIEWS, Float, eliminate
from semrecon.data import Array, Optics
from semrecon.numerics.point_bands import in_bands

__all__ = ["LEAST_VIEWS", "Drawn", "Stage", "ToneEquations", "combined", "tone_equations"]

TILE = 32
"""Edge of the tiles, px: farther than errors of neighbours go together."""


@dataclass(frozen=True)
class Drawn:
    """Views drawn onto the surface.

    Parameters
    ----------
    values
        (views, rows, columns), noise of one unit; NaN where a view does not see the surface.
    gradient
        Mean of their derivatives by column and row of the view, px^-1, (2, rows, columns).
    weight
        How far each pixel is trusted, 0 to 1, (rows, columns).
    heights
        Above the plane through the reference view's origin, px, (rows, columns).
    step
        Only every so many-th row and column counts.
    """

    values: Float
    gradient: Float
    weight: Float
    heights: Array
    step: int = 1


@dataclass(frozen=True)
class ToneEquations:
    """Normal equations of the cameras, in the order of `Cameras.vector`.

    Parameters
    ----------
    matrix, right
        (n, n) and (n,), for noise of one unit.
    scatter
        Covariance of `right` as the tiles tell it, (n, n).
    """

    matrix: Array
    right: Array
    scatter: Array

    @property
    def excess(self) -> float:
        """Variance of the tilts over that which noise of one unit would give; 1 at least."""
        tilts = np.arange(2, len(self.right) - 1, LOCAL)
        information, scatter = self.matrix[tilts, tilts], self.scatter[tilts, tilts]
        known = information > LEAST_INFORMATION
        return max(float(np.mean(scatter[known] / information[known])), 1.0) if known.any() else 1.0

    def silent(self) -> ToneEquations:
        """Equations of images that say nothing of the cameras."""
        return ToneEquations(*(np.zeros_like(each) for each in (self.matrix, self.right, self.scatter)))


def tone_equations(drawn: Drawn, cameras: Cameras, reference: int, optics: Optics) -> ToneEquations:
    """Compare all views at the present heights and cameras.

    Parameters
    ----------
    reference
        The view on whose grid the heights stand, as ideal as `refinement.refine` has it: magnification 1, turn 0.
    """
    given = _given(drawn, cameras, reference, optics)
    rows, columns = drawn.heights.shape
    across = range(0, columns, TILE * drawn.step)
    size = LOCAL * len(cameras) + 1
    matrix, rights = np.zeros((size, size)), []

    def strip(first: int, last: int) -> list[tuple[Array, Array]]:
        return [_tile(given, drawn.step, first, last, left, min(left + across.step, columns)) for left in across]

    for tiles in in_bands(strip, rows, TILE * drawn.step):
        for part, right in tiles:
            matrix += part
            rights.append(right)
    every = np.array(rights)
    apart = every - every.mean(axis=0)
    share = drawn.step**2
    return ToneEquations(matrix * share, every.sum(axis=0) * share, apart.T @ apart * share**2)


@dataclass(frozen=True)
class Stage:
    """Tilts as the stage states them, rad, (views,), and how well, rad: mostly, for stages have their bad days.

    The prior is Cauchy's: it holds where images say little, and yields where they contradict it for sure.
    """

    tilts_rad: Array
    sigma_rad: float

    def held(self, cameras: Cameras) -> tuple[Array, Array]:
        """Information on all parameters near `cameras`, and its right-hand side, (n,) each."""
        apart = self.tilts_rad - cameras.tilts_rad
        information = 1 / (self.sigma_rad**2 + apart**2)
        tilts = np.arange(2, LOCAL * len(cameras), LOCAL)
        weights, right = np.zeros((2, LOCAL * len(cameras) + 1))
        weights[tilts], right[tilts] = information, information * apart
        return weights, right


def combined(
    equations: ToneEquations, stage: Stage, cameras: Cameras, known: Cameras, covariance: Array
) -> tuple[Cameras, Array]:
    """Put together what the tones say at `cameras`, what the stage states and what else is known.

    Parameters
    ----------
    known, covariance
        Cameras, and the covariance of their `vector`: what it holds stays as it is known, in whatever direction.

    Returns
    -------
    Cameras and their covariance (n, n).
    """
    excess, (held, pull) = equations.excess, stage.held(cameras)
    information, right = equations.matrix / excess + np.diag(held), equations.right / excess + pull
    system = np.eye(len(right)) + covariance @ information
    step = np.asarray(np.linalg.solve(system, covariance @ right + known.vector - cameras.vector), dtype=np.float64)
    spread = np.asarray(np.linalg.solve(system, covariance), dtype=np.float64)
    return cameras.moved(step), (spread + spread.T) / 2


def _given(drawn: Drawn, cameras: Cameras, reference: int, optics: Optics) -> tuple[Any, ...]:
    """Arguments of the kernel, but for those it writes."""
    poses, pixel = cameras.poses, optics.pixel_size_um
    gradient = np.asarray(drawn.gradient, dtype=np.float64) / pixel
    views = (poses.rotations, *rotation_derivatives(cameras), poses.translations_um, cameras.distortions)
    arrays = (drawn.heights * pixel, *views, optics.centre_px)
    plain = (np.ascontiguousarray(each, dtype=np.float64) for each in arrays)
    return drawn.values, gradient, drawn.weight, *plain, pixel, optics.inverse_working_distance, reference


def _tile(given: tuple[Any, ...], step: int, top: int, bottom: int, left: int, right: int) -> tuple[Array, Array]:
    """Compare the views on a tile: its normal equations, (n, n) and (n,)."""
    views = len(given[0])
    pixels = -(-(bottom - top) // step) * -(-(right - left) // step)
    size = LOCAL * views + 1
    own, asked, rows = np.zeros((views, LOCAL + 1, LOCAL + 1)), np.zeros(size), np.zeros((2 * pixels, size))
    used = eliminate(*given, own, asked, rows, step, top, bottom, left, right)
    matrix = -rows[:used].T @ rows[:used]
    for view in range(views):
        index = np.append(np.arange(view * LOCAL, (view + 1) * LOCAL), size - 1)
        matrix[np.ix_(index, index)] += own[view]
    return matrix, asked
