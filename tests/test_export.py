"""Claims on what a reconstruction folder may hold beside its fixed files: further formats and Poisson meshes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import Result
from known_surface import KnowsTheBump, bump_series, bump_um
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.data import PointCloud
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, tilt_rotation
from semrecon.input.series import write_series
from semrecon.methods import METHODS
from semrecon.output.export import FILES, MORE, write_reconstruction
from semrecon.pipeline import reconstruct
from semrecon.surface.poisson import poisson_mesh, with_mesh

RADIUS_UM, CAP_UM = 10.0, 6.0


@pytest.fixture
def series(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("semrecon.methods.METHODS", (*METHODS, KnowsTheBump()))
    write_series(bump_series(), tmp_path / "series")
    return tmp_path / "series"


def run(series: Path, *options: str) -> Result:
    arguments = [
        "reconstruct",
        str(series),
        "--method",
        "knows_the_bump",
        "--out",
        str(series.parent / "out"),
        *options,
    ]
    return CliRunner().invoke(app, arguments)


def test_further_formats_stand_beside_the_others(series: Path) -> None:
    result = run(series, "--also", "stl, XYZ,sdf,x3p")
    assert result.exit_code == 0, result.output
    out = series.parent / "out"
    assert {path.name for path in out.iterdir()} == {*FILES, *(name for name, _ in MORE.values())}
    ply, stl = trimesh.load(out / "mesh.ply", process=False), trimesh.load(out / "mesh.stl", process=False)
    np.testing.assert_array_equal(stl.triangles, ply.triangles)
    points = trimesh.load(out / "points.ply").vertices
    np.testing.assert_allclose(np.loadtxt(out / "points.xyz"), points, atol=1e-5)


def test_a_former_folder_with_further_formats_is_replaced_whole(series: Path) -> None:
    run(series, "--also", "stl,sdf")
    result = run(series)
    assert result.exit_code == 0, result.output
    assert {path.name for path in (series.parent / "out").iterdir()} == set(FILES)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [(["--also", "stl,obj"], "stl, xyz, sdf, x3p"), (["--mesh", "marching"], "triangles or poisson")],
)
def test_an_unknown_choice_gets_a_sentence_before_any_work(
    series: Path, options: list[str], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semrecon.input.intake.take_in", lambda *_: pytest.fail("work began"))
    result = run(series, *options)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (series.parent / "out").exists()


def test_an_unknown_format_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'obj'"):
        write_reconstruction(reconstruct(bump_series(), KnowsTheBump()), tmp_path / "out", also=["obj"])
    assert list(tmp_path.iterdir()) == []


# --- Poisson meshes ---------------------------------------------------------------------------------------------------


def cloud(xyz: np.ndarray) -> PointCloud:
    return PointCloud(xyz, np.tile(np.eye(3) * 0.01, (len(xyz), 1, 1)), np.zeros(len(xyz)), np.zeros((len(xyz), 2)))


def cap(points: int = 4000, noise_um: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points strewn over the cap of a sphere about the origin."""
    rng = np.random.default_rng(seed)
    radius, turn = CAP_UM * np.sqrt(rng.uniform(size=points)), rng.uniform(0, 2 * np.pi, points)
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    xyz = np.stack([x, y, np.sqrt(RADIUS_UM**2 - x**2 - y**2)], axis=1)
    return xyz * (1 + rng.normal(scale=noise_um / RADIUS_UM, size=(points, 1)))


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def test_a_poisson_mesh_of_a_cap_lies_on_the_sphere_and_ends_with_it() -> None:
    mesh = poisson_mesh(cloud(cap()))
    error = np.abs(np.linalg.norm(mesh.vertices_um, axis=1) - RADIUS_UM)
    assert np.median(error) < 0.01  # the cells are 0.3 um wide
    assert error.max() < 0.2  # at the rim, where it runs on a little
    assert np.hypot(*mesh.vertices_um[:, :2].T).max() < CAP_UM + 0.7
    area = np.linalg.norm(face_normals(mesh.vertices_um, mesh.faces), axis=1).sum() / 2
    height = RADIUS_UM - np.sqrt(RADIUS_UM**2 - CAP_UM**2)
    assert area == pytest.approx(2 * np.pi * RADIUS_UM * height, rel=0.15)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 180.0])
