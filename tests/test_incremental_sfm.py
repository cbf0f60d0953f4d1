"""Claims on COLMAP's incremental mapper as a contender: right with strong perspective, silent, tidy, repeatable."""

import sys
import tempfile
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from semrecon.data import Optics, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.geometry import project, rotations_from_tilts
from semrecon.methods.incremental_sfm import IncrementalSfm
from semrecon.perspective.colmap import MapperOptions
from tests.known_surface import bump_series

OPTICS = Optics(1.0, 240, 180, 1 / 500)
TILTS = (0.0, 12.0, -12.0)
OWN = IncrementalSfm(mapper=MapperOptions(sources=("own",), refine_focal=(False,)))


def height_um(x, y):
    return 18 * np.exp(-((x - 20) ** 2 + y**2) / (2 * 30.0**2)) - 15 * np.exp(
        -((x + 40) ** 2 + (y - 10) ** 2) / (2 * 25.0**2)
    )


def near_series():
    """A painted hill and hollow before a camera 500 um away: each pixel's beam is followed to the surface."""
    rng = np.random.default_rng(0)
    paint = ndimage.gaussian_filter(rng.normal(size=(500, 500)), 1.5)
    paint = ndimage.spline_filter(120 + 35 * paint / paint.std())
    columns, rows = np.meshgrid(np.arange(OPTICS.width_px), np.arange(OPTICS.height_px))
    away = (np.stack([columns, rows], axis=-1) - OPTICS.centre_px) * OPTICS.pixel_size_um
    k, views = OPTICS.inverse_working_distance, []
    for i, (rotation, tilt) in enumerate(zip(rotations_from_tilts(np.array(TILTS)), TILTS, strict=True)):
        depth = np.zeros(OPTICS.shape)
        for _ in range(60):
            camera = np.concatenate([away * (1 + k * depth)[..., None], depth[..., None]], axis=-1)
            world = camera @ rotation
            miss = height_um(world[..., 0], world[..., 1]) - world[..., 2]
            depth = depth + 0.7 * miss * rotation[2, 2]
        at = np.stack([-world[..., 1], world[..., 0]]) + 250
        image = ndimage.map_coordinates(paint, at, order=3, prefilter=False)
        views.append(View(image.clip(0, 255).round().astype(np.uint8), tilt, f"near_{i}.tif"))
    return TiltSeries(tuple(views), OPTICS)


def test_without_the_package_a_sentence_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MethodError, match="extra sfm"):
        IncrementalSfm()(bump_series(), rng=np.random.default_rng(0))


def test_what_cannot_be_is_said():
    with pytest.raises(MethodError, match="two views"):
        IncrementalSfm()(bump_series().select(0), rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="focal_widths"):
        IncrementalSfm(focal_widths=-1.0)(bump_series(), rng=np.random.default_rng(0))


def test_strong_perspective_is_measured_in_silence_and_leaves_no_file(capfd, monkeypatch, tmp_path):
    """Tilts to 0.3 degrees, points to 0.6 um, the offset alone removed; all set-ups answer."""
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    series = near_series()
    estimate = IncrementalSfm()(series, rng=np.random.default_rng(0))
    assert capfd.readouterr() == ("", "")
    assert list(Path(tmp_path).iterdir()) == []
    assert estimate.diagnostics["turns_deg"] == pytest.approx([0, 12, 12], abs=0.3)
    assert len(estimate.points) > 200
    error = estimate.points.xyz_um[:, 2] - height_um(*estimate.points.xyz_um[:, :2].T)
    assert np.median(np.abs(error - np.median(error))) < 0.6
    tried = estimate.diagnostics["set_ups"]
    assert {(one["matches"], one["focal_refined"]) for one in tried} == {
        (source, refined) for source in ("own", "colmap") for refined in (False, True)
    }
    assert [one["views"] for one in tried] == sorted((one["views"] for one in tried), reverse=True)
    back = project(estimate.points.xyz_um, estimate.poses.rotations[0], estimate.poses.translations_um[0], OPTICS)
    misses = np.linalg.norm(back - estimate.points.xy_px, axis=1)
    assert np.nanmedian(misses) < 0.5  # also says that both count pixels from the centre of the first


def test_the_same_seed_gives_the_same_answer_and_the_input_stays():
    pytest.importorskip("pycolmap")
    series = near_series()
    before = [view.image.copy() for view in series.views]
    one, two = (OWN(series, rng=np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(one.points.xyz_um, two.points.xyz_um)
    assert np.array_equal(one.poses.rotations, two.poses.rotations)
    assert all(np.array_equal(a, view.image) for a, view in zip(before, series.views, strict=True))


@pytest.mark.parametrize("spoiled", ["black", "saturated", "equal", "small", "rows"])
def test_bad_views_are_answered_or_refused_in_a_sentence(spoiled):
    pytest.importorskip("pycolmap")
    series = near_series()
    images = [view.image.copy() for view in series.views]
    if spoiled in {"black", "saturated"}:
        images[1] = np.full_like(images[1], 0 if spoiled == "black" else 255)
    elif spoiled == "equal":
        images = [images[0].copy() for _ in images]
    elif spoiled == "small":
        images = [np.ascontiguousarray(image[50:114, 80:144]) for image in images]
    else:
        images = [image.astype(np.float32) for image in images]
        images[1][30] = np.nan
    views = tuple(View(image, v.tilt_deg, v.name) for image, v in zip(images, series.views, strict=True))
    optics = replace(series.optics, height_px=images[0].shape[0], width_px=images[0].shape[1])
    spoilt = replace(series, views=views, optics=optics)
    if spoiled in {"black", "saturated"}:
        with pytest.raises(MethodError, match=r"near_1\.tif is blank"):
            OWN(spoilt, rng=np.random.default_rng(0))
        return
    with suppress(MethodError) if spoiled in {"equal", "small"} else nullcontext():
        assert np.isfinite(OWN(spoilt, rng=np.random.default_rng(0)).points.xyz_um).all()
