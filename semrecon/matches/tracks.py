"""Tracks: matches of many pairs of views joined into the sightings of one specimen point."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from semrecon.data import Tracks
from semrecon.matches.correspondence import PairMatches

Index = NDArray[np.int64]


def join_matches(pairs: Sequence[PairMatches], n_views: int) -> Tracks:
    """Join matches into tracks, each view at most once a track.

    Matches are taken in order of descriptor distance, the surest first, and join what they connect (union-find). A
    match that would give a track two places of one view is refused, so that contradictory groups are split at their
    weakest match. Order and answer do not depend on the order of `pairs`.

    Parameters
    ----------
    pairs
        Matches of pairs of views; places of a view are numbered alike in all of them.
    n_views
        Views of the series.

    Returns
    -------
    Tracks of two or more views, in order of their first view and its place there.
    """
    pairs = sorted(pairs, key=lambda one: one.pair)
    if not pairs:
        return Tracks(np.zeros((0, n_views, 2)))
    node1, node2, distance, view, xy = _graph(pairs, n_views)
    order = np.lexsort((node2, node1, distance))
    root = _join(node1[order], node2[order], view, n_views)
    members, track = np.flatnonzero(np.bincount(root, minlength=len(root))[root] > 1), root
    roots, number = np.unique(track[members], return_inverse=True)
    xy_px = np.full((len(roots), n_views, 2), np.nan)
    xy_px[number, view[members]] = xy[members]
    return Tracks(xy_px)


def _graph(
    pairs: Sequence[PairMatches], n_views: int
) -> tuple[Index, Index, NDArray[np.float64], Index, NDArray[np.float64]]:
    """Draw the graph of all places: ends and distance of each match, view and position of each place."""
    sizes = np.zeros(n_views, dtype=np.int64)
    for one in pairs:
        for view, index in zip(one.pair, (one.matches.index1, one.matches.index2), strict=True):
            sizes[view] = max(sizes[view], index.max(initial=-1) + 1)
    start = np.concatenate([[0], np.cumsum(sizes)])
    xy = np.full((start[-1], 2), np.nan)
    for one in pairs:
        xy[start[one.pair[0]] + one.matches.index1] = one.matches.xy1_px
        xy[start[one.pair[1]] + one.matches.index2] = one.matches.xy2_px
    node1 = np.concatenate([start[one.pair[0]] + one.matches.index1 for one in pairs])
    node2 = np.concatenate([start[one.pair[1]] + one.matches.index2 for one in pairs])
    distance = np.concatenate([one.matches.distance for one in pairs])
    return node1, node2, distance, np.repeat(np.arange(n_views), sizes), xy


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _join(node1: Index, node2: Index, view: Index, n_views: int) -> Index:
    """Union-find over matches in the order given; returns the smallest node of each node's track."""
    parent = np.arange(len(view))
    taken = np.zeros((len(view), n_views), dtype=np.bool_)
    for node in range(len(view)):
        taken[node, view[node]] = True
    for k in range(len(node1)):
        a, b = _root(parent, node1[k]), _root(parent, node2[k])
        if a == b or (taken[a] & taken[b]).any():
            continue
        low, high = min(a, b), max(a, b)
        parent[high] = low
        taken[low] |= taken[high]
    return np.array([_root(parent, node) for node in range(len(view))])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _root(parent: Index, node: int) -> int:
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node
