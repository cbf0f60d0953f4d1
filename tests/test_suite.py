"""The suite offers what it says, and tuning shares nothing with reporting."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.running.case import cases, is_oracle, unfit
from benchmarks.suite import REAL_DATA, chosen, suite
from semrecon.errors import InputError
from semrecon.methods import METHODS


@pytest.fixture(autouse=True)
def _no_real_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(REAL_DATA, raising=False)


def test_there_are_scenes_enough_and_each_says_what_it_is(tmp_path: Path) -> None:
    scenes = suite(tmp_path)
    assert len(scenes) >= 8
    assert {"pollen", "diatom", "fracture_rough", "fracture_smooth", "grains", "steps", "spheres"} <= {
        each.name for each in scenes
    }
    assert all(each.about.endswith(".") for each in scenes)
    assert len({each.identity for each in scenes}) == len(scenes)


def test_offers_are_what_the_settings_say(tmp_path: Path) -> None:
    for each in suite(tmp_path):
        settings = each.source.scene
        assert ("rotations" in each.offers) == (len(set(settings.schedule.tilts_deg)) > 1)
        assert ("perspective" in each.offers) == (settings.microscope.working_distance_um is not None)
        assert ("stage_path" in each.offers) == bool(settings.schedule.shifts_um)
        assert settings.signal.backscatter is not None
    assert "rotations" not in next(each for each in suite(tmp_path) if each.name == "translation").offers


def test_development_and_reporting_share_neither_specimen_nor_noise(tmp_path: Path) -> None:
    for tuned, told in zip(suite(tmp_path, purpose="development"), suite(tmp_path, purpose="reporting"), strict=True):
        assert tuned.name == told.name
        assert tuned.source.scene.specimen_seed != told.source.scene.specimen_seed
        assert not {tuned.seed(i) for i in range(9)} & {told.seed(i) for i in range(9)}
        assert tuned.source.name != told.source.name  # decides the seed of the noise
        assert tuned.identity != told.identity


def test_seeds_are_the_same_for_all_methods(tmp_path: Path) -> None:
    scenes = suite(tmp_path, quick=True)[:2]
    every = cases(scenes, METHODS, 2)
    assert len({each.key for each in every}) == len(every) == 2 * 2 * len(METHODS)
    assert len({each.scene.seed(each.repetition) for each in every}) == 4


def test_quick_is_smaller_and_another_case(tmp_path: Path) -> None:
    for small, full in zip(suite(tmp_path, quick=True), suite(tmp_path), strict=True):
        one, other = small.source.scene.microscope, full.source.scene.microscope
        assert 400 <= one.width_px <= 430 <= 600 <= other.width_px <= 660
        assert one.width_px * one.pixel_size_um == pytest.approx(other.width_px * other.pixel_size_um, rel=5e-3)
        assert small.identity != full.identity


def test_what_a_scene_does_not_offer_is_a_sentence(tmp_path: Path) -> None:
    sliding = chosen(suite(tmp_path), ["translation"])
    tilting = [case for case in cases(sliding, METHODS, 1) if "rotations" in case.method.needs]
    assert tilting
    for case in tilting:
        answer = unfit(case)
        assert answer is not None
        assert answer.kind == "needs"
        assert answer.failure == "needs rotations, which this scene does not offer"
    assert not any(is_oracle(method) for method in METHODS)


def test_a_scene_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scene 'moon'; there are pollen"):
        chosen(suite(tmp_path), ["pollen", "moon"])


def test_real_surfaces_stand_in_the_suite_where_they_are(
    tmp_path: Path, real_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(REAL_DATA, str(real_data))
    names = {each.name: each for each in suite(tmp_path, quick=True)}
    assert {"ct_grains", "focus_variation"} <= set(names)
    assert all(names[name].content for name in ("ct_grains", "focus_variation"))
