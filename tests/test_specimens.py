"""Specimens: closed bodies of the promised shape, the same for the same seed; sentences for wrong input."""

from __future__ import annotations

import dataclasses
import hashlib
import subprocess
import sys

import numpy as np
import pytest
import tifffile
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.specimens import (
    SPECIMENS,
    Diatom,
    Fracture,
    Grains,
    HeightMapFile,
    MeshFile,
    Plane,
    Pollen,
    Pyramid,
    Sphere,
    Spheres,
    Step,
    Steps,
    Wedge,
    Wires,
    build,
    specimen_from,
)
from semsim.specimens.implicit import Grid, add_rods, polygonise, sample, smooth_max, smooth_min
from semsim.specimens.noise import solid_noise, speckle
from semsim.specimens.scatter import spaced_sphere
from semsim.specimens.substrate import visible_median_um

QUICK = {
    "pollen": Pollen(edge_um=1.3),
    "diatom": Diatom(edge_um=1.3),
    "fracture": Fracture(edge_um=2.0),
    "grains": Grains(edge_um=18.0, mineral_contrast=0.0),
    "wires": Wires(edge_um=1.4),
    "spheres": Spheres(sagitta_um=0.1, edge_um=4.0),
    "pyramid": Pyramid(edge_um=4.0),
    "steps": Steps(edge_um=4.0),
    "plane": Plane(edge_um=4.0, slope_direction_deg=30.0),
    "step": Step(edge_um=4.0),
    "sphere": Sphere(subdivisions=4),
    "wedge": Wedge(edge_um=4.0),
}
ANALYTIC = ["plane", "step", "sphere", "wedge", "pyramid", "steps"]


@pytest.fixture(scope="module")
def meshes() -> dict[str, Mesh]:
    return {name: specimen(np.random.default_rng(5)) for name, specimen in QUICK.items()}


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_um, mesh.faces, process=False)


def largest_bodies(mesh: Mesh) -> list[np.ndarray]:
    """Which faces belong to each connected body of 1 % of the faces or more."""
    count = len(mesh.vertices_um)
    links = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(links)), links.T), shape=(count, count))
    label = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    return [label == body for body in np.flatnonzero(np.bincount(label) > 0.01 * len(label))]


def heights_along_rays(mesh: Mesh, xy_um: np.ndarray) -> list[np.ndarray]:
    """Heights at which vertical lines cross the faces, brute force: one array a line, falling."""
    a, b, c = (mesh.vertices_um[mesh.faces[:, i]] for i in range(3))
    crossings = []
    for x, y in xy_um:
        w = [
            (q[:, 0] - p[:, 0]) * (y - p[:, 1]) - (q[:, 1] - p[:, 1]) * (x - p[:, 0])
            for p, q in ((b, c), (c, a), (a, b))
        ]
        inside = ((w[0] > 0) & (w[1] > 0) & (w[2] > 0)) | ((w[0] < 0) & (w[1] < 0) & (w[2] < 0))
        weights = np.stack([value[inside] for value in w])
        z = (weights * np.stack([p[inside, 2] for p in (a, b, c)])).sum(axis=0) / weights.sum(axis=0)
        crossings.append(np.sort(z)[::-1])
    return crossings


# --- contract: every specimen ----------------------------------------------------------------------------------------


def test_every_specimen_is_tried_here() -> None:
    assert {kind.name for kind in SPECIMENS} == set(QUICK)


@pytest.mark.parametrize("name", QUICK)
def test_each_edge_is_shared_by_two_faces_that_run_it_in_opposite_ways(meshes: dict[str, Mesh], name: str) -> None:
    faces = meshes[name].faces.astype(np.int64)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(meshes[name].vertices_um)
    forward = np.sort(directed[:, 0] * count + directed[:, 1])
    backward = np.sort(directed[:, 1] * count + directed[:, 0])
    assert (np.diff(forward) > 0).all()
    np.testing.assert_array_equal(forward, backward)
    assert as_trimesh(meshes[name]).is_watertight


@pytest.mark.parametrize("name", QUICK)
def test_each_body_is_oriented_outward(meshes: dict[str, Mesh], name: str) -> None:
    mesh = meshes[name]
    for body in largest_bodies(mesh):
        assert trimesh.Trimesh(mesh.vertices_um, mesh.faces[body], process=False).volume > 0


