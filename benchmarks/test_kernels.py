"""Kernels under guard: accuracy as committed and, unless benchmarks are disabled, speed beside a reference."""

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from benchmarks.gate.commitment import means_of, read_commitment, report, shifts
from benchmarks.gate.kernels import KERNELS, SCENE, Kernel
from benchmarks.gate.pace import read_paces, slower
from benchmarks.gate.project import ACCURACY, RENEW, RENEW_TIME, TIME


@pytest.mark.filterwarnings("ignore:Benchmark fixture was not used")  # where a figure moved before it could be
@pytest.mark.benchmark(group="kernels under guard")
@pytest.mark.parametrize("kernel", KERNELS, ids=[kernel.name.replace(" ", "_") for kernel in KERNELS])
def test_kernel(benchmark: BenchmarkFixture, kernel: Kernel) -> None:
    part = read_commitment(ACCURACY)["kernels"]
    now, call = means_of({kernel.name: kernel.figures(part.repetitions)}), kernel.trial(0).call
    benchmark.extra_info |= now[kernel.name]
    moved = shifts(SCENE, now, part.only(SCENE, kernel.name))
    if moved:
        pytest.fail(report(moved, RENEW), pytrace=False)
    benchmark.pedantic(call, rounds=3)  # type: ignore[no-untyped-call]
    if not benchmark.disabled:
        benchmark.extra_info["ratio"], slow = slower(kernel.name, read_paces(TIME)[kernel.name], call)
        if slow:
            pytest.fail(report([slow], RENEW_TIME), pytrace=False)


def test_all_kernels_are_committed_to() -> None:
    names = {kernel.name for kernel in KERNELS}
    assert set(read_commitment(ACCURACY)["kernels"].bounds[SCENE]) == names, f"run `{RENEW} --only kernels`"
    assert set(read_paces(TIME)) >= names, f"run `{RENEW_TIME}`"
