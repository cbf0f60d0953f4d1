"""The seed's study under guard: what it measures on small scenes stays where it was committed."""

from __future__ import annotations

from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from benchmarks.gate.commitment import means_of, read_commitment, report, shifts
from benchmarks.gate.project import ACCURACY, RENEW
from benchmarks.gate.study import study_figures, study_scenes


@pytest.mark.benchmark(group="the seed's study")
@pytest.mark.parametrize("number", [0, 1], ids=["pollen", "diatom"])
def test_study(benchmark: BenchmarkFixture, number: int, cache: Path) -> None:
    part, source = read_commitment(ACCURACY)["study"], study_scenes(cache)[number]
    source.prepare()
    figures = benchmark.pedantic(study_figures, args=(source, part.repetitions), rounds=1)  # type: ignore[no-untyped-call]
    now = means_of(figures)
    benchmark.extra_info |= now
    moved = shifts(source.name, now, part)
    if moved:
        pytest.fail(report(moved, RENEW), pytrace=False)
