"""Two contenders on the same pictures: differences within pairs, with bootstrap intervals, and what they allow to say.

A pair is one repetition of one scene, answered by both: same surface, same noise. On one scene the pairs are
resampled; over scenes it is the scenes, since repetitions of one scene share its surface and its difficulty. Lengths,
angles and times are compared by their ratio (scenes differ in size), shares by their difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from semrecon.data import Array

if TYPE_CHECKING:
    from benchmarks.running.bench_ledger import Result

Place = tuple[str, int]
"""Scene and repetition."""
LEAST = 6
"""Fewest units that carry an interval: of five, all favour one side by chance once in 16 times."""
CONFIDENCE = 0.95
DRAWS, SEED = 9_999, 20_260_101
SHARES = ("completeness", "fscore", "precision", "recall")
"""In the names of what is a share: more is better, and differences count."""
SIDELESS = ("bias", "split_", "within_", "points")
"""How the names of those begin of which neither more nor less is better ..."""
ERRORS_OF_POINTS = ("points_median_um", "points_rms_um", "points_precision_1px")
"""... but for these."""
NAN = float("nan")


@dataclass(frozen=True)
class Interval:
    """An estimate and its two-sided interval; the ends are NaN where too few units carry none."""

    value: float = NAN
    low: float = NAN
    high: float = NAN

    @property
    def known(self) -> bool:
        """Whether there is an interval."""
        return not (np.isnan(self.low) or np.isnan(self.high))

    def side(self, neutral: float) -> int:
        """-1 if all of it lies below a number, 1 if above, 0 if it holds it or there is none."""
        return 0 if not self.known else int(self.low > neutral) - int(self.high < neutral)


@dataclass(frozen=True)
class Line:
    """One score of both on one scene, or over all (`scene` is "").

    Parameters
    ----------
    method
        Of which two runs are compared; "" where two methods are.
    units
        What was resampled: pairs of one scene, or scenes.
    first, second
        Means over the pairs; over scenes, means of the scenes' means.
    difference, ratio
        First minus second, and first over second (geometric mean; NaN where a score is not positive).
    better, worse
        Pairs in which the first is better and worse; of a score without a better side, larger and smaller.
    only_first, only_second, neither
        Cases that only one side, or none, has a number for; they are in nothing above.
    """

    method: str
    scene: str
    metric: str
    scenes: int
    pairs: int
    units: int
    first: float
    second: float
    difference: Interval
    ratio: Interval
    better: int
    worse: int
    only_first: int
    only_second: int
    neither: int

    @property
    def by_ratio(self) -> bool:
        """Whether the ratio decides; else the difference does."""
        return not is_share(self.metric) and bool(np.isfinite(self.ratio.value))

    @property
    def same(self) -> bool:
        """Whether both have the very same number in every pair."""
        return self.pairs > 0 and self.better == self.worse == 0

    @property
    def claim(self) -> int:
        """1 if the first is better (or larger, without a better side), -1 if the second is, 0 if nothing is claimed."""
        side = self.ratio.side(1.0) if self.by_ratio else self.difference.side(0.0)
        return side * better_side(self.metric)


def is_share(metric: str) -> bool:
    """Whether a score is a share of something, 0 to 1."""
    return any(word in metric for word in SHARES)


def has_side(metric: str) -> bool:
    """Whether more, or less, of a score is better at all."""
    plain = metric.removeprefix("common_")
    return metric in ERRORS_OF_POINTS or not plain.startswith(SIDELESS)


def better_side(metric: str) -> int:
    """1 where more is better, or neither is; -1 where less is."""
    return 1 if is_share(metric) or not has_side(metric) else -1


def value_of(result: Result, metric: str) -> float:
    """Score of a case; NaN for a failure, and where the case has no such number."""
    if result.kind:
        return NAN
    return float(getattr(result, metric) if metric in ("seconds", "peak_mib") else result.metrics.get(metric, NAN))


def mean_interval(values: Array) -> Interval:
    """Mean with its bootstrap interval: percentiles, expanded for small samples (Hesterberg 2015, section 4.5).

    The plain percentile interval of the mean of n values is that of a normal distribution with the variance over n
    instead of n - 1, so too narrow: of six normal values it holds the truth 86 times in 100, BCa no oftener, the
    expanded one 93 times. The draws are the same for all values of one number: what is turned round gives the interval
    turned round, and the same values the same ends.

    Parameters
    ----------
    values
        (n,), not NaN; infinite ones are kept, and so make an end, or all, of the interval infinite.
    """
    values = np.asarray(values, dtype=np.float64)
    if not values.size:
        return Interval()
    with np.errstate(invalid="ignore"):
        mean = float(values.mean())
        if values.size < LEAST:
            return Interval(mean)
        drawn = values[_draws(values.size)].mean(axis=1)
    if np.isnan(drawn).any():
        return Interval(mean, -np.inf, np.inf)  # infinitely better in one pair and worse in another
    drawn.sort()
    last = int(_tail(values.size) * DRAWS)
    return Interval(mean, float(drawn[last]), float(drawn[-1 - last]))


def _tail(count: int) -> float:
    """Share of the draws beyond each end, alpha' of Hesterberg (2015)."""
    return float(norm.cdf(np.sqrt(count / (count - 1)) * t.ppf((1 - CONFIDENCE) / 2, count - 1)))


