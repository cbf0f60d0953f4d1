"""The sky of places on a specimen against formulas, against rays, and against itself from elsewhere."""

import numpy as np
import pytest
from joined_meshes import inside_out, sheet, together

from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses, project
from semsim.shadowing import DIRECTIONS, sky_visibility
from semsim.surface import SurfaceBuffer, surface_buffer

MICROSCOPE = Microscope(0.5, 160, 120)
REACH_UM = 10.0


def relief(height) -> Mesh:
    """A height field over (-60, 60) um on a grid of 0.5 um."""
    x, y = np.meshgrid(np.arange(-60, 60.5, 0.5), np.arange(-60, 60.5, 0.5))
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)
    a = (np.arange(len(x) - 1)[:, None] * x.shape[1] + np.arange(x.shape[1] - 1)).ravel()
    b, c, d = a + 1, a + x.shape[1], a + x.shape[1] + 1
    return Mesh(vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32))


def bumps(x, y):
    return 4.5 * np.sin(x / 3.0) * np.cos(y / 2.5) + 0.15 * x


def ball(x: float, y: float, z: float, radius: float) -> Mesh:
    turn, polar = np.linspace(0, 2 * np.pi, 97)[:-1], np.linspace(0, np.pi, 49)[1:-1]
    ring = np.stack(
        np.broadcast_arrays(
            np.sin(polar)[:, None] * np.cos(turn), np.sin(polar)[:, None] * np.sin(turn), np.cos(polar)[:, None]
        ),
        axis=-1,
    )
    vertices = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]) * radius + (x, y, z)
    k, count = np.arange(96), len(polar)
    after = (k + 1) % 96
    caps = [np.stack([k * 0 + 96 * count, k, after], 1), np.stack([k * 0 + 96 * count + 1, after, k], 1)]
    caps[1][:, 1:] += 96 * (count - 1)
    belts = [
        np.stack(corners, 1) + 96 * i
        for i in range(count - 1)
        for corners in ((k, 96 + k, 96 + after), (k, 96 + after, after))
    ]
    return Mesh(vertices, np.concatenate([*caps, *belts]).astype(np.int32))


def photographed(mesh: Mesh, tilt_deg: float = 0.0, axis_deg: float = 0.0, microscope: Microscope = MICROSCOPE):
    """One view, and the sky of its places."""
    pose = poses(TiltSchedule((tilt_deg,), axis_deg))[0]
    buffer = surface_buffer(mesh, microscope, pose)
    return buffer, sky_visibility(buffer, mesh, microscope.pixel_size_um, REACH_UM)


