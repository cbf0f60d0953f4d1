"""Training sets: resumable, whole folders, the same bits in any order and by any number of workers."""

import csv
import json
import multiprocessing
import re
import statistics
from pathlib import Path

import numpy as np
import pytest

import semsim.dataset as training
from semsim.capture import simulate
from semsim.dataset import Sample, plan, render_dataset
from semsim.errors import InputError
from semsim.overrides import overridden
from semsim.scenes import load_scene, scene
from semsim.variation import Variation, variation

TINY = {"specimen.edge_um": 4.0, "microscope.width_px": 32, "microscope.height_px": 24, "schedule.tilts_deg": [0, 8]}
WEDGE, PLANE = (overridden(scene(name), TINY) for name in ("wedge", "plane"))
DOSE = Variation("detector.dose_e", 50.0, 500.0)


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def rows(index: Path) -> list[dict[str, str]]:
    with index.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def samples() -> tuple[Sample, ...]:
    return plan([WEDGE, PLANE], 2, [DOSE])


@pytest.fixture(scope="module")
def rendered(samples, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("training") / "set"
    render_dataset(samples, out)
    return out


def test_each_series_stands_in_a_folder_and_in_the_index(samples, rendered):
    names = ["wedge_0000", "wedge_0001", "plane_0000", "plane_0001"]
    assert [sample.folder for sample in samples] == names
    assert sorted(path.name for path in rendered.iterdir()) == sorted([*names, "index.csv"])
    for row, sample in zip(rows(rendered / "index.csv"), samples, strict=True):
        settings = load_scene(rendered / row["folder"] / "truth" / "settings.toml")
        assert settings == sample.scene
        assert float(row["detector.dose_e"]) == settings.detector.dose_e == sample.varied["detector.dose_e"]
        assert int(row["specimen_seed"]) == settings.specimen_seed
        assert int(row["noise_seed"]) == sample.noise_seed
        assert row["scene"] == settings.name


def test_a_row_of_the_index_is_enough_to_render_the_series_again(samples, rendered):
    import tifffile

    row = rows(rendered / "index.csv")[1]
    settings = load_scene(rendered / row["folder"] / "truth" / "settings.toml")
    again = simulate(settings, int(row["noise_seed"])).images[1]
    assert np.array_equal(again, tifffile.imread(rendered / row["folder"] / "view_01.tif"))


def test_every_series_has_a_specimen_and_a_noise_of_its_own(samples):
    seeds = [
        seed for each in samples for seed in (each.scene.specimen_seed, each.scene.instrument_seed, each.noise_seed)
    ]
    assert len(set(seeds)) == 3 * len(samples)
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_another_order_gives_the_same_bits(samples, rendered, tmp_path):
    render_dataset(samples[::-1], tmp_path / "set")
    there, here = files(rendered), files(tmp_path / "set")
    assert here.pop("index.csv") != there.pop("index.csv")
    assert here == there


def test_two_workers_give_the_same_bits(samples, rendered, tmp_path):
    render_dataset(samples, tmp_path / "set", workers=2)
    assert files(tmp_path / "set") == files(rendered)
    assert not multiprocessing.active_children()


def test_a_run_that_was_stopped_goes_on_and_keeps_what_is_there(samples, rendered, tmp_path, monkeypatch):
    out, begun = tmp_path / "set", []
    whole = training.write_series

    def stopped(capture, folder, seed):
        if len(begun) == 2:
            (folder.parent / f".{folder.name}.999999999.partial").mkdir()  # as a process killed outright leaves it
            raise KeyboardInterrupt
        begun.append(folder.name)
        return whole(capture, folder, seed)

    monkeypatch.setattr(training, "write_series", stopped)
    with pytest.raises(KeyboardInterrupt):
        render_dataset(samples, out)
    assert [row["folder"] for row in rows(out / "index.csv")] == begun == ["wedge_0000", "wedge_0001"]
    first = (out / "wedge_0000" / "view_00.tif").stat().st_mtime_ns

    told = []
    monkeypatch.setattr(training, "write_series", whole)
    render_dataset(samples, out, progress=lambda *step: told.append(step))
    assert told == [("plane_0000", 3, 4), ("plane_0001", 4, 4)]
    assert files(out) == files(rendered)
    assert (out / "wedge_0000" / "view_00.tif").stat().st_mtime_ns == first
    assert not list(out.glob(".*"))


def test_a_set_grows_by_seeds_and_scenes(rendered, tmp_path):
    out = tmp_path / "set"
    render_dataset(plan([PLANE], 1, [DOSE]), out)
    render_dataset(plan([WEDGE], 2, [DOSE]), out)
    render_dataset(plan([WEDGE, PLANE], 2, [DOSE]), out)
    assert files(out) == files(rendered)


def test_a_drawn_value_does_not_depend_on_what_else_is_drawn():
    alone, beside = (plan([WEDGE], 3, variations) for variations in ([DOSE], [Variation("detector.bits", 8, 8), DOSE]))
    assert [each.varied["detector.dose_e"] for each in alone] == [each.varied["detector.dose_e"] for each in beside]


def test_draws_fill_their_range():
    """Two-sided: the mean of 300 uniform draws has a sigma of range / sqrt(12 * 300)."""
    drawn = [Variation("detector.dose_e", 100, 200).draw(WEDGE, seed) for seed in range(300)]
    assert abs(statistics.fmean(drawn) - 150) < 4 * 100 / np.sqrt(12 * 300)
    assert abs(statistics.pstdev(drawn) - 100 / np.sqrt(12)) < 4 * 100 / np.sqrt(12) / np.sqrt(2 * 300)
    assert 100 <= min(drawn) < 105 < 195 < max(drawn) <= 200


def test_logarithmic_draws_are_even_over_the_logarithm():
    spread = Variation("detector.dose_e", 10.0, 1000.0, logarithmic=True)
    below = [spread.draw(WEDGE, seed) < 100 for seed in range(300)]
    assert abs(sum(below) - 150) < 4 * np.sqrt(300) / 2


def test_whole_numbers_stay_whole_and_choices_are_all_met():
    both = [Variation("microscope.height_px", 20, 22), variation("detector.contrast=series,view")]
    drawn = plan([WEDGE], 40, both)
    assert {each.scene.microscope.height_px for each in drawn} == {20, 21, 22}
    assert {each.scene.detector.contrast for each in drawn} == {"series", "view"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("detector.dose_e=50:500", Variation("detector.dose_e", 50, 500)),
        ("detector.dose_e = 50 : 5e2 : log", Variation("detector.dose_e", 50, 500.0, logarithmic=True)),
        ("detector.bits=8,16", Variation("detector.bits", choices=(8, 16))),
        ("detector.bits=8", Variation("detector.bits", choices=(8,))),
        ("detector.contrast=series, view", Variation("detector.contrast", choices=("series", "view"))),
        ("schedule.tilts_deg=[0,3],[0,9]", Variation("schedule.tilts_deg", choices=([0, 3], [0, 9]))),
    ],
)
def test_variations_as_they_are_typed(text, expected):
    assert variation(text) == expected


