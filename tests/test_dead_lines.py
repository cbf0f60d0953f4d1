"""Dead lines are found wherever they are, and nothing of a picture is taken for one."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from known_surface import bump_series

from semrecon.input.databar import find_data_bar
from semrecon.input.dead_lines import dead_lines_of, find_dead_lines
from semrecon.input.doubts import doubts
from semrecon.input.images import read_image
from semrecon.input.intake import Intake, Stated, facts_of, take_in
from semrecon.input.series import read_series, write_series
from semrecon.matches.features import detect_features, usable_pixels
from semsim.capture import simulate
from semsim.scene import scaled
from semsim.scenes import scene

QUICK, LARGE = ("steps", "plane", "step", "sphere", "wedge"), ("pollen", "fracture", "grains", "wires")


def picture(seed: int = 0, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """Noise on a slope: no two lines alike, none flat."""
    rng = np.random.default_rng(seed)
    slope = np.linspace(60, 160, shape[0])[:, None] + np.linspace(0, 40, shape[1])
    return np.clip(rng.normal(slope, 12), 1, 254).astype(np.uint8)


def spoiled(image: np.ndarray, kind: str, rows: list[int]) -> np.ndarray:
    """Spoil rows in one of the ways that instruments and converters have."""
    image = image.astype(np.float32) if kind == "nan" else image.copy()
    for row in rows:
        image[row] = {"black": 0, "white": 255, "grey": 100, "nan": np.nan, "repeated": image[row - 1]}[kind]
    return image


KINDS = ("black", "white", "grey", "nan", "repeated")


@pytest.mark.parametrize("kind", KINDS)
@given(rows=st.lists(st.integers(1, 95), min_size=1, max_size=2, unique=True), seed=st.integers(0, 99))
def test_dead_rows_and_columns_are_found_anywhere(kind: str, rows: list[int], seed: int) -> None:
    if len(rows) == 2 and abs(rows[0] - rows[1]) == 2:
        return  # one line of picture between two dead ones
    image = spoiled(picture(seed), kind, sorted(rows))
    found = find_dead_lines(image)
    assert (found.rows.tolist(), found.columns.tolist()) == (sorted(rows), [])
    turned = find_dead_lines(image.T)
    assert (turned.rows.tolist(), turned.columns.tolist()) == ([], sorted(rows))


@pytest.mark.parametrize("kind", ["black", "white", "grey", "nan"])
@pytest.mark.parametrize("first", [0, 40, 91])
def test_dead_lines_side_by_side_and_at_an_edge(kind: str, first: int) -> None:
    rows = list(range(first, first + 5))
    assert find_dead_lines(spoiled(picture(), kind, rows)).rows.tolist() == rows


def backgrounds() -> dict[str, np.ndarray]:
    """Pictures with flat parts that belong to them."""
    plain, y = picture(), np.arange(96)[:, None]
    disc = np.hypot(y - 48, np.arange(128) - 64) < 30
    edge = 300 * np.exp(-((y - 50.0) ** 2) / (2 * 1.5**2))
    return {
        "picture": plain,
        "black sky": np.where(y < 30, 0, plain),
        "white ground": np.where(y > 60, 255, plain),
        "object on black": np.where(disc, plain, 0),
        "object on white": np.where(disc, plain, 255),
        "glowing edge along the scan": np.clip(plain + edge, 0, 255).astype(np.uint8),
        "enlarged": plain.repeat(2, axis=0).repeat(2, axis=1),
        "all black": np.zeros_like(plain),
        "all NaN but one": np.where(np.arange(128) == 5, plain, np.nan)[:, 4:7].astype(np.float32),
        "tiny": plain[:5, :5],
    }


@pytest.mark.parametrize("name", backgrounds())
def test_flat_parts_of_a_picture_are_no_dead_lines(name: str) -> None:
    assert not find_dead_lines(backgrounds()[name])


@lru_cache(maxsize=16)
def micrograph(name: str) -> np.ndarray:
    """A small picture of a scene, tilted."""
    one = scaled(scene(name), 160 / scene(name).microscope.width_px)
    one = replace(one, schedule=replace(one.schedule, tilts_deg=one.schedule.tilts_deg[-1:], shifts_um=()))
    return np.asarray(simulate(one, 5).images[0])


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)])
@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_no_simulated_micrograph_has_one(name: str, gain: float) -> None:
    """Also where a high contrast clips much of the picture to white or black."""
    image = micrograph(name)
    brighter = (image - image.mean()) * gain + image.mean()
    assert not find_dead_lines(np.clip(brighter, 0, np.iinfo(image.dtype).max).astype(image.dtype))


def test_the_paper_of_a_data_bar_is_not_dead(real_data: Path) -> None:
    image = read_image(real_data / "vendor" / "fei_quanta.tif")
    assert find_data_bar(image) == 59
    assert find_dead_lines(image)
    assert not dead_lines_of(image)


def test_no_real_micrograph_has_one(real_data: Path) -> None:
    files = [path for path in sorted(real_data.rglob("*")) if path.suffix in {".tif", ".jpg"}]
    assert len(files) >= 10
    assert [path.name for path in files if dead_lines_of(read_image(path))] == []


# --- from the file to the features ------------------------------------------------------------------------------------


def taken_in(folder: Path, kind: str, rows: list[int]) -> Intake:
    series = bump_series((0.0, 6.0))
    views = [replace(series.views[0], image=spoiled(series.views[0].image, kind, rows)), series.views[1]]
    write_series(replace(series, views=tuple(views)), folder / "s")
    return take_in([folder / "s"])


@pytest.mark.parametrize("kind", KINDS)
def test_dead_rows_are_masked_and_said(tmp_path: Path, kind: str) -> None:
    intake = taken_in(tmp_path, kind, [30, 31, 80] if kind != "repeated" else [30, 80])
    named = "rows 30-31, 80" if kind != "repeated" else "rows 30, 80"
    assert [said for said in intake.warnings if "no picture" in said] == [
        f"view_00.tif: no picture in {named} (counted from 0), left out"
    ]
    spoilt, whole = intake.series.views
    assert spoilt.mask is not None
    assert np.flatnonzero(~spoilt.mask.any(axis=1)).tolist() == ([30, 31, 80] if kind != "repeated" else [30, 80])
    assert spoilt.mask.sum() == spoilt.image.size - spoilt.image.shape[1] * (3 if kind != "repeated" else 2)
    assert np.isfinite(spoilt.image).all()
    assert whole.mask is None


@pytest.mark.parametrize("kind", KINDS)
def test_no_feature_stands_on_a_dead_row(tmp_path: Path, kind: str) -> None:
    view = taken_in(tmp_path, kind, [60]).series.views[0]
    assert not usable_pixels(view)[60].any()
    rows = detect_features(view).xy_px[:, 1]
    assert len(rows) > 20
    assert np.abs(rows - 60).min() > 4  # the margin of the features


def test_a_pixel_without_a_number_is_masked_and_said(tmp_path: Path) -> None:
    series = bump_series((0.0, 6.0))
    image = series.views[0].image.astype(np.float32)
    image[[10, 50], [20, 60]] = np.nan
    write_series(replace(series, views=(replace(series.views[0], image=image), series.views[1])), tmp_path / "s")
    intake = take_in([tmp_path / "s"])
    assert "view_00.tif: 2 pixels are no numbers, left out" in intake.warnings
    for view in (intake.series.views[0], read_series(tmp_path / "s").views[0]):
        assert view.mask is not None
        assert np.argwhere(~view.mask).tolist() == [[10, 20], [50, 60]]
        assert np.isfinite(view.image).all()


def test_a_dead_row_of_a_channel_counts_for_the_view(tmp_path: Path) -> None:
    series = bump_series((0.0, 6.0))
    channel = spoiled(series.views[1].image, "black", [40])
    views = (series.views[0], replace(series.views[1], channels={"left": channel}))
    write_series(replace(series, views=views), tmp_path / "s")
    intake = take_in([tmp_path / "s"])
    assert "channel left of view_01.tif: no picture in row 40 (counted from 0), left out" in intake.warnings
    assert intake.series.views[1].mask is not None
    assert not intake.series.views[1].mask[40].any()


def test_info_says_it_before_and_the_bottom_is_cropped_as_ever(tmp_path: Path) -> None:
    paths = []
    for i, view in enumerate(bump_series((0.0, 6.0)).views):
        paths.append(tmp_path / f"{i}.tif")
        tifffile.imwrite(paths[-1], spoiled(view.image, "black", [50, 119] if i else [119]))
    said = doubts(facts_of(paths), [read_image(path) for path in paths])
    assert "1.tif: no picture in row 50 (counted from 0), will be left out" in said
    assert any(sentence.startswith("the last 1 rows of the images are dead lines") for sentence in said)
    intake = take_in(paths, Stated((0.0, 6.0), 0.1))
    assert intake.series.optics.height_px == 119
    assert intake.series.views[0].mask is None
    assert intake.series.views[1].mask is not None
    assert intake.series.views[1].mask.shape == (119, 160)
