"""Fracture, grains, wires, spheres, pyramid and steps: each is what its options say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from test_specimens import as_trimesh, heights_along_rays, largest_bodies

from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.specimens import (
    Fracture,
    Grains,
    HeightMapFile,
    MeshFile,
    Pyramid,
    Spheres,
    Steps,
    Wires,
    specimen_from,
)
from semsim.specimens.analytic import ball
from semsim.specimens.packing import Polyhedra, settled
from semsim.specimens.relief import roughened
from semsim.specimens.sheet import welded
from semsim.specimens.wires import tube

BARE = Fracture(faceting=0.0, roughness_um=0.0, edge_um=0.5, roll_off_um=60.0)


def grid_of(specimen: Fracture, seed: int) -> np.ndarray:
    """Heights of a fracture over its grid, (nx, ny), read off its mesh."""
    vertices = specimen(np.random.default_rng(seed)).vertices_um
    x, y = (np.unique(vertices[:, axis]) for axis in (0, 1))
    return vertices[: len(x) * len(y), 2].reshape(len(x), len(y))


def in_frame(specimen: Fracture, z_um: np.ndarray) -> np.ndarray:
    """The heights over the frame; the grid has a point at the origin."""
    half = [int(size / 2 / specimen.edge_um) for size in (specimen.frame_width_um, specimen.frame_height_um)]
    mid = [n // 2 for n in z_um.shape]
    return z_um[mid[0] - half[0] : mid[0] + half[0] + 1, mid[1] - half[1] : mid[1] + half[1] + 1]


def hurst_of(z_um: np.ndarray, step_um: float, low: float, high: float) -> float:
    """Hurst exponent from the slope of the windowed, ring-averaged power spectrum between two wave numbers, 1/um."""
    window = np.hanning(z_um.shape[0])[:, None] * np.hanning(z_um.shape[1])
    power = (np.abs(np.fft.fft2((z_um - z_um.mean()) * window)) ** 2).ravel()
    q = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n, step_um) for n in z_um.shape), indexing="ij")).ravel()
    ring = np.digitize(q, np.geomspace(low, high, 12))
    rings = [ring == n for n in range(1, 12)]
    slope = np.polyfit([np.log(q[r]).mean() for r in rings], [np.log(power[r].mean()) for r in rings], 1)[0]
    return -slope / 2 - 1


# --- fracture --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hurst", [0.3, 0.6, 0.9])
def test_the_spectrum_of_a_fracture_has_the_hurst_exponent(hurst: float) -> None:
    specimen = dataclasses.replace(BARE, hurst=hurst)
    found = np.array([hurst_of(grid_of(specimen, seed), 0.5, 0.1, 0.6) for seed in range(8)])
    assert found.mean() == pytest.approx(hurst, abs=0.03)
    assert found.std() < 0.05


def test_a_fracture_is_level_above_its_roll_off() -> None:
    specimen = dataclasses.replace(BARE, roll_off_um=10.0, frame_width_um=200.0, frame_height_um=200.0, edge_um=1.0)
    # a level spectrum is white noise, whose slope is that of a Hurst exponent of -1
    found = [hurst_of(grid_of(specimen, seed), 1.0, 0.012, 0.08) for seed in range(8)]
    assert np.mean(found) == pytest.approx(-1.0, abs=0.1)


@pytest.mark.parametrize("faceting", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("rms_um", [0.5, 8.0])
def test_a_fracture_has_the_rms_it_is_given(faceting: float, rms_um: float) -> None:
    specimen = dataclasses.replace(BARE, faceting=faceting, rms_um=rms_um, edge_um=2.0)
    assert in_frame(specimen, grid_of(specimen, 4)).std() == pytest.approx(rms_um, rel=1e-9)


def test_facets_are_flatter_than_rock_and_their_steps_steeper() -> None:
    rock, facets = (grid_of(dataclasses.replace(BARE, faceting=share), 2) for share in (0.0, 1.0))
    bends = [np.abs(np.diff(z, 2, axis=0)).ravel() for z in (rock, facets)]
    assert np.median(bends[1]) < 0.05 * np.median(bends[0])
    assert np.percentile(bends[1], 99.9) > 2 * np.percentile(bends[0], 99.9)


def test_a_fracture_can_be_a_mirror() -> None:
    mesh = dataclasses.replace(BARE, rms_um=0.0, contrast=0.0, edge_um=4.0)(np.random.default_rng(0))
    top = mesh.face_normals[:, 2] > 0.5
    assert mesh.vertex_yield is None
    np.testing.assert_array_equal(mesh.vertices_um[mesh.faces[top], 2], 0.0)


def test_roughness_adds_its_own_variance() -> None:
    rough = dataclasses.replace(BARE, rms_um=0.0, roughness_um=0.2)
    assert grid_of(rough, 1).std() == pytest.approx(0.2, rel=0.05)


# --- grains ----------------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), tries=st.integers(1, 40))
def test_settled_balls_touch_something_below_and_cut_nothing(seed: int, tries: int) -> None:
    rng = np.random.default_rng(seed)
    radii = rng.uniform(2.0, 6.0, 40)
    middles = settled(radii, 40.0, 30.0, tries, rng)
    gaps = np.linalg.norm(middles[:, None] - middles[None], axis=2) - radii[:, None] - radii[None]
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() > -1e-9
    earlier = np.tril(np.ones_like(gaps, dtype=bool), -1)
    to_something = np.minimum(np.where(earlier, gaps, np.inf).min(axis=1), middles[:, 2] - radii)
    np.testing.assert_allclose(to_something, 0.0, atol=1e-9)
    assert (np.abs(middles[:, :2]) + radii[:, None] <= np.array([20.0, 15.0]) + 1e-9).all()


def test_more_tries_pack_more_densely() -> None:
    radii = np.full(150, 3.0)
    tops = [settled(radii, 40.0, 40.0, tries, np.random.default_rng(0))[:, 2].mean() for tries in (1, 30, 1000)]
    assert tops[0] > tops[1] > tops[2]


def test_a_cut_grain_lies_within_its_planes() -> None:
    cut = Polyhedra.cut(np.zeros((6, 3)), np.full(6, 50.0), 0.0, np.random.default_rng(0))
    inside = np.einsum("npc,qc->nqp", cut.normal, np.random.default_rng(1).uniform(-50, 50, (4000, 3)))
    inside = (inside < cut.distance_um[:, None]).all(axis=2)
    ball = 4 / 3 * np.pi * 50.0**3 / 100.0**3
    assert (inside.mean(axis=1) < ball).all()
    assert (inside.mean(axis=1) > 0.3 * ball).all()


@pytest.fixture(scope="module")
def bed() -> Mesh:
    return Grains(edge_um=9.0, contrast=0.0)(np.random.default_rng(5))


def test_the_bed_has_pores_and_overhangs_but_no_holes_through_it(bed: Mesh) -> None:
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (80, 2)) * (1000.0, 750.0)
    lines = heights_along_rays(bed, xy)
    assert all(len(line) % 2 == 0 and len(line) >= 2 for line in lines)
    assert np.mean([len(line) >= 4 for line in lines]) > 0.4
    assert np.mean(bed.face_normals[:, 2] < -0.3) > 0.15
    tops = np.array([line[0] for line in lines])
    assert 75.0 < np.percentile(tops, 95) - np.percentile(tops, 5) < 400.0


def test_the_bed_hangs_together(bed: Mesh) -> None:
    sizes = [body.sum() for body in largest_bodies(bed)]
    assert max(sizes) > 0.8 * len(bed.faces)


def test_each_grain_is_of_one_mineral(bed: Mesh) -> None:
    assert bed.vertex_yield is not None
    along = bed.vertex_yield[bed.faces]
    assert np.mean(np.ptp(along, axis=1) == 0) > 0.8
    assert 0.04 < np.std(bed.vertex_yield) < 0.12
    plain = Grains(edge_um=20.0, contrast=0.0, mineral_contrast=0.0)(np.random.default_rng(5))
    assert plain.vertex_yield is None


# --- wires -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [-0.5, 0.5, 0.3]])
def test_a_straight_tube_is_a_capsule(direction: list[float]) -> None:
    way = np.array(direction) / np.linalg.norm(direction)
    vertices, faces = tube(np.linspace(-5.0, 5.0, 80)[:, None] * way, 1.5, 0.1)
    body = trimesh.Trimesh(vertices, faces, process=False)
    assert body.is_watertight
    assert body.volume == pytest.approx(np.pi * 1.5**2 * 10 + 4 / 3 * np.pi * 1.5**3, rel=5e-3)
    along = np.clip(vertices @ way, -5.0, 5.0)
    np.testing.assert_allclose(np.linalg.norm(vertices - along[:, None] * way, axis=1), 1.5, atol=1e-12)


@pytest.mark.parametrize("woven", [False, True])
def test_wires_do_not_cut_each_other(woven: bool) -> None:
    wires = Wires(edge_um=0.8, count=30, woven=woven)
    lines = wires._woven() if woven else wires._strewn(np.random.default_rng(3))
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    points = np.vstack(lines)
    pairs = cKDTree(points).query_pairs(1.999 * wires.radius_um, output_type="ndarray")
    assert (owner[pairs[:, 0]] == owner[pairs[:, 1]]).all()
    touching = cKDTree(points).query_pairs(2.1 * wires.radius_um, output_type="ndarray")
    assert (owner[touching[:, 0]] != owner[touching[:, 1]]).any()


def test_a_wire_passes_over_one_and_under_the_next() -> None:
    wires = Wires(woven=True, edge_um=0.5)
    line = next(w for w in wires._woven() if np.ptp(w[:, 1]) == 0 and w[0, 1] == 0)
    at_crossings = np.interp(np.arange(-3, 4) * wires.pitch_um, line[:, 0], line[:, 2])
    np.testing.assert_allclose(np.abs(at_crossings), 1.02 * wires.radius_um, rtol=1e-2)
    assert (np.diff(np.sign(at_crossings)) != 0).all()


def test_wires_hang_free_over_the_carrier() -> None:
    mesh = Wires(edge_um=1.0, clearance_um=6.0)(np.random.default_rng(1))
    lines = heights_along_rays(mesh, np.random.default_rng(0).uniform(-45, 45, (60, 2)))
    assert np.mean([len(line) >= 4 for line in lines]) > 0.4  # a wire, air, the carrier
    air = [line[-3] - line[-2] for line in lines if len(line) >= 4]
    assert min(air) > 0


def test_relief_has_its_standard_deviation_and_moves_along_the_normal() -> None:
    vertices, faces = ball(30.0, 6)
    out = np.linalg.norm(roughened(vertices, faces, 0.01, 1.0, np.random.default_rng(2)), axis=1) - 30.0
    assert out.std() == pytest.approx(0.01 * np.hypot(1.0, 3.5), rel=0.06)
    assert abs(out.mean()) < 4 * out.std() / np.sqrt(4 * np.pi * (30.0 / 3.5) ** 2)
    np.testing.assert_array_equal(roughened(vertices, faces, 0.0, 1.0, np.random.default_rng(2)), vertices)


@pytest.mark.parametrize("factor", [0.01, 20.0])
@pytest.mark.parametrize(
    "specimen",
    [
        Fracture(edge_um=2.5, contrast=0.0),
        Grains(edge_um=20.0, contrast=0.0),
        Wires(edge_um=1.5, contrast=0.0, count=12),
        Spheres(sagitta_um=0.2, edge_um=6.0, contrast=0.0),
    ],
    ids=lambda s: s.name,
)
def test_a_specimen_with_every_length_scaled_is_the_same_at_another_size(
    specimen: Fracture | Grains | Wires | Spheres, factor: float
) -> None:
    names = [field.name for field in dataclasses.fields(specimen) if field.name.endswith("_um")]
    other = dataclasses.replace(specimen, **{name: factor * getattr(specimen, name) for name in names})
    here, there = (s(np.random.default_rng(3)).vertices_um for s in (specimen, other))
    upper = np.flatnonzero(here[:, 2] > np.percentile(here[:, 2], 5))  # a slab is as thick as ever
    np.testing.assert_allclose(there[upper], factor * here[upper], atol=1e-4 * factor)


# --- spheres ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def balls() -> list[Mesh]:
    """The bodies of a spheres specimen, the carrier left out."""
    specimen = Spheres(sagitta_um=0.02, edge_um=4.0)
    mesh = specimen(np.random.default_rng(2))
    bodies = as_trimesh(mesh).split(only_watertight=True)
    assert all(body.is_watertight for body in bodies)
    widest = max(bodies, key=lambda body: np.ptp(body.vertices[:, 0]))
    return [Mesh(np.array(b.vertices), np.array(b.faces, dtype=np.int32)) for b in bodies if b is not widest]


def middle_and_radius(body: Mesh) -> tuple[np.ndarray, float]:
    """Least-squares sphere through the vertices."""
    v = body.vertices_um
    (*middle, rest), *_ = np.linalg.lstsq(np.column_stack([2 * v, np.ones(len(v))]), np.sum(v * v, axis=1))
    return np.array(middle), float(np.sqrt(rest + np.dot(middle, middle)))


def test_every_vertex_of_a_ball_lies_on_a_sphere_of_a_stated_radius(balls: list[Mesh]) -> None:
    stated = np.array(Spheres().radii_um)
    found = set()
    for body in balls:
        middle, radius = middle_and_radius(body)
        nearest = int(np.argmin(np.abs(stated - radius)))
        assert radius == pytest.approx(stated[nearest], abs=1e-9)
        np.testing.assert_allclose(np.linalg.norm(body.vertices_um - middle, axis=1), radius, atol=1e-9)
        depth = radius - np.sum((body.vertices_um[body.faces[:, 0]] - middle) * body.face_normals, axis=1)
        assert 0.02 / 5 < depth.max() <= 0.02
        found.add(nearest)
    assert found == set(range(5))


def test_balls_rest_on_one_plane_and_touch_but_do_not_cut(balls: list[Mesh]) -> None:
    fits = [middle_and_radius(body) for body in balls]
    middles, radii = np.array([m for m, _ in fits]), np.array([r for _, r in fits])
    assert np.ptp(middles[:, 2] - radii) < 1e-9
    gaps = np.linalg.norm(middles[:, None] - middles[None], axis=2) - radii[:, None] - radii[None]
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() > -1e-9
    assert np.sum(gaps.min(axis=1) < 1e-6) > 0.2 * len(balls)


# --- steps and pyramid -----------------------------------------------------------------------------------------------

ARTEFACTS = [
    Steps(edge_um=1.3),
    Steps(edge_um=1.3, wall_deg=90.0, levels=2, rise_um=0.7, pitch_um=7.3),
    Steps(edge_um=2.0, wall_deg=54.7, levels=3, pitch_um=31.0, extent_um=101.0),
    Pyramid(edge_um=1.7),
    Pyramid(edge_um=1.7, wall_deg=90.0),
    Pyramid(edge_um=2.0, wall_deg=54.7, terraces=3, top_um=20.0, tread_um=12.0),
]


@pytest.mark.parametrize("specimen", ARTEFACTS, ids=lambda s: f"{s.name}-{s.wall_deg}")
def test_an_artefact_lies_on_its_formula_between_vertices_too(specimen: Steps | Pyramid) -> None:
    mesh = specimen(np.random.default_rng(0))
    assert as_trimesh(mesh).is_watertight
    half = specimen.extent_um / 2
    xy = np.random.default_rng(1).uniform(-half, half, (150, 2))
    seen = [line[0] for line in heights_along_rays(mesh, xy)]
    np.testing.assert_allclose(seen, specimen.height_um(*xy.T), atol=1e-9)


def test_a_staircase_has_its_rise_pitch_and_levels() -> None:
    stairs = Steps(rise_um=1.5, pitch_um=8.0, levels=4)
    x = np.arange(-8, 9) * 8.0
    z = stairs.height_um(x, np.zeros(17))
    np.testing.assert_allclose(z[8:15], [-2.25, -0.75, 0.75, 2.25, 0.75, -0.75, -2.25], atol=1e-12)
    np.testing.assert_allclose(z, z[::-1])
    middle = stairs.height_um(np.array([4.0]), np.zeros(1))  # of the wall between numbers 0 and 1
    assert middle == pytest.approx(-1.5)


@pytest.mark.parametrize("wall_deg", [45.0, 80.0, 85.0])
def test_walls_have_the_slope_they_are_given(wall_deg: float) -> None:
    stairs = Steps(wall_deg=wall_deg, edge_um=2.0)
    tops = stairs(np.random.default_rng(0)).face_normals
    slopes = np.rad2deg(np.arccos(tops[(tops[:, 2] > 1e-3), 2]))
    assert set(np.round(slopes, 6)) == {0.0, wall_deg}


def test_an_upright_pyramid_has_the_volume_of_its_blocks() -> None:
    pyramid = Pyramid(wall_deg=90.0, edge_um=3.0)
    body = as_trimesh(pyramid(np.random.default_rng(0)))
    sides = 14.0 + 14.0 * np.arange(6)
    assert body.volume == pytest.approx(160.0**2 * 5.0 + 3.0 * np.sum(sides**2))
    assert body.vertices[:, 2].max() == pytest.approx(pyramid.ground_um + 18.0)


def test_the_median_of_a_pyramid_over_its_frame_is_zero() -> None:
    pyramid = Pyramid()
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 20_000)) * np.array([[125.6], [94.1]])
    assert abs(np.median(pyramid.height_um(x, y))) < 1e-9


def test_welding_joins_what_coincides_and_leaves_the_rest() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices, faces = welded(corners, np.array([[0, 1, 2], [3, 4, 5], [0, 3, 5]], dtype=np.int32))
    assert len(vertices) == 4
    assert len(faces) == 2
    assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(1.0)


# --- files -----------------------------------------------------------------------------------------------------------


def test_smoothing_takes_noise_off_a_height_map_by_the_stated_amount(tmp_path: Path) -> None:
    z = np.random.default_rng(0).normal(size=(300, 400))
    z[100:120, 200:220] = np.nan
    np.savez(tmp_path / "h.npz", z_um=z, pixel_size_um=[0.5, 0.5])
    raw, smooth = (HeightMapFile(tmp_path / "h.npz", smooth_um=s)(np.random.default_rng(0)) for s in (0.0, 1.5))
    assert len(smooth.vertices_um) == len(raw.vertices_um) == z.size - 400
    # white noise through a Gaussian of s pixels keeps 1 / (4 pi s^2) of its variance
    assert smooth.vertices_um[:, 2].std() == pytest.approx(1 / (2 * np.sqrt(np.pi) * 3.0), rel=0.06)
    assert raw.vertices_um[:, 2].std() == pytest.approx(1.0, rel=0.02)


def test_smoothing_leaves_a_level_map_with_holes_level(tmp_path: Path) -> None:
    z = np.full((20, 20), 7.0)
    z[5:8, 5:8] = np.nan
    np.savez(tmp_path / "h.npz", z_um=z, pixel_size_um=1.0)
    mesh = HeightMapFile(tmp_path / "h.npz", smooth_um=2.0)(np.random.default_rng(0))
    np.testing.assert_allclose(mesh.vertices_um[:, 2], 0.0, atol=1e-12)


def test_measured_surfaces_and_a_scanned_mesh_can_be_photographed(real_data: Path) -> None:
    for path in sorted((real_data / "heights").glob("*.npz")):
        mesh = HeightMapFile(path, height_scale=3.0, contrast=0.05)(np.random.default_rng(0))
        assert abs(np.median(mesh.vertices_um[:, 2])) < 1e-3 * np.ptp(mesh.vertices_um[:, 0])
    scan = MeshFile(real_data / "meshes" / "ct_grains.ply")(np.random.default_rng(0))
    assert as_trimesh(scan).is_watertight


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"name": "fracture", "hurst": 1.2}, ["hurst", "from 0 to 1"]),
        ({"name": "fracture", "rms_um": -1.0}, ["rms_um", "negative"]),
        ({"name": "fracture", "roll_off_um": 0.1}, ["roll_off_um", "0.68"]),
        ({"name": "grains", "edge_um": 50.0}, ["edge_um", "30"]),
        ({"name": "grains", "layers": 0.2}, ["layers", "from 1 to 6"]),
        ({"name": "wires", "woven": 1}, ["woven", "true or false"]),
        ({"name": "wires", "pitch_um": 2.0}, ["pitch_um", "4.8"]),
        ({"name": "spheres", "largest_um": 1.0}, ["largest_um", "from 2"]),
        ({"name": "spheres", "count": 3.5}, ["count", "whole number"]),
        ({"name": "steps", "wall_deg": 95.0}, ["wall_deg", "90"]),
        ({"name": "steps", "levels": 1}, ["levels", "from 2"]),
        ({"name": "pyramid", "top_um": 500.0}, ["top_um", "from"]),
        ({"file": "x.npz", "smooth_um": -1.0}, ["smooth_um", "0 or more"]),
    ],
)
def test_a_wrong_option_is_named(options: dict, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        specimen_from(options)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)
