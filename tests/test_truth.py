"""Ground truth: sub-pixel surface, elevation, who sees what, and where."""

import numpy as np
import pytest
import trimesh

from semsim.imperfections import StageErrors, ViewErrors
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, pixel_grid, pixel_rays, poses, project
from semsim.scan import ScanOptions, scan_offsets
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
        hit = ~buffer.miss
        assert np.array_equal(np.isfinite(points[..., 0]), hit)
        assert np.abs(points - buffer.position_um)[hit].max() < 1e-6  # the rim, where a ray runs along the triangles
        assert np.median(np.abs(points - buffer.position_um)[hit]) < 1e-13


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


SHAKY = ScanOptions((0.8, -1.1), 0.4, 0.3, (0.2, 0.3), 3.0, line_jitter_px=0.1, flyback_px=1.0)


@pytest.fixture(scope="module", params=[None, 40.0], ids=["parallel", "perspective"])
def bent(request) -> GroundTruth:
    """The ball with everything out of true: tilts, axis, column and scan."""
    shape = trimesh.creation.icosphere(5, radius=5.0)
    mesh = Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int32))
    scope = Microscope(0.1, 120, 110, request.param)
    views = poses(
        TiltSchedule((0.0, 12.0, -25.0), 30.0),
        StageErrors((0.1, -0.2, 0.0), tilt_axis_deg=0.5, axis_point_um=(0.3, 0.0, 1.0)),
        ViewErrors((0.0, 0.01, -0.02), (0.3, -1.0, 2.0), (0.0, 0.004, 0.01)),
    )
    offsets = tuple(scan_offsets(scope, SHAKY, rng) for rng in np.random.default_rng(0).spawn(3))
    beams = [pixel_grid(scope) + offset for offset in offsets]
    buffers = tuple(surface_buffer(mesh, scope, pose, beam_px=beam) for pose, beam in zip(views, beams, strict=True))
    return GroundTruth(mesh, scope, views, buffers, offsets)


def test_with_all_errors_a_pixels_surface_is_recorded_at_the_pixel(bent):
    grid = pixel_grid(bent.microscope)
    for view, buffer in enumerate(bent.buffers):
        hit = ~buffer.miss
        assert np.abs(bent.image_of(view, buffer.position_um) - grid)[hit].max() < 1e-6
        assert np.abs(bent.correspondence(view, view) - grid)[hit].max() < 1e-6
        # And it is not where a perfect scan would have put it.
        assert np.abs(project(bent.microscope, bent.poses[view], buffer.position_um) - grid)[hit].max() > 0.5


def test_with_all_errors_correspondence_there_and_back_is_the_identity(bent):
    """Between the pixels: surface at (x, y) of one view, its place in the other, the surface there, and its place."""
    xy = np.random.default_rng(0).uniform(25, 85, (4000, 2))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        points = bent.surface_at(i, xy)
        points = points[bent.visible(i, points) & bent.visible(j, points)]
        there = bent.image_of(j, points)
        again = bent.surface_at(j, there)
        steep = bent.poses[j].rotation[2] @ (again.T / 5) > -0.2  # the rim, where the beam runs along the surface
        assert np.abs(again - points)[~steep].max() < 1e-6
        assert np.abs(bent.image_of(i, again) - bent.image_of(i, points))[~steep].max() < 1e-5
        assert len(points) > 1500


def test_with_all_errors_correspondence_leads_to_the_same_point(bent):
    for i, j in ((0, 1), (2, 0)):
        there = bent.correspondence(i, j)
        seen = np.isfinite(there).all(axis=-1)
        assert np.array_equal(seen, bent.visibility(i, j))
        gap = np.linalg.norm(bent.surface_at(j, there[seen]) - bent.buffers[i].position_um[seen], axis=-1)
        assert gap.max() < 1e-3 * bent.microscope.pixel_size_um * 1.01