def by_rays(mesh: Mesh, buffer: SurfaceBuffer, places, rays: int = 256):
    """Share of the cosine-weighted sky, each ray weighted by the distance of its first hit."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices_um.astype(np.float32), mesh.faces.astype(np.uint32))
    normal, position = buffer.normal[places], buffer.position_um[places]
    one = np.cross(normal, [0.3, 0.5, 0.8])
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two = np.cross(normal, one)
    k, phase = np.arange(rays), np.random.default_rng(0).uniform(size=(len(normal), 1, 2))
    squared, turn = ((k + 0.5) / rays + phase[..., 0]) % 1, 2 * np.pi * (k * 0.6180339887 + phase[..., 1])
    local = np.sqrt(squared) * np.cos(turn), np.sqrt(squared) * np.sin(turn), np.sqrt(1 - squared)
    way = sum(part[..., None] * axis[:, None] for part, axis in zip(local, (one, two, normal), strict=True))
    start = np.broadcast_to((position + 0.01 * normal)[:, None], way.shape)
    hit = scene.cast_rays(np.concatenate([start, way], axis=-1).astype(np.float32))["t_hit"].numpy()
    return 1 - np.clip(1 - (hit / REACH_UM) ** 2, 0, 1).mean(axis=1)


@pytest.mark.parametrize("tilt_deg", [0.0, 12.0])
def test_the_scan_finds_the_sky_that_rays_find(tilt_deg):
    """Bumps of up to 55 degrees: measured RMS 0.009 and 0.006 of a sky that varies by 0.15; rays are good to 0.01."""
    mesh = relief(bumps)
    buffer, sky = photographed(mesh, tilt_deg, 30.0)
    places = tuple(np.random.default_rng(4).integers(25, [95, 135], (600, 2)).T)
    rays = by_rays(mesh, buffer, places)
    assert np.std(rays) > 0.1
    assert np.sqrt(np.mean((sky[places] - rays) ** 2)) < 0.02
    assert abs((sky[places] - rays).mean()) < 0.01


def test_what_hangs_over_the_floor_has_a_lower_side():
    """A ball in the air, seen at 30 degrees: the floor below it and its own lower half, both against rays."""
    mesh, microscope = together(ball(0.0, 0.0, 7.5, 6.0), sheet()), Microscope(0.2, 200, 150)
    buffer, sky = photographed(mesh, 30.0, 0.0, microscope)
    floor, under = buffer.face >= len(mesh.faces) - 2, buffer.normal[..., 2] < -0.1
    below = floor & (np.hypot(*buffer.position_um[..., :2].transpose(2, 0, 1)) < 5.0)
    for chosen, darkest in ((floor, 0.6), (below, 0.6), (under, 0.9)):
        places = tuple(part[::2] for part in np.nonzero(chosen))
        assert len(places[0]) > 40
        rays = by_rays(mesh, buffer, places)
        assert rays.min() < darkest
        assert np.sqrt(np.mean((sky[places] - rays) ** 2)) < 0.02
    assert sky[below].min() > 0.3  # a wall down to the floor would leave nothing


def test_a_place_has_the_same_sky_in_every_view():
    """Two tilts 18 degrees apart, one of them in perspective: what remains is interpolation between pixels."""
    mesh = together(ball(-9.0, 2.0, 7.0, 5.0), ball(6.0, -4.0, 4.0, 5.0), sheet())
    near = Microscope(0.25, 200, 150, working_distance_um=300.0)
    pose = poses(TiltSchedule((9.0,)))[0]
    here, of_here = photographed(mesh, -9.0, 0.0, Microscope(0.25, 200, 150))
    there, of_there = photographed(mesh, 9.0, 0.0, near)
    column, row = np.rint(project(near, pose, here.position_um)).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < 150) & (column >= 0) & (column < 200)
    row, column = row[inside], column[inside]
    same = np.linalg.norm(there.position_um[row, column] - here.position_um[inside], axis=-1) < 0.25
    assert same.mean() > 0.8
    difference = (of_there[row, column] - of_here[inside])[same]
    assert np.sqrt(np.mean(difference**2)) < 0.01
    assert np.std(of_here) > 0.05


def test_a_crop_of_the_picture_leaves_the_sky_as_it_is():
    """What a view does not show casts its shadow too."""
    mesh = together(ball(0.0, 0.0, 5.0, 5.0), sheet())
    whole, sky = photographed(mesh, 12.0)
    part = SurfaceBuffer(*(each[:, :70] for each in (whole.depth_um, whole.position_um, whole.normal, whole.face)))
    cropped = sky_visibility(part, mesh, MICROSCOPE.pixel_size_um, REACH_UM)
    assert cropped.min() < 0.9
    np.testing.assert_allclose(cropped, sky[:, :70], rtol=0, atol=1e-12)


def test_an_inside_out_mesh_has_the_same_sky():
    mesh = together(ball(0.0, 0.0, 9.0, 6.0), ball(8.0, 3.0, 4.0, 5.0), sheet())
    _, sky = photographed(mesh, 12.0)
    _, turned = photographed(inside_out(mesh), 12.0)
    assert sky.min() < 0.6
    np.testing.assert_allclose(turned, sky, rtol=0, atol=1e-9)


def test_what_is_sunk_in_the_ground_has_no_lower_side():
    """A ball half in an open sheet is a dome on it: its lower half is inside the ground, and shades nothing."""
    x, y = np.meshgrid(np.linspace(-4.9, 4.9, 197), np.linspace(-4.9, 4.9, 197))
    dome = np.sqrt(np.maximum(4.9**2 - x**2 - y**2, 0.0))
    a = (np.arange(196)[:, None] * 197 + np.arange(196)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 198], 1), np.stack([a, a + 198, a + 197], 1)]).astype(np.int32)
    capped = together(Mesh(np.stack([x, y, dome], -1).reshape(-1, 3), faces), sheet(-1e-3))
    buffer, sunk = photographed(together(ball(0.0, 0.0, 0.0, 4.9), sheet()))
    _, whole = photographed(capped)
    floor = np.hypot(*buffer.position_um[..., :2].transpose(2, 0, 1)) > 5.2  # clear of the edge, which is rounded
    assert sunk[floor].min() < 0.7
    assert np.abs(sunk - whole)[floor].max() < 0.05
    assert np.abs(sunk - whole)[floor].mean() < 0.002


def test_a_sheet_reaches_down_for_ever():
    """A step between two open sheets is a wall, though no triangle stands there."""
    low, high = sheet(0.0), sheet(20.0)
    high = Mesh(high.vertices_um * (0.5, 1.0, 1.0) + (30.0, 0.0, 0.0), high.faces)
    buffer, sky = photographed(together(low, high))
    foot = (buffer.position_um[60, :, 0] < 0.0) & (buffer.position_um[60, :, 0] > -0.6)
    assert foot.any()
    assert sky[60, foot].max() < 0.6
    assert sky[60, buffer.position_um[60, :, 0] > 0].min() == 1.0


@pytest.mark.parametrize("steep", [1e-9, 0.3, 2.0])
def test_an_underside_over_nothing_sees_its_whole_sky_and_over_a_floor_does_not(steep):
    """The lower side of a plane, which no view shows from above: half of its sky is below it."""
    normal = np.array([steep, 0.0, -1.0]) / np.hypot(steep, 1.0)
    position = np.array([[[1.1, 2.3, 5.0 + 1.1 * steep]]])
    place = SurfaceBuffer(np.zeros((1, 1)), position, normal[None, None], np.zeros((1, 1), np.int32))
    plane = sheet()
    plane = Mesh(plane.vertices_um * (0.2, 0.2, 1.0), plane.faces)
    slab = np.concatenate([plane.vertices_um, plane.vertices_um + (0.0, 0.0, 1.0)])
    slab[:, 2] += 5.0 + steep * slab[:, 0]
    lid = Mesh(slab, np.concatenate([plane.faces[:, ::-1], plane.faces + 4]).astype(np.int32))
    alone = sky_visibility(place, lid, 0.5, REACH_UM)[0, 0]
    assert alone == pytest.approx(1.0, abs=1e-9)
    over = sky_visibility(place, together(lid, sheet(-2.0 - 12.0 * steep)), 0.5, 40.0 * (1.0 + steep))[0, 0]
    assert 0.0 <= over < 0.5 if steep < 1 else over < 0.9


def test_misses_have_no_sky():
    buffer, sky = photographed(ball(0.0, 0.0, 5.0, 5.0))
    assert buffer.miss.any()
    np.testing.assert_array_equal(np.isnan(sky), buffer.miss)
    nothing = photographed(sheet(width=1.0), microscope=Microscope(1e-3, 16, 12))[0]
    away = SurfaceBuffer(nothing.depth_um * np.nan, nothing.position_um * np.nan, nothing.normal, nothing.face * 0 - 1)
    assert np.isnan(sky_visibility(away, sheet(), 0.5, REACH_UM)).all()


@pytest.mark.parametrize("slope", [0.5, 1.0, 2.0])
def test_the_bottom_of_a_long_groove_sees_the_sky_of_the_formula(slope):
    """Between two walls of slope s that run on for ever, level ground sees ``mean of cos(h)^2, tan(h) = s cos(turn)``.

    On average over all directions that is ``1 / sqrt(1 + s^2)``; sixteen directions make it a sum. At a crease the
    nearest lines stray from their directions by up to 30 degrees, and the steepest of them counts: measured 0.009 to
    0.024 too dark.
    """
    mesh = relief(lambda x, y: slope * np.abs(x) + 0 * y)
    buffer, _ = photographed(mesh, microscope=Microscope(0.25, 81, 61))
    turn = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    expected = np.mean(1 / (1 + (slope * np.cos(turn)) ** 2))
    assert expected == pytest.approx(1 / np.sqrt(1 + slope**2), abs=0.002)
    scan = sky_visibility(buffer, mesh, 0.25, 1e5)[30, 40]
    assert scan == pytest.approx(expected, abs=0.03)


def test_a_quarter_turn_of_the_specimen_turns_the_sky():
    """The directions turn into one another; the lengths of their steps do not quite."""
    turned = relief(lambda x, y: bumps(y, -x))
    one, two = (photographed(mesh, microscope=Microscope(0.5, 101, 101))[1] for mesh in (relief(bumps), turned))
    inside = (slice(25, 76), slice(25, 76))
    best = min(np.abs(np.rot90(one, k)[inside] - two[inside]).mean() for k in (1, 3))
    assert best < 0.01
    assert np.abs(one[inside] - two[inside]).mean() > 0.05