def test_it_faces_the_gun_of_its_view(tilt_deg: float) -> None:
    turn = tilt_rotation(tilt_deg)
    mesh = poisson_mesh(cloud(cap(1500) @ turn), CAM_FROM_VIEW @ turn)
    upward = face_normals(mesh.vertices_um @ turn.T, mesh.faces)[:, 2] > 0
    assert upward.mean() > 0.999


def test_it_runs_through_the_middle_of_noise() -> None:
    noisy = cap(6000, noise_um=0.05)
    mesh = poisson_mesh(cloud(noisy))
    inside = np.hypot(*mesh.vertices_um[:, :2].T) < CAP_UM - 1
    error = np.linalg.norm(mesh.vertices_um[inside], axis=1) - RADIUS_UM
    assert abs(np.median(error)) < 0.01
    assert 0.001 < error.std() < 0.025  # less than half the noise, and not none


def test_outliers_bend_nothing_and_grow_no_sheets() -> None:
    xyz = cap()
    spoilt = np.vstack([xyz, xyz[::100] + [0, 0, 5.0]])
    mesh = poisson_mesh(cloud(spoilt))
    assert np.abs(np.linalg.norm(mesh.vertices_um, axis=1) - RADIUS_UM).max() < 0.2  # as without them


def test_the_same_cloud_gives_the_same_bits() -> None:
    one, two = poisson_mesh(cloud(cap(1000))), poisson_mesh(cloud(cap(1000)))
    np.testing.assert_array_equal(one.vertices_um, two.vertices_um)
    np.testing.assert_array_equal(one.faces, two.faces)


def test_a_larger_cloud_is_thinned_the_same_way_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semrecon.surface.poisson.MOST_POINTS", 1000)
    full = cloud(cap(3000))
    one, two = poisson_mesh(full), poisson_mesh(full)
    np.testing.assert_array_equal(one.vertices_um, two.vertices_um)
    monkeypatch.undo()
    assert one.vertices_um.shape != poisson_mesh(full).vertices_um.shape
    inside = np.hypot(*one.vertices_um[:, :2].T) < CAP_UM - 1
    assert np.abs(np.linalg.norm(one.vertices_um[inside], axis=1) - RADIUS_UM).max() < 0.05


@pytest.mark.parametrize(
    ("xyz", "sentence"),
    [
        (cap(20), "30 points or more, not 20"),
        (np.full((40, 3), np.nan), "30 points or more, not 0"),
        (np.outer(np.arange(50.0), [1, 2, 0.5]), "one line"),
        (np.ones((50, 3)), "one line"),
    ],
)
def test_clouds_without_a_surface_get_a_sentence(xyz: np.ndarray, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        poisson_mesh(cloud(xyz))


def test_a_flat_cloud_is_a_flat_mesh_and_no_library_speaks(capfd: pytest.CaptureFixture[str]) -> None:
    x, y = np.meshgrid(np.arange(30.0), np.arange(20.0))
    mesh = poisson_mesh(cloud(np.stack([x.ravel(), y.ravel(), np.full(600, 2.0)], axis=1)))
    x, y, z = mesh.vertices_um.T
    np.testing.assert_allclose(z, 2.0, atol=0.1)
    np.testing.assert_allclose(z[(x > 2) & (x < 27) & (y > 2) & (y < 17)], 2.0, atol=0.01)
    assert "".join(capfd.readouterr()) == ""


def test_the_command_makes_one_and_the_report_says_so(series: Path) -> None:
    result = run(series, "--mesh", "poisson")
    assert result.exit_code == 0, result.output
    out = series.parent / "out"
    content = json.loads((out / "report.json").read_text())
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert content["meshing"] == "poisson"
    assert content["counts"]["mesh_faces"] == len(mesh.faces) > 100
    assert "mesh" in content["seconds"]
    x, y, z = mesh.vertices.T
    inside = (np.abs(x) < 6) & (np.abs(y) < 4)
    assert np.abs(z - bump_um(x, y))[inside].max() < 0.25  # points 0.8 um apart


def test_triangles_are_left_as_they_are() -> None:
    result = reconstruct(bump_series(), KnowsTheBump())
    assert with_mesh(result, "triangles") is result
