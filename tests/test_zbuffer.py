"""The rasteriser: no pixel twice and none left out, exact against brute force, and one with the rays on all shapes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.bands import in_bands
from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.microscope import Microscope, Pose, TiltSchedule, pixel_grid, pixel_rays, poses, project
from semsim.raycast import linear_beam
from semsim.specimens import Diatom, Pollen, Sphere
from semsim.surface import surface_buffer
from semsim.zbuffer import image_coordinates, rasterise

MICROSCOPE = Microscope(0.5, 32, 24)
LEVEL = poses(TiltSchedule((0.0,)))[0]
COARSE = {"pollen": Pollen(edge_um=1.3), "diatom": Diatom(edge_um=1.3), "sphere": Sphere(subdivisions=4)}


@pytest.fixture(scope="module")
def meshes() -> dict[str, Mesh]:
    return {name: specimen(np.random.default_rng(5)) for name, specimen in COARSE.items()}


def in_image(corners, faces=((0, 1, 2),)) -> Mesh:
    """Triangles by column, row and X_cam_z (um) of their corners."""
    xyd = np.asarray(corners, dtype=np.float64)
    origins, directions = pixel_rays(MICROSCOPE, LEVEL, xyd[:, :2])
    return Mesh(origins + xyd[:, 2:] * directions, np.asarray(faces, dtype=np.int32))


def area(u, v):
    """Signed area of the parallelogram of two vectors (..., 2)."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def brute_force(mesh: Mesh, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Nearest distance over all triangles in float64, NaN for a miss, along parallel rays (n, 3).

    In the plane across the ray each triangle is told by the signs of three areas; its depth is their weighted mean.
    """
    across = np.linalg.svd(direction[None])[2][1:]
    at, flat, deep = origins @ across.T, mesh.vertices_um @ across.T, mesh.vertices_um @ direction
    a, b, c = (flat[mesh.faces[:, k]] for k in range(3))
    answer = np.full(len(origins), np.nan)
    for i, p in enumerate(at):
        areas = np.stack([area(v - u, p - u) for u, v in ((b, c), (c, a), (a, b))])
        inside = (areas >= 0).all(axis=0) | (areas <= 0).all(axis=0)
        if inside.any():
            weights = areas[:, inside] / areas[:, inside].sum(axis=0)
            answer[i] = (weights * deep[mesh.faces[inside].T]).sum(axis=0).min() - origins[i] @ direction
    return answer


@given(st.lists(st.tuples(st.integers(-8, 72), st.integers(-8, 56)), min_size=4, max_size=4))
def test_each_pixel_of_a_shared_edge_belongs_to_one_triangle(twice):
    """Two triangles on either side of a line, corners on pixels and between: drawn alone they part the pixels."""
    a, b, c, d = (np.array([x / 2, y / 2, 0.0]) for x, y in twice)
    side = [area(b - a, p - a) for p in (c, d)]
    if side[0] * side[1] >= 0:
        return
    alone = [rasterise(in_image(corners), MICROSCOPE, LEVEL)[1] >= 0 for corners in ((a, b, c), (d, b, a))]
    both = rasterise(in_image((a, b, c, d), ((0, 1, 2), (3, 1, 0))), MICROSCOPE, LEVEL)[1] >= 0
    assert not (alone[0] & alone[1]).any()
    assert np.array_equal(both, alone[0] | alone[1])


@given(st.integers(2, 60), st.integers(2, 44), st.floats(-5, 5))
def test_a_fan_leaves_no_pixel_out(x, y, height):
    """A rectangle cut into four at any point, a pixel's centre or not, is covered as the rectangle is."""
    corners = [(0, 0, 0), (31, 0, 0), (31, 23, 0), (0, 23, 0), (x / 2, y / 2, height)]
    fan = [(4, k, (k + 1) % 4) for k in range(4)]
    drawn = [rasterise(in_image(corners, [face]), MICROSCOPE, LEVEL)[1] >= 0 for face in fan]
    assert (np.sum(drawn, axis=0)[:23, :31] == 1).all()


