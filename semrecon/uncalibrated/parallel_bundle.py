"""Bundle adjustment of parallel projections of which nothing is known: cameras and points from the images alone.

A model says how its free numbers make affine cameras; the points are eliminated (`affine_cameras`), and damped
Gauss-Newton steps (Levenberg 1944, Marquardt 1963) find the least squares. Directions that no image tells are not
moved by them. Two models: any affine cameras (`FreeCameras`), and rotations with a magnification (`TurnedCameras`),
the scaled orthographic camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Mask, Tracks
from semrecon.errors import MethodError
from semrecon.numerics.robust import fit_noise
from semrecon.uncalibrated.affine_cameras import (
    LOCAL,
    AffineCameras,
    intersect,
    loss,
    misses_px,
    reduced_equations,
    weights_of,
)

CAUCHY = 2.385
"""Tuning constant: 95 % efficient for Gaussian noise."""
SETTLED = 1e-7
"""Steps stop when the loss falls by less than this part of itself."""
EXACT_PX2 = 1e-22
"""Mean squared miss below which only rounding is left."""
FLAT = 1e-13
"""Eigenvalues of the scaled normal matrix below this are directions that no image tells."""

LEAST_TOLD = 1e-15
"""Floor of the same eigenvalues where they are inverted for a covariance."""


class Model(Protocol):
    """Cameras as a function of fewer numbers."""

    @property
    def gauge(self) -> int:
        """How many directions no image ever tells."""

    @property
    def cameras(self) -> AffineCameras:
        """The cameras."""

    @property
    def derivatives(self) -> Array:
        """Derivative of `cameras.vector` by the free numbers, (8 views, free)."""

    def moved(self, step: Array) -> Self:
        """Add a step of the free numbers."""


M = TypeVar("M", bound=Model)


@dataclass(frozen=True)
class FreeCameras:
    """Any affine cameras, that of the reference view held.

    Parameters
    ----------
    cameras
        All of them.
    reference
        View that is held.
    """

    cameras: AffineCameras
    reference: int

    @property
    def gauge(self) -> int:
        """Third axis and origin along it of the affine frame."""
        return 4

    @property
    def derivatives(self) -> Array:
        """Derivative of `cameras.vector` by the free numbers, (8 views, 8 views - 8)."""
        held = slice(LOCAL * self.reference, LOCAL * (self.reference + 1))
        return np.delete(np.eye(LOCAL * len(self.cameras)), held, axis=1)

    def moved(self, step: Array) -> FreeCameras:
        """Add a step of the free numbers."""
        return replace(self, cameras=AffineCameras.from_vector(self.cameras.vector + self.derivatives @ step))


@dataclass(frozen=True)
class TurnedCameras:
    """Rotations with a magnification: ``xy_v = s_v (first two rows of R_v) X + t_v``, in px and camera axes.

    Parameters
    ----------
    rotations
        R_v from the camera axes of the reference view, (views, 3, 3); the identity there.
    log_scales
        log s_v, (views,); 0 in the reference view.
    offsets
        t_v in px, (views, 2); (0, 0) in the reference view.
    reference
        View that is held.
    scaled
        Whether magnifications are free.
    """

    rotations: Array
    log_scales: Array
    offsets: Array
    reference: int
    scaled: bool = True

    @property
    def cameras(self) -> AffineCameras:
        """The same as affine cameras."""
        return AffineCameras(np.exp(self.log_scales)[:, None, None] * self.rotations[:, :2], self.offsets)

    @property
    def gauge(self) -> int:
        """Origin along the beam of the reference view."""
        return 1

    @property
    def local(self) -> int:
        """Free numbers of a view: three of rotation, two of shift, and the magnification where it is free."""
        return 6 if self.scaled else 5

    @property
    def derivatives(self) -> Array:
        """Derivative of `cameras.vector` by the free numbers of all views but the reference."""
        matrices, count = self.cameras.matrices, len(self.rotations)
        full = np.zeros((count, 2, 4, count, self.local))
        for v in range(count):
            for axis in range(3):
                turn = np.cross(np.eye(3)[axis], np.eye(3)).T  # the matrix of e_axis x
                full[v, :, :3, v, axis] = np.exp(self.log_scales[v]) * (turn @ self.rotations[v])[:2]
            full[v, 0, 3, v, 3] = full[v, 1, 3, v, 4] = 1.0
            if self.scaled:
                full[v, :, :3, v, 5] = matrices[v]
        return np.delete(full, self.reference, axis=3).reshape(LOCAL * count, -1)

    def moved(self, step: Array) -> TurnedCameras:
        """Add a step of the free numbers; rotations turn in their own camera's axes."""
        rows = np.insert(step.reshape(-1, self.local), self.reference, 0.0, axis=0)
        turns = Rotation.from_rotvec(rows[:, :3]).as_matrix()
        scales = self.log_scales + rows[:, 5] if self.scaled else self.log_scales
        return replace(self, rotations=turns @ self.rotations, offsets=self.offsets + rows[:, 3:5], log_scales=scales)


@dataclass(frozen=True)
class Adjusted(Generic[M]):
    """What a bundle adjustment found.

    Parameters
    ----------
    model
        Cameras.
    points
        (tracks, 3) in the frame of the model, NaN where left out.
    inliers
        Tracks that count, (tracks,).
    residual_px
        Root-mean-square miss of every track, (tracks,), NaN where it has fewer than two views.
    sigma_px
        Noise of a sighting per coordinate.
    covariance
        Of the free numbers, (free, free), the gauge being held.
    history_px
        Weighted root-mean-square miss at the start and after each step; it may rise where the weights change.
    """

    model: M
    points: Array
    inliers: Mask
    residual_px: Array
    sigma_px: float
    covariance: Array
    history_px: tuple[float, ...] = ()