@cache
def _draws(count: int) -> NDArray[np.int64]:
    return np.random.default_rng(SEED).integers(count, size=(DRAWS, count))


def lines(first: Sequence[Result], second: Sequence[Result], metrics: Sequence[str], method: str = "") -> list[Line]:
    """Compare two contenders scene by scene and, where there is more than one scene, over all: for each metric.

    Parameters
    ----------
    first, second
        Their results; cases that only one side was asked are left out.
    """
    ones, others = ({(each.scene, each.repetition): each for each in side} for side in (first, second))
    asked = [place for place in ones if place in others]
    scenes = list(dict.fromkeys(scene for scene, _ in asked))
    answer = []
    for metric in metrics:
        at = {p: (value_of(ones[p], metric), value_of(others[p], metric)) for p in asked}
        of_scene = [_line(method, scene, metric, {p: at[p] for p in at if p[0] == scene}) for scene in scenes]
        answer += ([_line(method, "", metric, at)] if len(scenes) > 1 else []) + of_scene
    return answer


def _line(method: str, scene: str, metric: str, values: Mapping[Place, tuple[float, float]]) -> Line:
    pairs = {place: each for place, each in values.items() if not np.isnan(each).any()}
    a, b = np.array(list(pairs.values())).reshape(-1, 2).T
    groups = [place[0] if not scene else str(place[1]) for place in pairs]
    with np.errstate(invalid="ignore", divide="ignore"):
        differences = np.where(a == b, 0.0, a - b)  # both infinitely wrong: no difference
        positive = bool((np.minimum(a, b) > 0).all() and a.size)
        logs = np.where(a == b, 0.0, np.log(a) - np.log(b)) if positive else np.array([])
    side = np.sign(differences) * better_side(metric)
    lacks = np.isnan(np.array(list(values.values())).reshape(-1, 2))
    units = len(set(groups))
    return Line(
        method,
        scene,
        metric,
        len({place[0] for place in pairs}),
        len(pairs),
        units,
        _mean(_grouped(a, groups)),
        _mean(_grouped(b, groups)),
        mean_interval(_grouped(differences, groups)),
        _exponential(mean_interval(_grouped(logs, groups))) if positive else Interval(),
        int((side > 0).sum()),
        int((side < 0).sum()),
        int((~lacks[:, 0] & lacks[:, 1]).sum()),
        int((lacks[:, 0] & ~lacks[:, 1]).sum()),
        int(lacks.all(axis=1).sum()),
    )


def _grouped(values: Array, groups: Sequence[str]) -> Array:
    """Mean of each group, in the order in which they come."""
    of = np.array(groups)
    with np.errstate(invalid="ignore"):
        return np.array([values[of == group].mean() for group in dict.fromkeys(groups)])


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else NAN


def _exponential(interval: Interval) -> Interval:
    return Interval(*(float(np.exp(each)) for each in (interval.value, interval.low, interval.high)))