def test_normals_in_the_view_frame_are_those_of_the_sphere(ball):
    for view, (pose, buffer) in enumerate(zip(ball.poses, ball.buffers, strict=True)):
        expected = buffer.position_um / 5 @ pose.view_from_world.T
        hit = ~buffer.miss
        assert np.abs(ball.normals(view) - expected)[hit].max() < 0.01
        assert np.isnan(ball.normals(view)[~hit]).all()


def test_covisibility_is_the_share_of_what_is_seen(ball, step):
    shares = ball.covisibility()
    assert np.array_equal(np.diag(shares), np.ones(3))
    for i, j in ((0, 1), (2, 1)):
        assert shares[i, j] == ball.visibility(i, j).sum() / ball.visibility(i, i).sum()
    assert ((shares > 0.5) & (shares <= 1)).all()
    assert step.covisibility()[0, 1] < 1


FIELD_UM = 24.0
SCOPES = [Microscope(FIELD_UM / 161, 161, 121), Microscope(FIELD_UM / 161, 161, 121, working_distance_um=200.0)]


def formula_depth(truth: GroundTruth, height) -> np.ndarray:
    """Depth along each pixel's ray, found by Newton's method on z - height(x, y) of the formula itself, no mesh."""
    origins, directions = pixel_rays(truth.microscope, truth.poses[0], pixel_grid(truth.microscope))
    depth = np.array(truth.buffers[0].depth_um)
    for _ in range(30):
        at, further = (origins + (depth + d)[..., None] * directions for d in (0.0, 1e-4))
        here, there = (p[..., 2] - height(p[..., 0], p[..., 1]) for p in (at, further))
        depth = depth - here * 1e-4 / (there - here)
    return depth


@pytest.mark.parametrize("scope", SCOPES, ids=["parallel", "perspective"])
@pytest.mark.parametrize("tilt", [0.0, 15.0])
@pytest.mark.parametrize("kind", ["plane", "wedge", "step", "sphere"])
def test_depth_is_that_of_the_formula_within_a_hundred_thousandth_of_the_field(kind, tilt, scope):
    """The start of Newton's method is the mesh's own depth, on the right branch; where it stays is the formula's."""
    if kind == "sphere":
        ball = trimesh.creation.icosphere(7, radius=8.0)
        mesh = Mesh(np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int32))
    else:
        slope = {"plane": lambda x: 0.2 * x, "wedge": lambda x: -0.3 * np.abs(x), "step": lambda x: 0.0 * x}[kind]
        left = {"plane": [-60.0], "wedge": [-60.0, 0.0], "step": [-60.0, 0.0, 0.0]}[kind]
        x = np.array([*left, 60.0])
        z = slope(x) + (np.array([2.0, 2.0, 0.0, 0.0]) if kind == "step" else 0.0)
        vertices = np.array([(a, b, c) for b in (-60.0, 60.0) for a, c in zip(x, z, strict=True)])
        n = len(x)
        faces = np.array([f for i in range(n - 1) for f in ((i, i + 1, i + n + 1), (i, i + n + 1, i + n))], np.int32)
        mesh = Mesh(vertices, faces)
    truth = truth_of(mesh, scope, TiltSchedule((tilt,)))
    x, y, _ = np.moveaxis(truth.buffers[0].position_um, -1, 0)
    if kind == "sphere":
        judged = np.hypot(x, y) < 5.0  # nearer to the rim the triangles' sagitta counts many times
        expected = formula_depth(truth, lambda x, y: np.sqrt(np.maximum(64.0 - x**2 - y**2, 1.0)))
    elif kind == "step":
        judged = np.abs(x) > 1e-6  # the wall itself is upright: no function of x
        expected = formula_depth(truth, lambda x, y: np.where(x < 0, 2.0, 0.0))
    else:
        judged = np.abs(x) > 1e-3
        expected = formula_depth(truth, lambda x, y: slope(x))
    error = np.abs(truth.buffers[0].depth_um - expected)[judged]
    assert judged.mean() > 0.15
    assert error.max() < 1e-5 * FIELD_UM