@pytest.mark.parametrize("name", QUICK)
def test_same_seed_same_arrays_and_another_seed_differs(meshes: dict[str, Mesh], name: str) -> None:
    again, other = (QUICK[name](np.random.default_rng(seed)) for seed in (5, 6))
    np.testing.assert_array_equal(again.vertices_um, meshes[name].vertices_um)
    np.testing.assert_array_equal(again.faces, meshes[name].faces)
    np.testing.assert_array_equal(again.vertex_yield, meshes[name].vertex_yield)
    same_shape = other.vertices_um.shape == again.vertices_um.shape and np.allclose(
        other.vertices_um, again.vertices_um
    )
    assert same_shape == (name in ANALYTIC)
    if name in ANALYTIC:
        assert not np.allclose(other.vertex_yield, again.vertex_yield)


def test_same_seed_same_arrays_in_another_process() -> None:
    mesh = Pollen(edge_um=3.0)(np.random.default_rng(3))
    here = hashlib.sha256(mesh.vertices_um.tobytes() + mesh.faces.tobytes() + mesh.vertex_yield.tobytes()).hexdigest()
    code = (
        "import hashlib, numpy as np; from semsim.specimens import Pollen;"
        "m = Pollen(edge_um=3.0)(np.random.default_rng(3));"
        "print(hashlib.sha256(m.vertices_um.tobytes() + m.faces.tobytes() + m.vertex_yield.tobytes()).hexdigest())"
    )
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert there.stdout.strip() == here


@pytest.mark.parametrize("name", QUICK)
def test_texture_off_leaves_the_shape_alone(meshes: dict[str, Mesh], name: str) -> None:
    plain = dataclasses.replace(QUICK[name], contrast=0.0)(np.random.default_rng(5))
    assert plain.vertex_yield is None
    np.testing.assert_array_equal(plain.vertices_um, meshes[name].vertices_um)


@pytest.mark.parametrize("name", ["pollen", "diatom", "fracture", "grains", "wires", "spheres"])
def test_the_median_visible_height_is_the_gauge(meshes: dict[str, Mesh], name: str) -> None:
    mesh, specimen = meshes[name], QUICK[name]
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.5, 0.5, (150, 2)) * (specimen.frame_width_um, specimen.frame_height_um)
    tops = np.array([crossings[0] for crossings in heights_along_rays(mesh, xy)])  # the carrier fills the frame
    assert abs(np.mean(tops > 0) - 0.5) < 4 * 0.5 / np.sqrt(len(tops))  # binomial, two-sided


# --- closed form: analytic specimens ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["plane", "sphere", "wedge"])
def test_vertices_seen_from_above_lie_on_the_formula(meshes: dict[str, Mesh], name: str) -> None:
    mesh = meshes[name]
    up = mesh.vertex_normals[:, 2] > 0.3 if name == "sphere" else np.arange(len(mesh.vertices_um)) < 41 * 41
    x, y, z = mesh.vertices_um[up].T
    np.testing.assert_allclose(QUICK[name].height_um(x, y), z, atol=1e-10)


def test_flat_faces_are_exact_between_vertices(meshes: dict[str, Mesh]) -> None:
    xy = np.random.default_rng(1).uniform(-79, 79, (50, 2))
    for name in ("plane", "step", "wedge"):
        truth = QUICK[name].height_um(*xy.T)
        seen = [crossings[0] for crossings in heights_along_rays(meshes[name], xy)]
        np.testing.assert_allclose(seen, truth, atol=1e-9)


def test_the_step_is_upright() -> None:
    step = Step(rise_um=6.0, edge_um=1.0, extent_um=20.0)
    mesh = step(np.random.default_rng(0))
    wall = np.abs(mesh.vertices_um[:, 0]) == 0
    assert np.ptp(mesh.vertices_um[wall & (mesh.vertices_um[:, 2] >= -3), 2]) == pytest.approx(6.0)
    assert step.height_um(np.array([-1e-9, 0.0]), np.zeros(2)) == pytest.approx([-3.0, 3.0])
    assert mesh.vertex_yield is not None
    assert np.std(mesh.vertex_yield[wall]) > 0


def test_a_plane_climbs_the_way_it_says() -> None:
    plane = Plane(slope_deg=45.0, slope_direction_deg=90.0)
    np.testing.assert_allclose(plane.height_um([10.0, 0.0], [0.0, 10.0]), [0.0, 10.0], atol=1e-12)


def test_off_the_surface_the_formula_is_nan() -> None:
    for specimen in (Plane(), Step(), Wedge(), Sphere()):
        assert np.isnan(specimen.height_um(np.array([500.0]), np.array([0.0]))).all()


