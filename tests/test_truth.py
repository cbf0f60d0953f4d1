"""Ground truth: sub-pixel surface, elevation, who sees what, and where."""

import numpy as np
import pytest
import trimesh

from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, pixel_grid, poses, project
from semsim.surface import surface_buffer
from semsim.truth import GroundTruth

HEIGHT = 4.0
"""Of the step: z is HEIGHT for x < 0 and 0 for x > 0, with an upright wall between."""


def truth_of(mesh: Mesh, microscope: Microscope, schedule: TiltSchedule) -> GroundTruth:
    views = poses(schedule)
    return GroundTruth(mesh, microscope, views, tuple(surface_buffer(mesh, microscope, pose) for pose in views))


@pytest.fixture(scope="module")
def step() -> GroundTruth:
    x, z = [-100.0, 0.0, 0.0, 100.0], [HEIGHT, HEIGHT, 0.0, 0.0]
    vertices = np.array([(a, b, c) for b in (-100.0, 100.0) for a, c in zip(x, z, strict=True)])
    faces = np.array([f for i in range(3) for f in ((i, i + 1, i + 5), (i, i + 5, i + 4))], dtype=np.int32)
    return truth_of(Mesh(vertices, faces), Microscope(0.1, 161, 31), TiltSchedule((0.0, 20.0, -20.0)))


@pytest.fixture(scope="module", params=[None, 40.0], ids=["parallel", "perspective"])
def ball(request) -> GroundTruth:
    shape = trimesh.creation.icosphere(5, radius=5.0)
    mesh = Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int32))
    schedule = TiltSchedule((0.0, 12.0, -25.0), 30.0, ((0.0, 0.0), (0.3, -0.2), (0.0, 0.1)))
    return truth_of(mesh, Microscope(0.1, 120, 110, request.param), schedule)


def test_the_surface_at_a_pixel_is_that_of_the_buffer(ball):
    for view, buffer in enumerate(ball.buffers):
        points = ball.surface_at(view, pixel_grid(ball.microscope))
        assert np.array_equal(points, buffer.position_um, equal_nan=True)


def test_the_surface_between_pixels_projects_back(ball):
    xy = np.random.default_rng(0).uniform(30, 80, (200, 2))
    for view, pose in enumerate(ball.poses):
        points = ball.surface_at(view, xy)
        assert np.abs(project(ball.microscope, pose, points) - xy).max() < 1e-6
        assert np.abs(np.linalg.norm(points, axis=1) - 5).max() < 0.01


def test_elevation_is_world_z_at_zero_tilt_and_up_the_beam_elsewhere(ball):
    assert np.array_equal(ball.height_map(0), ball.buffers[0].position_um[..., 2], equal_nan=True)
    for view, buffer in enumerate(ball.buffers):
        assert np.allclose(ball.height_map(view), -buffer.depth_um, atol=1e-12, equal_nan=True)
    assert np.nanmax(ball.height_map(1)) == pytest.approx(5.0, abs=0.01)


def test_correspondence_leads_to_the_same_point_of_the_surface(ball):
    for i, j in ((0, 1), (1, 0), (2, 0), (1, 2)):
        there = ball.correspondence(i, j)
        seen = np.isfinite(there).all(axis=-1)
        assert np.array_equal(seen, ball.visibility(i, j))
        gap = np.linalg.norm(ball.surface_at(j, there[seen]) - ball.buffers[i].position_um[seen], axis=-1)
        assert gap.max() < 1e-3 * ball.microscope.pixel_size_um * 1.01
        assert 0.5 < seen[~ball.buffers[i].miss].mean() < 1.0


def test_visible_on_a_sphere_is_what_faces_the_beam():
    shape = trimesh.creation.icosphere(5, radius=5.0)
    mesh = Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int32))
    truth = truth_of(mesh, Microscope(0.1, 120, 110), TiltSchedule((0.0, 30.0)))
    cosine = -truth.buffers[0].position_um @ truth.poses[1].rotation[2] / 5
    clear = np.abs(cosine) > 0.05  # the outline of a polyhedron is not quite the sphere's
    assert np.array_equal(truth.visibility(0, 1)[clear], (cosine > 0)[clear])


def test_a_view_sees_all_of_itself_and_its_correspondence_is_the_identity(ball):
    hit = ~ball.buffers[1].miss
    assert np.array_equal(ball.visibility(1, 1), hit)
    assert np.abs(ball.correspondence(1, 1) - pixel_grid(ball.microscope))[hit].max() < 1e-9


def test_a_step_hides_what_its_height_over_the_tilt_says(step):
    """Tilted by t, the edge above x = 0 moves right by h sin t and covers the floor up to x = h tan t."""
    x = step.buffers[0].position_um[15, :, 0]
    hidden = ~step.visibility(0, 1)[15]
    reach = HEIGHT * np.tan(np.radians(20.0))
    inside = np.abs(x) < 5.0
    clear = (np.abs(x) > 1e-6) & (np.abs(x - reach) > 1e-3)
    assert np.array_equal(hidden[inside & clear], ((x > 0) & (x < reach))[inside & clear])
    # Tilted the other way the wall comes into sight instead, and nothing is hidden.
    assert step.visibility(0, 2)[15, inside].all()


def test_the_wall_that_only_one_view_sees_is_hidden_from_the_others(step):
    wall = np.abs(step.buffers[2].position_um[15, :, 0]) < 1e-9
    assert wall.sum() == pytest.approx(HEIGHT * np.sin(np.radians(20.0)) / 0.1, abs=1)
    z = step.buffers[2].position_um[15, :, 2]
    inner = wall & (z > 0.01) & (z < HEIGHT - 0.01)
    assert not step.visibility(2, 1)[15, inner].any()
    assert not step.visibility(2, 0)[15, inner].any()


def test_raised_ground_has_the_parallax_of_its_height(step):
    there = step.correspondence(0, 1)[15]
    x, _, z = step.buffers[0].position_um[15].T
    expected = 80 + (x * np.cos(np.radians(20)) + z * np.sin(np.radians(20))) / 0.1
    seen = np.isfinite(there[:, 0])
    assert np.abs(there[seen, 0] - expected[seen]).max() < 1e-9
    assert np.abs(there[seen, 1] - 15).max() < 1e-9


def test_outside_the_frame_nothing_is_visible(ball):
    shifted = truth_of(ball.mesh, Microscope(0.1, 120, 110), TiltSchedule((0.0, 0.0), 0.0, ((0.0, 0.0), (4.0, 0.0))))
    seen, hit = shifted.visibility(0, 1), ~shifted.buffers[0].miss
    assert np.array_equal(seen[:, :80], hit[:, :80])
    assert not seen[:, 80:].any()


def test_nan_is_not_visible(step):
    assert step.visible(1, np.array([[np.nan, 0.0, 0.0], [-1.0, 0.0, HEIGHT]])).tolist() == [False, True]
