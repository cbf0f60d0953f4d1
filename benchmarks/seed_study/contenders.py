"""Contenders of the seed's study: other geometry on the same matches, so that nothing else makes a difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from semrecon.data import PointCloud, TiltSeries
from semrecon.matches.correspondence import PairMatches
from semrecon.methods.disparity import map_pair
from semrecon.methods.known_rotation import reconstruct_pair

CloudOfPair = Callable[[TiltSeries, PairMatches], PointCloud]
ALL_VIEWS = "known_rotation_all_views"
"""The proposed geometry with all views at once: there are no clouds to register, so it has depth errors only."""


@dataclass(frozen=True)
class Contender:
    """A way from the matches of a pair to a cloud in the view frame of the pair's first view."""

    name: str
    cloud: CloudOfPair

    def clouds(self, series: TiltSeries, matches: Sequence[PairMatches]) -> tuple[PointCloud, ...]:
        """Make the cloud of every pair."""
        return tuple(self.cloud(series, pair) for pair in matches)


CONTENDERS = (
    Contender("proposed", reconstruct_pair),
    Contender("disparity_printed", partial(map_pair, variant="printed")),
    Contender("disparity_symmetric", partial(map_pair, variant="symmetric")),
    Contender("disparity_boyde", partial(map_pair, variant="boyde")),
)
"""The first is the seed's method, the second its control; the others are the control with its geometry put right."""