@pytest.mark.parametrize("subdivisions", [2, 3, 4, 5])
def test_the_sagitta_bounds_the_faces_tightly(subdivisions: int) -> None:
    ball = Sphere(subdivisions=subdivisions)
    mesh = ball(np.random.default_rng(0))
    corner = mesh.vertices_um[mesh.faces[:, 0]] - [0, 0, ball.centre_z_um]
    depth = ball.radius_um - np.sum(corner * mesh.face_normals, axis=1)
    assert 0.97 * ball.sagitta_um < depth.max() <= ball.sagitta_um


# --- closed form and statistics: the parts ---------------------------------------------------------------------------


def test_an_implicit_ball_has_the_volume_of_a_ball() -> None:
    grid = Grid.around((-6.0, -6.0, -6.0), (6.0, 6.0, 6.0), 0.25)
    x, y = grid.plane()
    vertices, faces = polygonise(sample(grid, lambda z: np.sqrt(x * x + y * y + z * z) - 5.0), grid)
    body = trimesh.Trimesh(vertices, faces, process=False)
    assert body.is_watertight
    assert body.volume == pytest.approx(4 / 3 * np.pi * 125, rel=2e-3)


def test_a_ball_cut_by_the_grid_is_closed_flat() -> None:
    grid = Grid.around((-6.0, -6.0, 0.0), (6.0, 6.0, 6.0), 0.25)
    x, y = grid.plane()
    vertices, faces = polygonise(sample(grid, lambda z: np.sqrt(x * x + y * y + z * z) - 5.0), grid)
    body = trimesh.Trimesh(vertices, faces, process=False)
    assert body.is_watertight
    assert body.volume == pytest.approx(2 / 3 * np.pi * 125, rel=3e-3)


def test_a_rod_has_the_volume_of_a_capsule() -> None:
    grid = Grid.around((-3.0, -3.0, -6.0), (3.0, 3.0, 6.0), 0.2)
    volume = np.ones(grid.shape, dtype=np.float32)
    ends = np.array([[0.0, 0.0, -3.0]]), np.array([[0.0, 0.0, 3.0]])
    add_rods(volume, grid, *ends, np.array([[1.5, 1.5]]), blend_um=0.1)
    body = trimesh.Trimesh(*polygonise(volume, grid), process=False)
    assert body.volume == pytest.approx(np.pi * 1.5**2 * 6 + 4 / 3 * np.pi * 1.5**3, rel=1e-2)


@given(a=st.floats(-5, 5), b=st.floats(-5, 5), blend=st.floats(0.1, 2))
def test_blends_are_symmetric_mirrored_and_within_a_quarter(a: float, b: float, blend: float) -> None:
    low = smooth_min(np.array(a), np.array(b), blend)
    assert low == smooth_min(np.array(b), np.array(a), blend)
    assert smooth_max(np.array(-a), np.array(-b), blend) == -low
    assert min(a, b) - blend / 4 - 1e-12 <= low <= min(a, b)


def test_solid_noise_has_mean_zero_and_rms_one() -> None:
    points = np.random.default_rng(0).uniform(-1000, 1000, (200_000, 3))
    for octaves in (1, 2):
        values = solid_noise(points, 3.0, seed=11, octaves=octaves)
        assert abs(values.mean()) < 4 / np.sqrt(len(values))
        assert values.std() == pytest.approx(1.0, abs=0.015)


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.2, 20.0))
def test_solid_noise_scales_with_its_grain(scale: float) -> None:
    points = np.random.default_rng(1).uniform(-50, 50, (100, 3))
    np.testing.assert_allclose(
        solid_noise(points * scale, 2.0 * scale, seed=4), solid_noise(points, 2.0, seed=4), atol=1e-6
    )


def test_solid_noise_is_smooth_within_a_grain_and_forgotten_beyond() -> None:
    points = np.random.default_rng(2).uniform(-500, 500, (20_000, 3))
    here = solid_noise(points, 5.0, seed=8)
    correlation = [np.mean(here * solid_noise(points + [d, 0.0, 0.0], 5.0, seed=8)) for d in (0.25, 20.0)]
    assert correlation[0] > 0.97
    assert abs(correlation[1]) < 4 / np.sqrt(len(points))


def test_speckle_has_the_contrast_it_is_given() -> None:
    points = np.random.default_rng(3).uniform(-500, 500, (50_000, 3))
    values = speckle(points, 0.1, 2.0, np.random.default_rng(0))
    assert values is not None
    assert values.mean() == pytest.approx(1.0, abs=0.005)
    assert values.std() == pytest.approx(0.1, rel=0.04)


