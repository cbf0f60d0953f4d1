"""Translation between two views of known rotation: the seed's linear system, literally and in closed form.

Camera axes of view 1, um from the image centre: the first image gives ``(X_i, Y_i) = m1_i`` (Eq. 3), the second
(Eqs. 4, 5, with a = 1 as lengths are um)::

    m2_i = B m1_i + r Z_i + t,     B = [[r11, r12], [r21, r22]],  r = (r13, r23),  t = (t_x, t_y)

With ``c_i = m2_i - B m1_i``, ``s = |r|`` (the sine of the angle between the two beams), ``e = r / s`` and ``p`` at
right angles to e, the 2n equations fall apart into::

    e . c_i = s Z_i + t_e          n equations, n + 1 unknowns: depths and the translation along e
    p . c_i = t_p                  n equations, 1 unknown, and all the contradiction there is: the epipolar residual

so the 2n x (n+2) matrix A has the singular values ``sqrt(n + s^2), sqrt(n), s (n - 1 times), 0``: its rank is n + 1
for every n, its condition number on the range is ``sqrt(1 + n / s^2)``, and its null vector
``Z_i -> Z_i + k, t -> t - k r`` changes no image. The seed's "solvable for n >= 2" overlooks it. Something must choose
k, and is named: the gauge.
The generalised inverse chooses the solution at right angles to the null vector, ``sum(Z_i) = s t_e``, hence
``t_e = sum(e . c_i) / (s^2 + n)``; for a rotation about the image's y axis this is Boyde's stereo formula.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from semrecon.data import Array, Mask
from semrecon.errors import InputError, MethodError
from semrecon.points.joint_translation import SeriesTranslation, global_translations, solve_series

__all__ = [
    "DepthGauge",
    "PairTranslation",
    "SeriesTranslation",
    "global_translations",
    "linear_system",
    "solve_closed_form",
    "solve_generalised_inverse",
    "solve_series",
]

DepthGauge = Literal["minimum_norm", "zero_mean", "zero_median"]
"""Who chooses the unobservable depth offset: the generalised inverse, or a mean or median depth of zero."""
Perpendicular = Literal["median", "mean"]
"""Estimate of t_p: the median shrugs off wrong matches; the mean is the least-squares answer."""

LEAST_SINE = 1e-6
"""Least sine of the angle between two beams: below, depth is a million times as noisy as the matches."""


@dataclass(frozen=True)
class PairTranslation:
    """Translation and depths from two views, with what the equations could and could not say.

    Parameters
    ----------
    translation_um
        (t_x, t_y) in camera axes (x right, y down), (2,).
    depth_um
        Z_i along the beam of view 1, positive into the specimen, (matches,); NaN where a position is missing.
    epipolar_um
        Residual across the epipolar lines, ``p . c_i - t_p``, (matches,); NaN where a position is missing.
    parallax
        r = (r13, r23): the shift in image 2 by a unit of depth, (2,).
    rank, condition
        Of the matrix of Eqs. 4, 5 for the matches used: n + 1 of n + 2 unknowns, and the ratio of the largest to the
        smallest singular value that is not zero.
    gauge
        Who chose the depth offset.
    """

    translation_um: Array
    depth_um: Array
    epipolar_um: Array
    parallax: Array
    rank: int
    condition: float
    gauge: str

    def shifted(self, depth_um: float) -> PairTranslation:
        """Add a length to every depth and move the translation with it; no image changes."""
        return replace(
            self,
            translation_um=self.translation_um - depth_um * self.parallax,
            depth_um=self.depth_um + depth_um,
            gauge=f"{self.gauge}{depth_um:+g} um",
        )


def linear_system(m1_um: Array, m2_um: Array, rotation: Array) -> tuple[Array, Array]:
    """Build the seed's system ``A x = b`` (Eqs. 4, 5) as printed, x = (Z_1 ... Z_n, t_x, t_y).

    Parameters
    ----------
    m1_um, m2_um
        Matches in um from the image centre (`geometry.centred_um`), (n, 2), all finite.
    rotation
        R_2 R_1^T in camera axes, (3, 3).

    Returns
    -------
    A (2n, n + 2) and b (2n,); rows 2i and 2i + 1 are the column and row equation of match i.

    Raises
    ------
    InputError
        A position is missing, or shapes do not fit.
    """
    parallax, offsets = _offsets(m1_um, m2_um, rotation)
    if not np.isfinite(offsets).all():
        raise InputError("matches of the linear system must all be finite; drop those with a missing position")
    n = len(offsets)
    depths = np.kron(np.eye(n), parallax[:, None])
    return np.hstack([depths, np.tile(np.eye(2), (n, 1))]), offsets.ravel()


def solve_generalised_inverse(m1_um: Array, m2_um: Array, rotation: Array) -> PairTranslation:
    """Solve Eqs. 4, 5 by the generalised inverse, as the seed does: cubic in the number of matches.

    Takes and raises what `solve_closed_form` does; matches with a missing position are left out and have NaN depth.
    """
    parallax, offsets = _offsets(m1_um, m2_um, rotation)
    used = _usable(offsets, parallax, None)
    a, b = linear_system(m1_um[used], m2_um[used], rotation)
    # the zero singular value comes out near the rounding error: a cut-off below that would invert it
    solution = np.linalg.pinv(a, rcond=max(a.shape) * np.finfo(float).eps) @ b
    depth = np.full(len(offsets), np.nan)
    depth[used] = solution[:-2]
    return _answer(solution[-2:], depth, offsets, parallax, used, "minimum_norm")


def solve_closed_form(
    m1_um: Array,
    m2_um: Array,
    rotation: Array,
    *,
    gauge: DepthGauge = "zero_median",
    perpendicular: Perpendicular = "median",
    inliers: Mask | None = None,
) -> PairTranslation:
    """Solve Eqs. 4, 5 for any known rotation in a time linear in the number of matches.

    ``gauge="minimum_norm", perpendicular="mean"`` is the generalised inverse to rounding.

    Parameters
    ----------
    m1_um, m2_um
        Matches in um from the image centre (`geometry.centred_um`), (n, 2); a match with a NaN is left out of every
        sum and has NaN depth.
    rotation
        R_2 R_1^T in camera axes, (3, 3).
    gauge
        Who chooses the depth offset.
    perpendicular
        Estimate of the translation across the epipolar lines.
    inliers
        Matches that the translation and the gauge may rest on, (n,); None means all. Depths come out for all.

    Raises
    ------
    InputError
        Shapes do not fit, or `rotation` is none.
    MethodError
        Fewer than two usable matches, or no tilt between the views.
    """
    parallax, offsets = _offsets(m1_um, m2_um, rotation)
    used = _usable(offsets, parallax, inliers)
    sine = float(np.linalg.norm(parallax))
    along, across = parallax / sine, _right_angle(parallax / sine)
    t_p = (np.median if perpendicular == "median" else np.mean)(offsets[used] @ across)
    t_e = _along(offsets[used] @ along, sine, gauge)
    depth = (offsets @ along - t_e) / sine
    return _answer(t_e * along + t_p * across, depth, offsets, parallax, used, gauge)


def _along(c: Array, sine: float, gauge: DepthGauge) -> float:
    """Choose t_e: ``Z_i = (c_i - t_e) / s`` has zero mean or median, or is at right angles to the null vector."""
    if gauge == "minimum_norm":
        return float(c.sum() / (sine**2 + len(c)))
    return float(np.median(c) if gauge == "zero_median" else np.mean(c))


def _answer(
    translation: Array, depth: Array, offsets: Array, parallax: Array, used: Mask, gauge: DepthGauge
) -> PairTranslation:
    n, sine = int(used.sum()), float(np.linalg.norm(parallax))
    epipolar = (offsets - translation) @ _right_angle(parallax / sine)
    return PairTranslation(translation, depth, epipolar, parallax, n + 1, float(np.sqrt(1 + n / sine**2)), gauge)


def _right_angle(direction: Array) -> Array:
    return np.array([-direction[1], direction[0]])


def _offsets(m1_um: Array, m2_um: Array, rotation: Array) -> tuple[Array, Array]:
    """Split off r (2,) and ``c_i = m2_i - B m1_i`` (n, 2), after checking what came in."""
    if m1_um.ndim != 2 or m1_um.shape[1] != 2 or m1_um.shape != m2_um.shape:
        raise InputError(f"matches must be two arrays of one shape (n, 2), not {m1_um.shape} and {m2_um.shape}")
    proper = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    if not proper or np.linalg.det(rotation) < 0:
        raise InputError("the relative rotation must be a proper 3 x 3 rotation matrix, R_2 R_1^T in camera axes")
    m1, m2 = (np.where(np.isfinite(m), m, np.nan) for m in (m1_um, m2_um))
    return rotation[:2, 2], m2 - m1 @ rotation[:2, :2].T


def _usable(offsets: Array, parallax: Array, inliers: Mask | None) -> Mask:
    if np.linalg.norm(parallax) < LEAST_SINE:
        raise MethodError("the two views look along the same beam: without a tilt between them depth cannot be seen")
    used = np.isfinite(offsets).all(axis=1)
    if inliers is not None:
        used &= inliers
    if used.sum() < 2:
        raise MethodError(f"translation needs at least two usable matches, {int(used.sum())} found")
    return np.asarray(used)
