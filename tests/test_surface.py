"""Surface buffers against formulas, and the two ways to them against each other."""

import numpy as np
import pytest
import trimesh

from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, pixel_grid, pixel_rays, poses, project
from semsim.raycast import RayCaster
from semsim.surface import barycentric, interpolate, surface_buffer

SPHERE_PX = Microscope(2.4 / 200, 200, 180)


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int32))


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return mesh_of(trimesh.creation.icosphere(5))


@pytest.fixture(scope="module")
def tilted_plane() -> Mesh:
    """z = 0.3 x - 0.2 y + 1, far wider than the pictures."""
    x, y = np.meshgrid([-50.0, 50.0], [-50.0, 50.0])
    vertices = np.stack([x.ravel(), y.ravel(), (0.3 * x - 0.2 * y + 1).ravel()], axis=1)
    return Mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]], dtype=np.int32))


def brute_force(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Nearest distance over all triangles in float64 (Moeller and Trumbore 1997), NaN for a miss."""
    a, b, c = (mesh.vertices_um[mesh.faces[:, k]] for k in range(3))
    answer = np.full(len(origins), np.nan)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(direction, c - a)
        scale = 1 / np.einsum("ij,ij->i", p, b - a)
        q = np.cross(origin - a, b - a)
        u = np.einsum("ij,ij->i", origin - a, p) * scale
        v = q @ direction * scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        if hit.any():
            answer[i] = (np.einsum("ij,ij->i", q, c - a) * scale)[hit].min()
    return answer


@pytest.mark.parametrize(("backend", "working_distance_um"), [("zbuffer", None), ("raycast", None), ("raycast", 30.0)])
@pytest.mark.parametrize("tilt_deg", [0.0, 20.0])
def test_a_plane_is_met_where_the_formula_says(tilted_plane, backend, working_distance_um, tilt_deg):
    microscope = Microscope(0.1, 40, 30, working_distance_um)
    pose = poses(TiltSchedule((tilt_deg,), 30.0, ((0.4, -0.3),)))[0]
    buffer = surface_buffer(tilted_plane, microscope, pose, backend)
    x, y, z = np.moveaxis(buffer.position_um, -1, 0)
    assert not buffer.miss.any()
    assert np.abs(z - (0.3 * x - 0.2 * y + 1)).max() < 1e-9
    assert np.abs(project(microscope, pose, buffer.position_um) - pixel_grid(microscope)).max() < 1e-9
    depth = (buffer.position_um @ pose.rotation.T + pose.translation_um)[..., 2]
    assert np.abs(depth - buffer.depth_um).max() < 1e-9
    assert np.allclose(buffer.normal, np.array([-0.3, 0.2, 1]) / np.sqrt(1.13), atol=1e-12)


def test_casting_equals_float64_brute_force(ball):
    pose = poses(TiltSchedule((12.0,), 40.0))[0]
    xy = np.random.default_rng(3).uniform([0, 0], [199, 179], (500, 2))
    rays = pixel_rays(SPHERE_PX, pose, xy)
    hits = RayCaster(ball).cast(*rays)
    exact = brute_force(ball, *rays)
    assert np.array_equal(np.isnan(hits.distance), np.isnan(exact))
    assert np.nanmax(np.abs(hits.distance - exact)) < 1e-9


@pytest.mark.parametrize("offset_um", [0.0, 1000.0])
def test_hits_lie_on_the_sphere_within_its_sagitta(ball, offset_um):
    """A chord of length e leaves a circle of radius 1 by e^2/8; a triangle's middle by e^2/6 at most."""
    moved = Mesh(ball.vertices_um + [0.0, 0.0, offset_um], ball.faces)
    buffer = surface_buffer(moved, SPHERE_PX, poses(TiltSchedule((0.0,)))[0])
    edges = ball.vertices_um[ball.faces] - ball.vertices_um[np.roll(ball.faces, 1, axis=1)]
    sagitta = (np.linalg.norm(edges, axis=-1) ** 2).max() / 6
    radius = np.linalg.norm(buffer.position_um - [0.0, 0.0, offset_um], axis=-1)[~buffer.miss]
    assert radius.max() < 1 + 1e-9
    assert 1 - sagitta < radius.min() < 1 - 1e-6
    outward = np.einsum("...i,...i->...", buffer.normal, buffer.position_um - [0.0, 0.0, offset_um])
    assert np.nanmin(outward) > 0.999
    # The outline is a circle of radius 1; its pixels are counted within a pixel's share of the circumference.
    assert (~buffer.miss).sum() * SPHERE_PX.pixel_size_um**2 == pytest.approx(np.pi, rel=0.005)


def test_a_hit_point_lies_in_its_own_triangle(ball):
    buffer = surface_buffer(ball, SPHERE_PX, poses(TiltSchedule((8.0,)))[0])
    hit = ~buffer.miss
    weights = barycentric(ball, buffer.face[hit], buffer.position_um[hit])
    rebuilt = (ball.vertices_um[ball.faces[buffer.face[hit]]] * weights[..., None]).sum(axis=1)
    # Off by what float32 may mistake beside an edge, not more.
    assert np.abs(rebuilt - buffer.position_um[hit]).max() < 1e-6
    assert np.allclose(weights.sum(axis=1), 1)


def test_missing_is_nan(ball):
    buffer = surface_buffer(ball, SPHERE_PX, poses(TiltSchedule((0.0,)))[0])
    assert buffer.miss[0, 0]
    for values in (buffer.depth_um, buffer.position_um, buffer.normal):
        assert np.isnan(values[buffer.miss]).all()
        assert np.isfinite(values[~buffer.miss]).all()


def test_a_nan_ray_misses(ball):
    hits = RayCaster(ball).cast(np.array([[np.nan, 0, 0], [0, 0, 0]]), np.array([0.0, 0.0, -1.0]))
    assert hits.face[0] == -1
    assert hits.position_um[1] == pytest.approx([0, 0, 1], abs=1e-9)


def test_a_displaced_beam_sees_what_the_next_pixel_sees(ball):
    pose = poses(TiltSchedule((5.0,)))[0]
    plain = surface_buffer(ball, SPHERE_PX, pose)
    moved = surface_buffer(ball, SPHERE_PX, pose, beam_px=pixel_grid(SPHERE_PX) + [1.0, 0.0])
    assert np.allclose(moved.depth_um[:, :-1], plain.depth_um[:, 1:], atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("tilt_deg", [0.0, 17.0])
def test_opengl_agrees_with_the_rays_on_a_unit_sphere(ball, tilt_deg):
    """Both traps of pyrender mended. Measured: mean 3e-7, max 5e-5, one silhouette pixel.

    With multisampling left on (pyrender's flat pass) the same views differ by 4e-3, 0.1 and 140 pixels.
    """
    pose = poses(TiltSchedule((tilt_deg,), 30.0, ((0.0013, -0.002),)))[0]
    rays, drawn = (surface_buffer(ball, SPHERE_PX, pose, backend) for backend in ("raycast", "pyrender"))
    difference = np.abs(rays.depth_um - drawn.depth_um)
    assert np.nanmean(difference) < 2e-6
    assert np.nanmax(difference) < 2e-4
    assert (rays.miss != drawn.miss).sum() <= 8
    both = ~rays.miss & ~drawn.miss
    assert (rays.face == drawn.face)[both].mean() > 0.999
    assert np.abs(rays.normal - drawn.normal)[both].max() < 2e-3


def test_opengl_sees_the_right_side_of_an_overhang():
    table = trimesh.util.concatenate([trimesh.creation.box((8, 8, 1)), trimesh.creation.box((3, 3, 0.5))])
    vertices = np.asarray(table.vertices, dtype=np.float64).copy()
    vertices[8:, 2] += 2.0
    mesh = Mesh(vertices, np.asarray(table.faces, dtype=np.int32))
    microscope, pose = Microscope(0.05, 64, 48), poses(TiltSchedule((25.0,)))[0]
    rays, drawn = (surface_buffer(mesh, microscope, pose, backend) for backend in ("raycast", "pyrender"))
    differs = np.abs(rays.depth_um - drawn.depth_um) > 1e-4
    assert np.ptp(rays.depth_um) > 1.5
    assert differs.sum() <= 2


def test_left_to_itself_it_draws_where_it_can_and_casts_rays_elsewhere(ball):
    pose, beam = poses(TiltSchedule((7.0,)))[0], pixel_grid(SPHERE_PX) + 0.25
    far = Microscope(2.4 / 200, 200, 180, working_distance_um=1e9)
    for microscope, beam_px, backend in (
        (SPHERE_PX, None, "zbuffer"),
        (far, None, "raycast"),
        (SPHERE_PX, beam, "raycast"),
    ):
        auto = surface_buffer(ball, microscope, pose, beam_px=beam_px)
        named = surface_buffer(ball, microscope, pose, backend, beam_px=beam_px)
        assert np.array_equal(auto.depth_um, named.depth_um, equal_nan=True)


@pytest.mark.parametrize("working_distance_um", [None, 30.0])
def test_a_mesh_that_is_inside_out_looks_the_same(ball, working_distance_um):
    microscope = Microscope(2.4 / 200, 200, 180, working_distance_um=working_distance_um)
    pose = poses(TiltSchedule((8.0,)))[0]
    inside_out = Mesh(ball.vertices_um, np.ascontiguousarray(ball.faces[:, ::-1]))
    right, turned = (surface_buffer(mesh, microscope, pose) for mesh in (ball, inside_out))
    assert np.array_equal(right.miss, turned.miss)
    assert np.nanmax(np.abs(right.normal - turned.normal)) < 1e-9
    assert not right.miss.all()


def test_where_corner_normals_cancel_the_triangle_answers(ball):
    """A sheet and its own back share corners, whose normals cancel."""
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]])
    folded = Mesh(corners, np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32))
    buffer = surface_buffer(folded, SPHERE_PX, poses(TiltSchedule((0.0,)))[0])
    assert np.allclose(buffer.normal, [0.0, 0.0, 1.0])


def test_normals_are_those_interpolated_between_corners(ball):
    buffer = surface_buffer(ball, SPHERE_PX, poses(TiltSchedule((8.0,)))[0])
    smooth = interpolate(ball, ball.vertex_normals, buffer.face, buffer.position_um)
    smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True)
    assert np.nanmax(np.abs(buffer.normal - smooth)) < 1e-12


def test_unknown_backends_and_impossible_views_are_refused(ball):
    pose = poses(TiltSchedule((0.0,)))[0]
    near = Microscope(0.01, 64, 64, working_distance_um=0.5)
    with pytest.raises(InputError, match="auto, zbuffer, raycast, pyrender"):
        surface_buffer(ball, SPHERE_PX, pose, "mitsuba")
    with pytest.raises(InputError, match="working_distance_um"):
        surface_buffer(ball, near, pose)
    with pytest.raises(InputError, match="parallel"):
        surface_buffer(ball, Microscope(0.01, 64, 64, 100.0), pose, "pyrender")
    for backend in ("zbuffer", "pyrender"):
        with pytest.raises(InputError, match=f"{backend}.*displaced"):
            surface_buffer(ball, SPHERE_PX, pose, backend, beam_px=pixel_grid(SPHERE_PX))