def test_darts_do_not_touch() -> None:
    directions, radius = spaced_sphere((0.05, 0.15), 2000, np.random.default_rng(0))
    apart = np.linalg.norm(directions[:, None] - directions[None], axis=2) - radius[:, None] - radius[None]
    np.fill_diagonal(apart, 1.0)
    assert len(directions) > 50
    assert apart.min() >= 0


def test_the_visible_median_ignores_what_lies_below() -> None:
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 18.0, 0.0]])
    vertices = np.vstack([corners + [0.0, 0.0, 3.0], corners + [0.0, 0.0, -40.0]])
    for order in ([[0, 1, 2], [3, 4, 5]], [[5, 4, 3], [2, 1, 0]]):
        assert visible_median_um(vertices, np.array(order, dtype=np.int32), 8.0, 8.0) == pytest.approx(3.0)


def test_the_visible_median_of_a_slope_is_its_middle() -> None:
    mesh = Plane(slope_deg=30.0, edge_um=8.0)(np.random.default_rng(0))
    shift = np.array([0.0, 0.0, 7.0])
    assert visible_median_um(mesh.vertices_um + shift, mesh.faces, 100.0, 70.0) == pytest.approx(7.0, abs=0.01)


# --- what the images show --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "reach", "depth"), [("pollen", 25.0, 3.0), ("diatom", 40.0, 1.5)])
def test_pits_are_deep_and_their_walls_overhang(meshes: dict[str, Mesh], name: str, reach: float, depth: float) -> None:
    fine = dataclasses.replace(QUICK[name], edge_um=0.6)(np.random.default_rng(5))
    corners = fine.vertices_um[fine.faces]
    middle = (np.hypot(corners[..., 0], corners[..., 1]) < reach).all(axis=1)
    part = Mesh(fine.vertices_um, fine.faces[middle & (corners[..., 2].min(axis=1) > 0)])
    assert np.mean(part.face_normals[:, 2] < -0.2) > 0.03
    lines = heights_along_rays(part, np.random.default_rng(0).uniform(-0.6 * reach, 0.6 * reach, (100, 2)))
    assert sum(len(line) >= 3 for line in lines) > 10
    tops = np.array([line[0] for line in lines if len(line)])
    assert np.percentile(tops, 95) - np.percentile(tops, 5) > depth


def test_the_grain_bulges_by_tens_of_micrometres(meshes: dict[str, Mesh]) -> None:
    z = meshes["pollen"].vertices_um[:, 2]
    assert 50 < np.ptp(z) < 90


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
def test_a_mesh_file_comes_back(tmp_path, meshes: dict[str, Mesh], suffix: str) -> None:
    mesh = meshes["sphere"]
    as_trimesh(mesh).export(tmp_path / f"ball.{suffix}")
    back = build(
        {"file": f"ball.{suffix}", "unit_um": 2.0, "centred": False}, np.random.default_rng(0), base_dir=tmp_path
    )
    assert as_trimesh(back).is_watertight
    assert as_trimesh(back).volume == pytest.approx(8 * as_trimesh(mesh).volume, rel=1e-5)
    assert np.ptp(back.vertices_um, axis=0) == pytest.approx(2 * np.ptp(mesh.vertices_um, axis=0), rel=1e-5)
    assert back.vertex_yield is None


def test_a_mesh_file_is_centred_and_speckled_on_request(tmp_path, meshes: dict[str, Mesh]) -> None:
    far = as_trimesh(meshes["sphere"])
    far.apply_translation([300.0, -200.0, 1000.0])
    far.export(tmp_path / "far.ply")
    back = MeshFile(tmp_path / "far.ply", contrast=0.1)(np.random.default_rng(0))
    ends = back.vertices_um.max(axis=0)[:2], back.vertices_um.min(axis=0)[:2]
    np.testing.assert_allclose(ends[0], -ends[1], atol=1e-3)
    middle_um = 44.0 * np.sqrt(0.5)  # half of the ball's disc is seen above this height over its centre
    assert back.vertices_um[:, 2].max() == pytest.approx(44.0 - middle_um, abs=0.5)
    assert back.vertex_yield is not None