def test_a_rectangle_covers_the_pixels_from_its_first_edge_up_to_its_last():
    """Left and top edge in, right and bottom edge out: the half-open rule."""
    corners = [(3, 2, 0), (10, 2, 0), (10, 7, 0), (3, 7, 0)]
    depth, face = rasterise(in_image(corners, ((0, 1, 2), (0, 2, 3))), MICROSCOPE, LEVEL)
    rows, columns = np.nonzero(face >= 0)
    assert (rows.min(), rows.max(), columns.min(), columns.max(), len(rows)) == (2, 6, 3, 9, 35)
    assert np.array_equal(np.isnan(depth), face < 0)


def test_the_nearest_is_seen_whichever_way_it_faces_and_the_first_of_equals():
    far, near = [(2, 2, 3.0), (30, 2, 3.0), (2, 22, 3.0)], [(2, 2, -1.0), (30, 2, -1.0), (2, 22, -1.0)]
    mesh = in_image(far + near + near, ((0, 1, 2), (3, 5, 4), (6, 7, 8)))
    depth, face = rasterise(mesh, MICROSCOPE, LEVEL)
    assert set(np.unique(face)) == {-1, 1}
    assert np.nanmax(np.abs(depth + 1.0)) < 1e-12


def test_depth_is_that_of_the_plane():
    corners = [(-400, -300, 0.0), (500, -200, 40.0), (-100, 600, -70.0)]
    depth, _ = rasterise(in_image(corners), MICROSCOPE, LEVEL)
    plane = np.linalg.solve(np.column_stack([np.array(corners)[:, :2], np.ones(3)]), [0.0, 40.0, -70.0])
    assert np.abs(depth - (pixel_grid(MICROSCOPE) @ plane[:2] + plane[2])).max() < 1e-11