@pytest.mark.parametrize("text", ["dose", "a.b=1:2:3:4", "a.b=1:x", "a.b=word", "a.b=2:1", "a.b=0:1:log", "a.b=nan:1"])
def test_what_is_no_variation_is_refused(text):
    with pytest.raises(InputError):
        variation(text)


def test_bad_plans_are_refused():
    with pytest.raises(InputError, match="1 seed or more, not 0"):
        plan([WEDGE], 0)
    with pytest.raises(InputError, match="two scenes are called wedge"):
        plan([WEDGE, WEDGE], 1)
    with pytest.raises(InputError, match="unknown key dose"):
        plan([WEDGE], 1, [Variation("detector.dose", 1.0, 2.0)])


def test_other_settings_do_not_mix_with_a_set_that_is_there(rendered):
    before = files(rendered)
    other = plan([WEDGE], 2, [Variation("detector.dose_e", 50.0, 501.0)])
    with pytest.raises(InputError, match=r"wedge_0000 was rendered with other settings"):
        render_dataset(other, rendered)
    assert files(rendered) == before


def test_a_folder_that_holds_something_else_is_left_alone(samples, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        render_dataset(samples, tmp_path)
    assert files(tmp_path) == {"notes.txt": b"mine"}
    with pytest.raises(InputError, match="is a file"):
        render_dataset(samples, tmp_path / "notes.txt")


def test_a_series_that_cannot_be_rendered_is_named_and_the_others_stay(tmp_path):
    low = overridden(WEDGE, {"microscope.working_distance_um": 1.0, "name": "low"})
    with pytest.raises(InputError, match=re.escape("low_0000: ")):
        render_dataset(plan([PLANE, low], 1), tmp_path / "set")
    assert [row["folder"] for row in rows(tmp_path / "set" / "index.csv")] == ["plane_0000"]
    assert not (tmp_path / "set" / "low_0000").exists()


def test_the_index_is_plain_text(rendered):
    first = (rendered / "index.csv").read_text().splitlines()[0]
    assert first == "folder,scene,number,specimen_seed,instrument_seed,noise_seed,detector.dose_e"
    assert json.loads(rows(rendered / "index.csv")[0]["noise_seed"]) == plan([WEDGE], 1)[0].noise_seed