@pytest.mark.parametrize("kind", ["npz", "tif"])
def test_a_height_map_comes_back_at_its_pixels(tmp_path, kind: str) -> None:
    z = np.random.default_rng(0).normal(size=(6, 9)).astype(np.float32)
    z -= np.median(z)
    path = tmp_path / f"h.{kind}"
    np.savez(path, z_um=z, pixel_size_um=[0.5, 0.5]) if kind == "npz" else tifffile.imwrite(path, z)
    options = {"file": path.name, "height_scale": 3.0, **({} if kind == "npz" else {"pixel_size_um": 0.5})}
    mesh = build(options, np.random.default_rng(0), tmp_path)
    column = np.round(mesh.vertices_um[:, 0] / 0.5 + 4).astype(int)
    row = np.round(2.5 - mesh.vertices_um[:, 1] / 0.5).astype(int)
    assert len(mesh.vertices_um) == z.size
    np.testing.assert_allclose(mesh.vertices_um[:, 2], 3.0 * z[row, column], atol=1e-6)
    assert (mesh.face_normals[:, 2] > 0).all()


def test_unequal_pixels_and_holes_of_a_height_map(tmp_path) -> None:
    z = np.zeros((5, 5), dtype=np.float32)
    z[2, 2] = np.nan
    np.savez(tmp_path / "h.npz", z_um=z, pixel_size_um=[1.0, 2.0])
    mesh = HeightMapFile(tmp_path / "h.npz")(np.random.default_rng(0))
    assert np.ptp(mesh.vertices_um, axis=0) == pytest.approx([4.0, 8.0, 0.0])
    assert len(mesh.vertices_um) == 24
    assert len(mesh.faces) == 32 - 6  # the hole's corner belongs to six triangles


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ["name", "file"]),
        ({"name": "pollen", "file": "x.ply"}, ["not both"]),
        ({"name": "polen"}, ["'polen'", "pollen", "wedge"]),
        ({"name": "pollen", "raduis_um": 5}, ["pollen", "'raduis_um'", "radius_um"]),
        ({"name": "pollen", "radius_um": "big"}, ["radius_um", "finite number", "'big'"]),
        ({"name": "pollen", "radius_um": float("nan")}, ["radius_um", "nan"]),
        ({"name": "pollen", "edge_um": 0.01}, ["edge_um", "from"]),
        ({"name": "diatom", "radius_um": -1}, ["radius_um", "positive"]),
        ({"name": "sphere", "subdivisions": 2.5}, ["subdivisions", "whole number"]),
        ({"name": "plane", "slope_deg": 90}, ["slope_deg", "80"]),
        ({"file": "x.ply", "centred": "no"}, ["centred", "true or false"]),
        ({"file": "x.ply", "unit_um": 0}, ["unit_um", "positive"]),
        ({"file": "x.npz", "unit_um": 1.0}, ["'unit_um'", "pixel_size_um"]),
        ({"file": "x.npz", "pixel_size_um": -1.0}, ["pixel_size_um", "positive"]),
    ],
)
def test_a_wrong_option_is_named_in_one_sentence(options: dict, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        specimen_from(options)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_file_is_named_in_one_sentence(tmp_path) -> None:
    (tmp_path / "words.ply").write_text("not a mesh")
    (tmp_path / "words.tif").write_text("not a picture")
    (tmp_path / "words.npz").write_text("not an archive")
    np.savez(tmp_path / "other.npz", depth=np.zeros((3, 3)))
    np.savez(tmp_path / "line.npz", z_um=np.zeros(3), pixel_size_um=1.0)
    np.savez(tmp_path / "sizeless.npz", z_um=np.zeros((3, 3)))
    np.savez(tmp_path / "empty.npz", z_um=np.full((3, 3), np.nan), pixel_size_um=1.0)
    tifffile.imwrite(tmp_path / "grey.tif", np.zeros((4, 4), np.uint8))
    trimesh.PointCloud(np.zeros((3, 3))).export(tmp_path / "points.ply")
    wanted = {
        "missing.ply": "there is no",
        "missing.npz": "there is no",
        "words.ply": "cannot be read",
        "words.tif": "cannot be read",
        "words.npz": "cannot be read",
        "other.npz": "depth",
        "line.npz": "table of heights",
        "sizeless.npz": "pixel_size_um",
        "empty.npz": "table of heights",
        "grey.tif": "uint8",
        "points.ply": "no triangles",
    }
    for name, word in wanted.items():
        with pytest.raises(InputError) as caught:
            build({"file": name}, np.random.default_rng(0), tmp_path)
        assert name in str(caught.value)
        assert word in str(caught.value), str(caught.value)
        assert "\n" not in str(caught.value)