@pytest.mark.parametrize("name", COARSE)
@pytest.mark.parametrize("tilt_deg", [0.0, -15.0, 30.0])
def test_it_sees_what_the_rays_see(meshes, name, tilt_deg):
    """Depth within 1e-4 px of disparity for any tilt; where the two part, brute force is on our side.

    Rays are cast in float32, which can slip past an outline or take the neighbour at an edge: a few pixels in 10^5.
    """
    microscope, pose = Microscope(0.4037, 320, 240), poses(TiltSchedule((tilt_deg,), 20.0, ((0.011, 0.007),)))[0]
    cast, drawn = (surface_buffer(meshes[name], microscope, pose, way) for way in ("raycast", "zbuffer"))
    apart = ~(np.abs(cast.depth_um - drawn.depth_um) < 1e-4 * microscope.pixel_size_um) & ~(cast.miss & drawn.miss)
    assert apart.sum() <= 4
    assert ((cast.face != drawn.face) & ~apart).sum() <= 2e-4 * apart.size
    alike = ~apart & ~drawn.miss & (cast.face == drawn.face)
    assert np.abs(cast.normal - drawn.normal)[alike].max() < 1e-6
    assert np.abs(cast.position_um - drawn.position_um)[alike].max() < 1e-6
    origins, directions = pixel_rays(microscope, pose, pixel_grid(microscope)[apart])
    exact = brute_force(meshes[name], origins, directions[0] if len(directions) else np.array([0.0, 0.0, 1.0]))
    assert np.allclose(drawn.depth_um[apart], exact, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("name", COARSE)
def test_it_equals_float64_brute_force(meshes, name):
    microscope, pose = Microscope(0.4, 320, 240), poses(TiltSchedule((12.0,), 35.0, ((0.3, -0.7),)))[0]
    depth, _ = rasterise(meshes[name], microscope, pose)
    some = np.random.default_rng(2).integers(0, [240, 320], (150, 2)).T
    origins, directions = pixel_rays(microscope, pose, pixel_grid(microscope)[tuple(some)])
    exact = brute_force(meshes[name], origins, directions[0])
    assert np.array_equal(np.isnan(depth[tuple(some)]), np.isnan(exact))
    assert np.nanmax(np.abs(depth[tuple(some)] - exact)) < 1e-9


def test_a_bent_picture_is_drawn_bent(meshes):
    """Magnification, shear and rotation between views: every hit returns to its pixel, and the rays agree."""
    pose = replace(poses(TiltSchedule((10.0,)))[0], distortion=np.array([[1.01, 0.02], [-0.015, 0.99]]))
    microscope = Microscope(0.4, 320, 240)
    drawn = surface_buffer(meshes["sphere"], microscope, pose, "zbuffer")
    back = project(microscope, pose, drawn.position_um) - pixel_grid(microscope)
    assert np.nanmax(np.abs(back)) < 1e-9
    cast = surface_buffer(meshes["sphere"], microscope, pose, "raycast")
    assert np.nanmax(np.abs(cast.depth_um - drawn.depth_um)) < 4e-5


@given(st.integers(-5, 5), st.integers(-4, 2))
def test_moving_the_specimen_by_whole_pixels_moves_the_picture(right, down):
    corners = np.array([(5.25, 4.5, 0.0), (25.5, 6.25, 4.0), (9.75, 20.5, -3.0)])
    still = rasterise(in_image(corners), MICROSCOPE, LEVEL)[0]
    moved = rasterise(in_image(corners + [right, down, 0]), MICROSCOPE, LEVEL)[0]
    assert np.allclose(moved, np.roll(still, (down, right), axis=(0, 1)), atol=1e-11, equal_nan=True)


@pytest.mark.parametrize("working_distance_um", [None, 80.0])
def test_the_coefficients_of_the_beam_give_its_rays(working_distance_um):
    microscope = Microscope(0.1, 300, 200, working_distance_um)
    pose = replace(poses(TiltSchedule((25.0,), 40.0, ((3.0, 1.0),)))[0], distortion=np.array([[1.0, 0.1], [0.0, 0.9]]))
    xy = np.random.default_rng(0).uniform(-50, 350, (40, 2))
    for coefficients, rays in zip(linear_beam(microscope, pose), pixel_rays(microscope, pose, xy), strict=True):
        assert np.allclose(coefficients[0] + xy @ coefficients[1:], rays, atol=1e-12)


@given(st.floats(-60, 60), st.floats(-180, 180))
def test_image_coordinates_are_those_of_the_projection(tilt_deg, axis_deg):
    pose = poses(TiltSchedule((tilt_deg,), axis_deg, ((1.0, -2.0),)))[0]
    xyz = np.random.default_rng(1).normal(0, 50, (20, 3))
    image = image_coordinates(MICROSCOPE, pose, xyz)
    assert np.allclose(image[:, :2], project(MICROSCOPE, pose, xyz), atol=1e-9)
    assert np.allclose(image[:, 2], (xyz @ pose.rotation.T + pose.translation_um)[:, 2], atol=1e-9)


def test_perspective_is_refused(meshes):
    with pytest.raises(InputError, match="parallel"):
        rasterise(meshes["sphere"], Microscope(0.1, 32, 24, 1000.0), Pose(LEVEL.rotation, np.zeros(3)))


@given(st.integers(1, 500))
def test_bands_cover_each_row_once(rows):
    seen = np.zeros(rows, dtype=int)
    in_bands(rows, lambda start, stop: seen.__setitem__(slice(start, stop), seen[start:stop] + 1))
    assert (seen == 1).all()


def test_what_goes_wrong_in_a_band_is_heard_of():
    def work(start: int, stop: int) -> None:
        raise InputError("band")

    with pytest.raises(InputError, match="band"):
        in_bands(10, work)
