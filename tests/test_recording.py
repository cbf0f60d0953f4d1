"""Claims on the recording: it reads back, and holds every view at its tilt, the surface and a blueprint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_surface import KnowsTheBump, bump_series
from rerun.chunk import Chunk, RrdReader

from semrecon.geometry import nominal_poses, project
from semrecon.output.recording import eight_bits, plane_corners, ramp_colours, vertex_normals, write_recording
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import Reconstruction

TILTS = (-4.5, 0.0, 6.0)


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    return reconstruct(bump_series(TILTS), KnowsTheBump())


@pytest.fixture(scope="module")
def reader(result: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> RrdReader:
    path = tmp_path_factory.mktemp("recording") / "reconstruction.rrd"
    write_recording(result, path)
    return RrdReader(path)


def chunks(reader: RrdReader, entity: str) -> list[Chunk]:
    return [chunk for chunk in reader.stream().to_chunks() if chunk.entity_path == entity]


@pytest.mark.parametrize(
    "entity",
    [
        "/image",
        "/heights",
        "/sigma",
        "/about",
        "/world/points",
        "/world/residuals",
        "/world/sigma",
        "/world/mesh",
        "/world/view/plane",
        "/world/view/beam",
        "/world/beams/stated",
        "/world/beams/found",
    ],
)
def test_every_part_is_there(reader: RrdReader, entity: str) -> None:
    assert sum(chunk.num_rows for chunk in chunks(reader, entity)) >= 1


def test_images_stand_at_their_tilts(reader: RrdReader) -> None:
    found = chunks(reader, "/image")
    batches = [chunk.to_record_batch() for chunk in found if "tilt" in chunk.timeline_names]
    degrees = sorted(v.value / 1e9 for batch in batches for v in batch.column("tilt"))
    assert degrees == pytest.approx(sorted(TILTS))


def test_all_points_are_there(reader: RrdReader, result: Reconstruction) -> None:
    batch = chunks(reader, "/world/points")[0].to_record_batch()
    column = next(name for name in batch.schema.names if name.endswith("positions"))
    positions = np.array(batch.column(column)[0].as_py())
    np.testing.assert_allclose(positions, result.points.xyz_um, atol=1e-5)


@pytest.mark.parametrize("name", ["stated", "found"])
def test_beams_come_from_the_gun(reader: RrdReader, result: Reconstruction, name: str) -> None:
    batch = chunks(reader, f"/world/beams/{name}")[0].to_record_batch()
    column = next(found for found in batch.schema.names if found.endswith("vectors"))
    vectors = np.array(batch.column(column)[0].as_py())
    assert result.estimate.poses is not None
    np.testing.assert_allclose(
        vectors / np.linalg.norm(vectors, axis=1, keepdims=True), result.estimate.poses.rotations[:, 2], atol=1e-6
    )
    assert (vectors[:, 2] < 0).all()


def test_points_without_residuals_have_no_colours_of_them(result: Reconstruction, tmp_path: Path) -> None:
    points = replace(result.points, residual_px=np.full(len(result.points), np.nan))
    write_recording(replace(result, points=points), tmp_path / "a.rrd")
    assert chunks(RrdReader(tmp_path / "a.rrd"), "/world/residuals") == []
    assert chunks(RrdReader(tmp_path / "a.rrd"), "/world/points") != []


def test_images_are_averaged_to_what_a_screen_holds() -> None:
    image = np.tile(np.array([[0, 200], [200, 400]], dtype=np.uint16), (700, 600))
    shown = eight_bits(image)
    assert shown.shape == (700, 600)
    np.testing.assert_array_equal(shown, 128)  # the mean, half-way between black and white


def test_it_brings_its_blueprint(reader: RrdReader) -> None:
    assert len(reader.blueprints()) == 1
    assert len(reader.recordings()) == 1


def test_image_planes_project_onto_the_image_border() -> None:
    series = bump_series(TILTS)
    poses = nominal_poses(series)
    corners = plane_corners(poses.rotations[2], poses.translations_um[2], series.optics, 7.0)
    xy = project(corners, poses.rotations[2], poses.translations_um[2], series.optics)
    np.testing.assert_allclose(xy, [[-0.5, -0.5], [159.5, -0.5], [159.5, 119.5], [-0.5, 119.5]], atol=1e-9)
    assert (corners[:, 2] > 0).all()  # on the side of the gun


def test_normals_of_a_plane() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1]])
    normals = vertex_normals(vertices, np.array([[0, 1, 2], [1, 3, 2]]))
    np.testing.assert_allclose(normals, np.tile(np.array([-1.0, 0, 1]) / np.sqrt(2), (4, 1)), atol=1e-12)


def test_colours_run_with_height_and_grey_means_missing() -> None:
    colours = ramp_colours(np.array([*np.linspace(0, 1, 101), np.nan])).astype(int)
    brightness = colours[:-1].sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert tuple(colours[-1]) == (150, 150, 150)
