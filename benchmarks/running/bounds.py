"""The physical limit of each scene of a run, and of what each answer covers: worked out once, kept in the ledger."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from benchmarks.judging.efficiency import SceneLimit, scene_limit
from benchmarks.judging.judge import filled
from benchmarks.running.bench import Plan, Report
from benchmarks.running.bench_ledger import BenchLedger, Result
from benchmarks.running.case import Case, judge_version
from benchmarks.running.runner import code_version, completed
from benchmarks.running.stored import unpacked
from benchmarks.suite import BenchScene

DECIDING = (
    "benchmarks/judging/limits.py",
    "benchmarks/judging/efficiency.py",
    "benchmarks/running/bounds.py",
    "semrecon/surface/meshing.py",
)
"""What decides a limit, given a scene and an answer; the code of the simulator is in the identity of the scene."""


def limits_version() -> str:
    """Digest of all that decides a limit, given a scene and an answer."""
    return code_version(*DECIDING)


def add_bounds(plan: Plan, ledger: BenchLedger, executor: Executor, report: Report) -> list[Result]:
    """Put the limit beside the scores of a plan that was measured; return all results, now with their efficiency.

    What is on record is not worked out again: neither scenes when a method is added, nor answers when a run goes on.
    """
    version, judge = limits_version(), judge_version()
    identities = {scene.name: scene.identity for scene in plan.scenes}
    lacking = [each for each in plan.scenes if ledger.limit(identities[each.name], version) is None]
    report("physical limit", len(plan.scenes) - len(lacking), len(plan.scenes))
    for identity, limit in completed(((_limited, (each,)) for each in lacking), executor):
        ledger.record_limit(identity, version, limit)
        report("physical limit", 1, len(plan.scenes))
    wanted = plan.cases
    answered = {each.key for each in ledger.results([case.key for case in wanted], judge) if not each.kind}
    for scene in plan.scenes:
        of_scene = [case for case in wanted if case.scene == scene and case.key in answered]
        open_cases = [case for case in of_scene if not ledger.bounded(case.key, version)]
        calls = ((_bounded, (case, identities[scene.name], ledger.path)) for case in open_cases)
        ledger.record_bounds(version, dict(completed(calls, executor)))
    return ledger.results([case.key for case in wanted], judge)


def reasons(scenes: Sequence[tuple[str, str]], ledger: BenchLedger) -> dict[str, str]:
    """Say why scenes, given as name and identity, have no limit on record; those that have one are left out."""
    answer = {}
    for name, identity in scenes:
        limit = ledger.limit(identity)
        reason = "it was not worked out; repeat the command of the run" if limit is None else limit.reason
        if reason:
            answer[name] = reason
    return answer


def covered_bound_um(case: Case, limit: SceneLimit, ledger: BenchLedger) -> float:
    """Limit over the pixels at which an answer has a height, filled as the judge does; NaN where there is none."""
    estimate = unpacked(ledger.answer(case).estimate)
    heights = estimate.heights or filled(estimate, case.scene.series(case.repetition))
    if heights is None or limit.reason or heights.z_um.shape != limit.sigma_um.shape:
        return float("nan")
    return limit.over(np.isfinite(heights.z_um))


def _limited(scene: BenchScene) -> tuple[str, SceneLimit]:
    return scene.identity, scene_limit(scene.source.surfaces())


def _bounded(case: Case, identity: str, path: Path) -> tuple[str, float]:
    """Work it out from the record; the worker reads it, so that estimates do not wait in a queue."""
    ledger = BenchLedger(path)
    limit = ledger.limit(identity)
    assert limit is not None, "the limit of a scene is recorded before it is asked for"
    return case.key, covered_bound_um(case, limit, ledger)
