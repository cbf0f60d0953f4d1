"""A bar held against what was measured: asked for, found, and whether it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t

from benchmarks.judging.paired import CONFIDENCE, Interval
from semrecon.data import Array

INF = float("inf")


@dataclass(frozen=True)
class Asked:
    """What is asked of a number: to lie between two ends, both included.

    `text` says it where the ends do not ("at most 1/7").
    """

    least: float = -INF
    most: float = INF
    text: str = ""

    def __str__(self) -> str:
        """Say it."""
        if self.text:
            return self.text
        if np.isinf(self.least):
            return "-" if np.isinf(self.most) else f"at most {self.most:g}"
        return f"at least {self.least:g}" if np.isinf(self.most) else f"{self.least:g} to {self.most:g}"

    def met_by(self, value: float) -> bool:
        """Whether a number meets it; one that is missing does not."""
        return self.least <= value <= self.most

    @property
    def anything(self) -> bool:
        """Whether nothing is asked: the number is told beside others."""
        return self.least == -INF and self.most == INF


TOLD = Asked()
"""Nothing is asked."""


@dataclass(frozen=True)
class Line:
    """One line of the table.

    Parameters
    ----------
    bar, what
        Which bar, and of what: scene, dose, option.
    measured
        The number and its interval; NaN where it was not measured.
    note
        What must be read with it: completeness, what failed, what it was held against.
    detail
        Whether it only says more of what another line sums up.
    """

    bar: str
    what: str
    asked: Asked
    measured: Interval
    note: str = ""
    detail: bool = False

    @property
    def verdict(self) -> str:
        """Say whether the bar holds, and whether the interval leaves a doubt."""
        value, ends = self.measured.value, (self.measured.low, self.measured.high)
        if self.asked.anything:
            return ""
        if np.isnan(value):
            return "not measured"
        word = "holds" if self.holds else "fails"
        if not self.measured.known:
            return f"{word}, no interval"
        beside = all(end > self.asked.most for end in ends) or all(end < self.asked.least for end in ends)
        sure = all(self.asked.met_by(end) for end in ends) if self.holds else beside
        return word if sure else f"{word}, not settled"

    @property
    def holds(self) -> bool:
        """Whether the number meets what is asked."""
        return self.asked.met_by(self.measured.value)


def mean_over_specimens(groups: Sequence[Array]) -> Interval:
    """Mean of the means of some scenes, each known from a few specimens, with its 95 % interval.

    The scenes are those that were asked for, and only the specimens are drawn by chance: variances of the groups' means
    add, and Student's t has the degrees of freedom of Welch and Satterthwaite. A bootstrap needs more specimens than
    the three that are usual (`benchmarks.judging.paired.LEAST`): of three it draws ten different means at most.

    Parameters
    ----------
    groups
        Values of the specimens of each scene, (n,), none NaN; an infinite one makes the mean infinite.

    Returns
    -------
    Interval; without ends where a group has one value, or one that is infinite.
    """
    if not groups or any(not len(each) for each in groups):
        return Interval()
    mean = float(np.mean([np.mean(each) for each in groups]))
    if any(len(each) < 2 for each in groups) or not np.isfinite(mean):
        return Interval(mean)
    parts = np.array([np.var(each, ddof=1) / len(each) for each in groups]) / len(groups) ** 2
    if not parts.any():
        return Interval(mean, mean, mean)
    freedom = parts.sum() ** 2 / np.sum(parts**2 / [len(each) - 1 for each in groups])
    reach = float(t.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(parts.sum()))
    return Interval(mean, mean - reach, mean + reach)


def ratio_over_specimens(groups: Sequence[Array]) -> Interval:
    """Geometric mean of ratios over scenes and specimens, with its interval; see `mean_over_specimens`.

    A ratio that is infinite makes it so; one of 0 is as good as a ratio can be, and makes it 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = mean_over_specimens([np.log(each) for each in groups])
    return Interval(*(float(np.exp(each)) for each in (found.value, found.low, found.high)))


def worst_of(lines: Sequence[Line], what: str) -> Line:
    """Sum up lines of one bar by the one with the largest number; raises `ValueError` of none."""
    worst = max(lines, key=lambda line: INF if np.isnan(line.measured.value) else line.measured.value)
    kept = sum(line.holds for line in lines)
    note = f"the worst is {worst.what}; {kept} of {len(lines)} hold"
    return Line(worst.bar, what, worst.asked, worst.measured, "; ".join(filter(None, [note, worst.note])))
