"""Accuracy regressions: what the study measures on small scenes stays where it was committed."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.regression import guarded_scenes, measured, read_baselines, shifts


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("number", [0, 1], ids=["pollen", "diatom"])
def test_accuracy_is_where_it_was(number: int, cache: Path) -> None:
    source = guarded_scenes(cache)[number]
    moved = shifts(source.name, measured(source), read_baselines())
    assert not moved, "\n".join(str(each) for each in moved)


def test_a_shift_is_seen() -> None:
    known = {"scene": {"proposed": {"rmse_um": {"mean": 1.0, "tolerance": 0.1}}}}
    for value, seen in ((1.05, False), (0.85, True), (1.2, True), (float("nan"), True)):
        now = {"proposed": {"rmse_um": {"mean": value, "tolerance": 0.1}}}
        assert bool(shifts("scene", now, known)) == seen
    assert "rmse_um was 1 and is nan" in str(shifts("scene", {}, known)[0])
