"""Weighted normal equations of many points at once: one 3 x 3 system a point, missing views by zero weight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array

RANK_TOLERANCE = 1e-12
"""Eigenvalues below this part of the largest count as zero; two equal sightings reach it 2e-6 rad (1e-4 deg) apart."""


def normal_matrices(weights: Array, projections: Array) -> Array:
    """Sum ``w_iv P_v^T P_v`` over the views of every point.

    Parameters
    ----------
    weights
        (points, views), 0 where a view does not see the point.
    projections
        P_v, the first two rows of each rotation, (views, 2, 3).

    Returns
    -------
    N_i, (points, 3, 3).
    """
    products = np.swapaxes(projections, 1, 2) @ projections
    return np.asarray((weights @ products.reshape(-1, 9)).reshape(-1, 3, 3))


def right_sides(weights: Array, projections: Array, positions: Array) -> Array:
    """Sum ``w_iv P_v^T m_iv`` over the views of every point.

    Parameters
    ----------
    positions
        m_iv, (points, views, 2), finite (0 where the weight is 0).

    Returns
    -------
    (points, 3).
    """
    weighted = (weights[..., None] * positions).reshape(len(positions), 2 * len(projections))
    return np.asarray(weighted @ projections.reshape(-1, 3))


def pseudo_inverses(matrices: Array) -> tuple[Array, NDArray[np.intp]]:
    """Invert symmetric 3 x 3 matrices on their range; return the inverses and the ranks.

    The pseudo-inverse, not a refusal, keeps the elimination of a point exact where its depth is unobservable (seen in
    one view, or in views along one beam).

    Parameters
    ----------
    matrices
        (points, 3, 3), positive semi-definite.

    Returns
    -------
    (points, 3, 3) and (points,).
    """
    adjugates, determinants = _adjugates(matrices)
    # det / trace^3 is below smallest / largest eigenvalue: where it is large enough no eigenvalue need be computed
    regular = determinants > 100 * RANK_TOLERANCE * np.trace(matrices, axis1=1, axis2=2) ** 3
    inverses = adjugates / np.where(regular, determinants, 1.0)[:, None, None]
    ranks = np.full(len(matrices), 3)
    inverses[~regular], ranks[~regular] = _invert_on_range(matrices[~regular])
    return inverses, ranks


def multiply(matrices: Array, vectors: Array) -> Array:
    """Multiply each matrix by its own vector: (points, 3, 3) by (points, 3)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _adjugates(matrices: Array) -> tuple[Array, Array]:
    """Adjugates (points, 3, 3) and determinants (points,) of symmetric matrices: rows are cross products of rows."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    return rows, np.einsum("ia,ia->i", a, rows[:, 0])


def _invert_on_range(matrices: Array) -> tuple[Array, NDArray[np.intp]]:
    values, vectors = np.linalg.eigh(matrices)
    kept = values > RANK_TOLERANCE * values[:, 2:]
    inverses = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    return (vectors * inverses[:, None, :]) @ np.swapaxes(vectors, 1, 2), kept.sum(axis=1)
