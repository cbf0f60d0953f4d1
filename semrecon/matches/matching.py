"""Matches between two views, searched where the known rotation says that they can be.

A descriptor is compared only with those in a band along its epipolar line (`semrecon.matches.epipolar`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array
from semrecon.matches.epipolar import Epipolar, Window
from semrecon.matches.features import Features

Index = NDArray[np.int64]


@dataclass(frozen=True)
class MatchOptions:
    """What makes a match.

    Parameters
    ----------
    ratio
        Lowe's ratio test: best distance below `ratio` times the second best one in the window.
    max_distance
        Greatest distance of two RootSIFT descriptors (0 is equal, 1.41 has nothing in common).
    mutual
        Ask that each is the other's best.
    same_place_px
        What lies so near to the best is the same place: it is no rival in the ratio test.
    """

    ratio: float = 0.85
    max_distance: float = 0.7
    mutual: bool = True
    same_place_px: float = 2.0


@dataclass(frozen=True)
class Matches:
    """The same specimen points in two views, sorted by `index1`; a place of either view appears at most once.

    Parameters
    ----------
    xy1_px, xy2_px
        (matches, 2) as (column, row).
    index1, index2
        Places of the two views (`Features.place`), (matches,).
    distance
        Distance of the descriptors, (matches,).
    """

    xy1_px: Array
    xy2_px: Array
    index1: Index
    index2: Index
    distance: Array

    def __len__(self) -> int:
        return len(self.index1)

    def keep(self, mask: NDArray[np.bool_]) -> Matches:
        """Select matches by a boolean mask."""
        return Matches(self.xy1_px[mask], self.xy2_px[mask], self.index1[mask], self.index2[mask], self.distance[mask])


def match_features(
    first: Features, second: Features, epipolar: Epipolar, window: Window, options: MatchOptions
) -> Matches:
    """Match the features of two views inside a window about their epipolar lines.

    The cost is the number of pairs inside the window times the length of a descriptor.
    """
    place1, place2 = epipolar.from_first(first.xy_px), epipolar.in_second(second.xy_px)
    low = np.array([window.across[0], window.along[0]])
    high = np.array([window.across[1], window.along[1]])
    forward = _search(place1, place2, first.descriptors, second.descriptors, low, high, options)
    backward = _search(place2, place1, second.descriptors, first.descriptors, -high, -low, options)
    return select_matches(first, second, forward, backward, options)


def match_exhaustively(first: Features, second: Features, options: MatchOptions) -> Matches:
    """Match by comparing everything with everything in plain NumPy: the reference for `match_features`."""
    similarity = first.descriptors.astype(np.float64) @ second.descriptors.astype(np.float64).T
    forward = _best_two(similarity, second.xy_px, options.same_place_px)
    backward = _best_two(similarity.T, first.xy_px, options.same_place_px)
    return select_matches(first, second, forward, backward, options)


Nearest = tuple[Index, Array, Array]
"""Best candidate (-1: none), its distance, and the distance of the best rival at another place; each (n,)."""


def select_matches(
    first: Features, second: Features, forward: Nearest, backward: Nearest, options: MatchOptions
) -> Matches:
    """Apply the ratio test, the mutual check and the limit of distance; then one match a place, the nearest first."""
    best, distance, rival = forward
    good = (best >= 0) & (distance <= options.max_distance) & (distance < options.ratio * rival)
    index1 = np.flatnonzero(good)
    if options.mutual:
        back = backward[0][best[index1]]
        away = np.linalg.norm(first.xy_px[back] - first.xy_px[index1], axis=1)
        index1 = index1[(back >= 0) & (away <= options.same_place_px)]
    index2, distance = best[index1], distance[index1]
    place1, place2 = first.place[index1], second.place[index2]
    chosen = _once_each(place1, place2, distance)
    chosen = chosen[np.argsort(place1[chosen])]
    place1, place2 = place1[chosen], place2[chosen]
    return Matches(first.xy_px[place1], second.xy_px[place2], place1, place2, distance[chosen])


def _once_each(place1: Index, place2: Index, distance: Array) -> Index:
    """Take matches in order of distance, each place of either view once."""
    order = np.lexsort((place2, place1, distance))
    order = order[np.sort(np.unique(place1[order], return_index=True)[1])]
    return np.asarray(order[np.sort(np.unique(place2[order], return_index=True)[1])])


def _best_two(similarity: Array, xy_px: Array, same_place_px: float) -> Nearest:
    """Nearest and rival of each row of a table of dot products (n, m)."""
    n, m = similarity.shape
    if m == 0:
        return np.full(n, -1), np.full(n, np.inf), np.full(n, np.inf)
    best = np.argmax(similarity, axis=1)
    near = np.linalg.norm(xy_px[best][:, None] - xy_px[None], axis=2) <= same_place_px
    rival = np.where(near, -np.inf, similarity).max(axis=1)
    return best, _distance(similarity[np.arange(n), best]), _distance(rival)


def _distance(dot: Array) -> Array:
    """Distance of unit vectors from their dot product; -inf (no candidate) is infinitely far."""
    return np.asarray(np.sqrt(np.maximum(2 - 2 * dot, 0)))


def _search(
    place1: Array,
    place2: Array,
    descriptors1: NDArray[np.float32],
    descriptors2: NDArray[np.float32],
    low: Array,
    high: Array,
    options: MatchOptions,
) -> Nearest:
    """Sort the second set by its place across the lines, so that a band is a slice, and search each slice."""
    order = np.argsort(place2[:, 0], kind="stable")
    best, dot, rival = _search_kernel(
        place1, place2[order], descriptors1, descriptors2[order], low, high, options.same_place_px
    )
    found = best >= 0
    best[found] = order[best[found]]
    return best, _distance(dot), _distance(rival)


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})  # type: ignore[untyped-decorator]
def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    total = np.float32(0.0)
    for k in range(a.shape[0]):
        total += a[k] * b[k]
    return float(total)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _search_kernel(
    place1: Array,
    place2: Array,
    descriptors1: NDArray[np.float32],
    descriptors2: NDArray[np.float32],
    low: Array,
    high: Array,
    same_place_px: float,
) -> Nearest:
    """Best candidate inside the window and best rival at another place; `place2` is sorted by its first column."""
    n, m = place1.shape[0], place2.shape[0]
    best = np.full(n, -1, dtype=np.int64)
    best_dot, rival_dot = np.full(n, -np.inf), np.full(n, -np.inf)
    dots = np.empty(m)
    for i in range(n):
        start = np.searchsorted(place2[:, 0], place1[i, 0] + low[0], side="left")
        stop = np.searchsorted(place2[:, 0], place1[i, 0] + high[0], side="right")
        for j in range(start, stop):
            offset = place2[j, 1] - place1[i, 1]
            if offset < low[1] or offset > high[1]:
                dots[j] = -np.inf
                continue
            dots[j] = _dot(descriptors1[i], descriptors2[j])
            if dots[j] > best_dot[i]:
                best[i], best_dot[i] = j, dots[j]
        for j in range(start, stop):
            if dots[j] > rival_dot[i]:
                apart = np.hypot(place2[j, 0] - place2[best[i], 0], place2[j, 1] - place2[best[i], 1])
                if apart > same_place_px:
                    rival_dot[i] = dots[j]
    return best, best_dot, rival_dot