def adjust(tracks: Tracks, model: M, *, sigmas: float = 3.5, rounds: int = 50) -> Adjusted[M]:
    """Fit cameras and points to tracks, and leave out the tracks that the noise cannot explain.

    First every track counts by a Cauchy weight; then tracks are sorted into those that count and those that do not,
    until that stays the same.

    Raises
    ------
    MethodError
        Hardly any track is left.
    """
    base, xy = weights_of(tracks), tracks.xy_px
    history: list[float] = []
    for _ in range(4):
        model, misses = descend(xy, base * _cauchy(xy, base, model)[:, None], model, rounds=6)
        history += misses if not history else misses[1:]
    chosen = np.zeros(len(xy), dtype=bool)
    for _ in range(6):
        noise = fit_noise(_residual_px(xy, base, model), _views(base), sigmas=sigmas)
        if noise.inliers.sum() < 4 or (noise.inliers == chosen).all():
            break
        chosen = noise.inliers
        model, misses = descend(xy, base * chosen[:, None], model, rounds=rounds)
        history += misses[1:]
    if chosen.sum() < 4:
        raise MethodError("no cameras explain the matches; the views may not show one rigid specimen")
    points, ranks = intersect(xy, base, model.cameras)
    points[(ranks < 3) | ~chosen] = np.nan
    matrix = model.derivatives.T @ reduced_equations(xy, base * chosen[:, None], model.cameras)[0] @ model.derivatives
    return Adjusted(
        model,
        points,
        chosen,
        _residual_px(xy, base, model),
        noise.sigma_px,
        noise.sigma_px**2 * _inverse(matrix, model.gauge),
        tuple(history),
    )


def minimise(xy_px: Array, weights: Array, model: M, *, rounds: int = 50) -> M:
    """Take damped Gauss-Newton steps until the weighted squares no longer fall.

    Parameters
    ----------
    xy_px, weights
        (tracks, views, 2) and (tracks, views), 0 where a sighting does not count.
    """
    return descend(xy_px, weights, model, rounds=rounds)[0]


def descend(xy_px: Array, weights: Array, model: M, *, rounds: int = 50) -> tuple[M, list[float]]:
    """Do as `minimise` does, and say how: weighted root-mean-square miss at the start and after each step, px."""
    used = (weights > 0).any(axis=1)
    xy_px, weights = xy_px[used], weights[used]
    now, damping = loss(xy_px, weights, model.cameras), 1e-6
    losses = [now]
    for _ in range(rounds):
        if now <= EXACT_PX2 * weights.sum():
            break
        matrix, right = reduced_equations(xy_px, weights, model.cameras)
        by = model.derivatives
        matrix, right = by.T @ matrix @ by, by.T @ right
        before = now
        for _ in range(8):
            other = model.moved(_damped(matrix, right, damping))
            there = loss(xy_px, weights, other.cameras)
            if there < now:
                model, now, damping = other, there, max(damping / 10, 1e-12)
                break
            damping *= 10
        losses.append(now)
        if before - now <= SETTLED * before:
            break
    return model, [float(np.sqrt(each / max(weights.sum(), np.finfo(float).tiny))) for each in losses]


def _damped(matrix: Array, right: Array, damping: float) -> Array:
    size = _sizes(matrix)
    values, vectors = np.linalg.eigh(matrix * np.outer(size, size))
    told = values > FLAT * values[-1]
    part = vectors[:, told]
    return np.asarray(size * (part @ ((part.T @ (size * right)) / (values[told] + damping))))


def _inverse(matrix: Array, gauge: int) -> Array:
    """Invert but for the flattest directions, as many as the gauge has; another flat one means a huge variance."""
    size = _sizes(matrix)
    values, vectors = np.linalg.eigh(matrix * np.outer(size, size))
    scaled = size[:, None] * vectors[:, gauge:]
    return np.asarray((scaled / np.maximum(values[gauge:], LEAST_TOLD * values[-1])) @ scaled.T)


def _sizes(matrix: Array) -> Array:
    diagonal = np.diag(matrix)
    return np.asarray(1 / np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max() + 1e-300)))


def _views(weights: Array) -> np.ndarray:
    return np.asarray(np.maximum((weights > 0).sum(axis=1), 2))


def _residual_px(xy_px: Array, weights: Array, model: Model) -> Array:
    """Root-mean-square miss of every track, NaN where it has fewer than two views, (tracks,)."""
    points, _ = intersect(xy_px, weights, model.cameras)
    squares = np.where(weights > 0, (misses_px(xy_px, points, model.cameras) ** 2).sum(axis=2), 0.0)
    return np.where((weights > 0).any(axis=1), np.sqrt(squares.sum(axis=1) / _views(weights)), np.nan)


def _cauchy(xy_px: Array, weights: Array, model: Model) -> Array:
    """Weight of every track by its own noise against that of all, (tracks,)."""
    views, residual = _views(weights), _residual_px(xy_px, weights, model)
    noise = residual * np.sqrt(views / (2 * views - 3))
    long = views > 2
    asked = noise[long & np.isfinite(noise)] if (long & np.isfinite(noise)).sum() >= 4 else noise[np.isfinite(noise)]
    scale = max(1.2 * float(np.median(asked)), 1e-9) if len(asked) else 1.0
    return np.asarray(np.nan_to_num(1 / (1 + (noise / (CAUCHY * scale)) ** 2)))
