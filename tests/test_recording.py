"""Claims on the recording: it reads back, and holds every view at its tilt, the surface and a blueprint."""

from __future__ import annotations

import numpy as np
import pytest
from known_surface import KnowsTheBump, bump_series
from rerun.chunk import Chunk, RrdReader

from semrecon.geometry import nominal_poses, project
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import Reconstruction
from semrecon.recording import height_colours, plane_corners, vertex_normals, write_recording

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
    ["/image", "/heights", "/about", "/world/points", "/world/mesh", "/world/view/plane", "/world/view/beam"],
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
    colours = height_colours(np.array([*np.linspace(0, 1, 101), np.nan])).astype(int)
    brightness = colours[:-1].sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert tuple(colours[-1]) == (150, 150, 150)
