"""Methods under guard on small scenes: accuracy as committed and, unless benchmarks are disabled, speed."""

from __future__ import annotations

from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from benchmarks.gate.commitment import read_commitment, report, shifts
from benchmarks.gate.methods import measured, method_call, small_scenes
from benchmarks.gate.pace import read_paces, slower
from benchmarks.gate.project import ACCURACY, RENEW, RENEW_TIME, TIME, timed_on
from benchmarks.running.bench import contenders
from semrecon.methods import METHODS

PART = read_commitment(ACCURACY)["methods"]
PAIRS = [(scene, method) for scene, methods in PART.bounds.items() for method in methods]


@pytest.mark.filterwarnings("ignore:Benchmark fixture was not used")  # where a figure moved before it could be
@pytest.mark.benchmark(group="methods under guard")
@pytest.mark.parametrize(("scene", "method"), PAIRS, ids=[f"{method}-{scene}" for scene, method in PAIRS])
def test_method(benchmark: BenchmarkFixture, cache: Path, scene: str, method: str) -> None:
    (small,), (asked,) = small_scenes(cache, [scene], PART.columns), contenders([method])
    found, call = measured(small, [asked], PART.repetitions), method_call(small, asked)
    benchmark.extra_info |= found.means[method]
    moved = shifts(scene, found.means, PART.only(scene, method), found.refusals)
    if moved:
        pytest.fail(report(moved, RENEW), pytrace=False)
    benchmark.pedantic(call, rounds=1)  # type: ignore[no-untyped-call]
    if not benchmark.disabled and scene == timed_on(method):
        benchmark.extra_info["ratio"], slow = slower(method, read_paces(TIME)[method], call)
        if slow:
            pytest.fail(report([slow], RENEW_TIME), pytrace=False)


def test_all_methods_are_committed_to() -> None:
    names = {method.name for method in METHODS}
    assert {method for _, method in PAIRS} == names, f"run `{RENEW} --only methods`"
    assert set(read_paces(TIME)) >= names, f"run `{RENEW_TIME}`"
