"""Claims on tracks: what was shuffled is put together again, and contradictions are split at the weakest match."""

import numpy as np

from semrecon.matches.correspondence import PairMatches
from semrecon.matches.matching import Matches
from semrecon.matches.tracks import join_matches


def pair_of(views, xy1, xy2, index1, index2, distance):
    matches = Matches(np.asarray(xy1, float), np.asarray(xy2, float), np.asarray(index1), np.asarray(index2),
                      np.asarray(distance, float))  # fmt: skip
    return PairMatches(views, matches, len(matches), (0, 0), 0.0, 0.0, (0.0, 0.0))


def shuffled_series(rng, points=60, views=4, seen=0.7):
    """True tracks, and the matches of all pairs with each view's places in its own order."""
    xy = rng.uniform(0, 500, (points, views, 2))
    xy[rng.random((points, views)) > seen] = np.nan
    order = [rng.permutation(points) for _ in range(views)]
    pairs = []
    for i in range(views):
        for j in range(i + 1, views):
            both = np.flatnonzero(np.isfinite(xy[:, [i, j]]).all(axis=(1, 2)))
            pairs.append(
                pair_of((i, j), xy[both, i], xy[both, j], order[i][both], order[j][both], rng.random(len(both)))
            )
    return xy[np.isfinite(xy).all(axis=2).sum(axis=1) > 1], pairs


def as_set(xy_px):
    return {track.tobytes() for track in np.nan_to_num(xy_px, nan=-1.0)}


def test_shuffled_places_come_together_again_in_any_order():
    rng = np.random.default_rng(0)
    truth, pairs = shuffled_series(rng)
    tracks = join_matches(pairs, 4)
    assert as_set(tracks.xy_px) == as_set(truth)
    again = join_matches([pairs[k] for k in rng.permutation(len(pairs))], 4)
    assert np.array_equal(tracks.xy_px, again.xy_px, equal_nan=True)
    assert np.array_equal(tracks.seen, np.isfinite(tracks.xy_px).all(axis=2))


def test_a_chain_of_adjacent_pairs_joins_views_that_were_never_matched():
    step = [pair_of((i, i + 1), [[i, 0.0]], [[i + 1, 0.0]], [5 - i], [4 - i], [0.1]) for i in range(3)]
    tracks = join_matches(step, 4)
    np.testing.assert_array_equal(tracks.xy_px[0, :, 0], [0, 1, 2, 3])
    assert len(tracks) == 1


def test_a_contradiction_is_split_at_the_weakest_match():
    # place 0 and place 1 of view 0 both lead to place 0 of view 2, the latter by a poor match
    pairs = [
        pair_of((0, 1), [[0, 0], [9, 9]], [[1, 0], [8, 9]], [0, 1], [0, 1], [0.1, 0.1]),
        pair_of((1, 2), [[1, 0]], [[2, 0]], [0], [0], [0.2]),
        pair_of((0, 2), [[9, 9]], [[2, 0]], [1], [0], [0.6]),
    ]
    tracks = join_matches(pairs, 3)
    expected = np.array([[[0, 0], [1, 0], [2, 0]], [[9, 9], [8, 9], [np.nan, np.nan]]])
    np.testing.assert_array_equal(tracks.xy_px, expected)


def test_no_pairs_are_no_tracks():
    assert join_matches([], 3).xy_px.shape == (0, 3, 2)
    empty = pair_of((0, 1), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    assert len(join_matches([empty], 3)) == 0
