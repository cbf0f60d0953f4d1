"""Real micrographs, where there is no truth: a picture that no method was given is predicted from its surface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bars.entrants import DENSE, dense
from benchmarks.bars.line import TOLD, Asked, Line
from benchmarks.bars.plan import Found
from benchmarks.bars.real import BAR, QUICK, SERIES, read_series, real_files
from benchmarks.judging.paired import Interval
from benchmarks.running.ledger import Row
from benchmarks.running.runner import Job, code_version, digest
from benchmarks.scenes import RealSource
from semrecon.agreement.left_out import LeftOut, leave_out
from semrecon.agreement.left_out_score import score
from semrecon.methods import method_named

LEFT_OUT = (1, 4)
"""Views left out, each in turn: neither at an end of the series nor the reference."""
SHARE = 0.5
"""The middle of the pictures, by width and height: to predict all of them takes six surfaces half an hour."""
RIVALS = ("known_rotation", "disparity", "disparity_icp", "affine_factorization", "multiview_sfm")
"""Contenders that make a metric surface, or one that is so up to its gauge, of a tilt series seen by one detector."""
SCORES = ("ncc", "local_ncc", "rms_grey", "median_grey", "share")
BETTER, LESS = Asked(least=0.0), Asked(most=1.0)


def left_out_jobs(*, quick: bool) -> list[Job]:
    """One job a view, with a row for each contender; none where there are no pictures."""
    files = real_files()
    if not files:
        return []
    share = QUICK if quick else SHARE
    identity = RealSource(SERIES, read_series(files, share)).identity
    version = code_version("semrecon", "benchmarks/bars/left_out.py")
    answer = []
    for view in LEFT_OUT:
        keys = tuple(digest("left out", identity, view, repr(each), version) for each in others())
        answer.append(Job(keys, measured, (files, view, share, keys)))
    return answer


def others() -> tuple[Any, ...]:
    """Make the contenders that the dense method is held against."""
    return tuple(method_named(name) for name in RIVALS)


def measured(files: tuple[Path, ...], view: int, share: float, keys: tuple[str, ...]) -> list[Row]:
    """Predict one view by the dense method and by each other one, and compare where both have a prediction."""
    series = read_series(files, share)
    ours, *theirs = leave_out(series, view, (dense(), *others()))
    rows = []
    for key, method, each in zip(keys, others(), theirs, strict=True):
        said = next(
            (f"{who}: {found}" for who, found in ((DENSE, ours), (method.name, each)) if isinstance(found, str)), ""
        )
        numbers = {} if isinstance(ours, str) or isinstance(each, str) else compared(ours, each)
        rows.append(Row(key, BAR, scene_name(view), method.name, view, numbers, " ".join(said.split())))
    return rows


def compared(ours: LeftOut, other: LeftOut) -> dict[str, float]:
    """Score two predictions of one view at the pixels that both have: `..._dense` are those of the first."""
    both = ours.prediction.known & other.prediction.known
    scores = ("_dense", score(ours.prediction, both)), ("", score(other.prediction, both))
    return {name + ending: float(getattr(found, name)) for ending, found in scores for name in SCORES}


def scene_name(view: int) -> str:
    """Name a series that lacks a view."""
    return f"{SERIES} without view {view}"


def left_out_lines(found: Found) -> list[Line]:
    """Hold the dense prediction against that of the best other contender."""
    if not real_files():
        return []
    rows = [found.rows[BAR, scene_name(view), each.name] for view in LEFT_OUT for each in others()]
    answered = [row for row in rows if not row.failure]
    said = "; ".join(dict.fromkeys(row.failure for row in rows if row.failure))
    if not answered:
        return [Line(BAR, f"{SERIES}, a view left out", BETTER, Interval(), said)]
    lines = [
        _nearest(answered, "ncc", "correlation with"),
        _nearest(answered, "local_ncc", "correlation within 3 px with"),
        _nearest(answered, "rms_grey", "rms residual in grey levels of"),
        _nearest(answered, "median_grey", "median residual in grey levels of"),
    ]
    return lines + ([Line(BAR, f"{SERIES}, a view left out: no answer", TOLD, Interval(), said, True)] if said else [])


def _nearest(rows: list[Row], name: str, what: str) -> Line:
    """Take the contender that comes nearest over the views left out: by difference, or ratio of residuals."""
    grey = name.endswith("grey")
    means = {}
    for contender in dict.fromkeys(row.contender for row in rows):
        own = [row.metrics for row in rows if row.contender == contender]
        means[contender] = tuple(float(np.mean([each[name + end] for each in own])) for end in ("_dense", ""))
    value = {who: (a / b if grey else a - b) for who, (a, b) in means.items()}
    best = max(value, key=lambda who: value[who]) if grey else min(value, key=lambda who: value[who])
    ours, theirs = means[best]
    views = sum(row.contender == best for row in rows)
    note = f"{ours:.4g} against {theirs:.4g} of {best}, mean over {views} views, at pixels that both predict"
    of = f"{SERIES}, middle: {what} a view left out, {'over' if grey else 'above'} the best other"
    return Line(BAR, of, LESS if grey else BETTER, Interval(value[best]), note)
