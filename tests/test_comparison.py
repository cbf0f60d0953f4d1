"""Claims on the comparison of two surfaces: zero for equals, what was planted comes back, holes buy nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from known_surface import KnowsTheBump, bump_series
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from semrecon.agreement.comparison import FILES, Comparison, compare, comparison_report, write_comparison
from semrecon.agreement.resampling import draw_grid
from semrecon.agreement.saved import SavedSurface, read_surface, surface_of
from semrecon.agreement.surface_alignment import Alignment
from semrecon.data import Array, HeightMap, Optics
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, project, rotations_from_tilts
from semrecon.output.export import write_reconstruction
from semrecon.output.ply import write_ply
from semrecon.pipeline import reconstruct

PIXEL_UM, ROWS, COLUMNS = 0.1, 120, 160
OPTICS = Optics(PIXEL_UM, COLUMNS, ROWS)


def relief_um(x_um: Array, y_um: Array) -> Array:
    """A smooth surface without symmetry, of about 3 um."""
    hill = 2.0 * np.exp(-((x_um - 1) ** 2 + (y_um + 0.5) ** 2) / 8)
    return hill + 0.6 * np.sin(1.1 * x_um + 0.3) * np.cos(0.9 * y_um) + 0.3 * np.sin(0.7 * x_um * 0.5 + 1.9 * y_um)


def grid_um() -> tuple[Array, Array]:
    rows, columns = np.mgrid[0:ROWS, 0:COLUMNS].astype(float)
    return (columns - (COLUMNS - 1) / 2) * PIXEL_UM, -(rows - (ROWS - 1) / 2) * PIXEL_UM


def surface(z_um: Array, name: str = "a", view: str = "ref", sigma: float = 0.1) -> SavedSurface:
    heights = HeightMap(z_um, np.full_like(z_um, sigma), PIXEL_UM)
    return SavedSurface(name, heights, OPTICS, CAM_FROM_VIEW, np.zeros(3), view=view)


def seen_by(rotation: Array, shift_um: Array, name: str, view: str) -> SavedSurface:
    """Height map of the relief, moved by a shift, as a view of that rotation sees it: fixed point along each beam."""
    x, y = grid_um()
    camera_xy = np.stack([x, -y], axis=-1)
    depth = np.zeros_like(x)
    for _ in range(200):
        world = np.concatenate([camera_xy, depth[..., None]], axis=-1) @ rotation + shift_um
        depth = depth + 0.8 * (world[..., 2] - relief_um(world[..., 0], world[..., 1]))  # z of the world is up
    heights = HeightMap(-depth, np.full_like(depth, 0.1), PIXEL_UM)
    return SavedSurface(name, heights, OPTICS, rotation, np.zeros(3), view=view)


def moved(motion: Alignment, name: str = "b", view: str = "ref") -> SavedSurface:
    """The relief as a mesh, after a motion."""
    x, y = np.meshgrid(np.linspace(-9, 9, 241), np.linspace(-7, 7, 187))
    xyz = motion.apply(np.stack([x, y, relief_um(x, y)], axis=-1))
    xy_px = project(xyz, CAM_FROM_VIEW, np.zeros(3), OPTICS)
    z_um = draw_grid(xy_px, xyz[..., 2:], OPTICS.shape)[0]
    return surface(z_um, name, view)


@pytest.fixture(scope="module")
def plain() -> SavedSurface:
    return surface(relief_um(*grid_um()))


@pytest.mark.parametrize("gauge", ["offset", "plane", "rigid", "similarity"])
def test_equal_surfaces_do_not_differ(plain: SavedSurface, gauge: str) -> None:
    found = compare(plain, plain, gauge=gauge)
    largest = float(np.nanmax(np.abs(found.difference_um)))
    assert largest == 0 if gauge == "offset" else largest < 1e-9
    assert found.within(1) == 1
    if gauge == "offset":
        assert (found.share_of_first, found.share_of_second) == (1, 1)


def test_a_planted_offset_and_tilt_come_back(plain: SavedSurface) -> None:
    x, y = grid_um()
    lifted = surface(plain.heights.z_um + 0.7 if plain.heights else x, "b")
    found = compare(plain, lifted)
    assert found.alignment.offset_um == pytest.approx(-0.7, abs=1e-12)
    assert found.rms_um < 1e-12
    assert plain.heights is not None
    tipped = surface(plain.heights.z_um + 0.7 + 0.03 * x - 0.02 * y, "b")
    found = compare(plain, tipped, gauge="plane")
    np.testing.assert_allclose(found.alignment.slope, [-0.03, 0.02], atol=1e-6)
    assert found.alignment.tilt_deg == pytest.approx(np.rad2deg(np.arctan(np.hypot(0.03, 0.02))), rel=1e-4)
    assert found.rms_um < 1e-6
    assert compare(plain, tipped).rms_um > 0.1  # an offset does not hide a tilt


@pytest.mark.parametrize("gauge", ["rigid", "similarity"])
def test_a_planted_motion_comes_back(plain: SavedSurface, gauge: str) -> None:
    turn = Rotation.from_euler("xyz", [1.0, -1.5, 2.0], degrees=True).as_matrix()
    scale = 1.02 if gauge == "similarity" else 1.0
    planted = Alignment(gauge, (), rotation=turn, shift_um=np.array([0.3, -0.2, 0.5]), scale=scale)
    found = compare(plain, moved(planted), gauge=gauge)
    back = found.alignment
    np.testing.assert_allclose(back.rotation @ turn, np.eye(3), atol=np.deg2rad(0.02))
    assert back.scale == pytest.approx(1 / scale, abs=3e-4)
    corners = np.array([[5.0, 4, 0], [-5, 4, 1], [0, -4, 0.5], [0, 0, 2]])
    np.testing.assert_allclose(back.apply(planted.apply(corners)), corners, atol=5e-3)
    assert found.quantile_um(0.95) < 5e-3  # linear between nodes of 0.08 um
    assert compare(plain, moved(planted)).quantile_um(0.5) > 0.05


def test_holes_and_a_wrong_part_do_not_bias_the_alignment(plain: SavedSurface) -> None:
    turn = Rotation.from_euler("xy", [0.5, -0.8], degrees=True).as_matrix()
    planted = Alignment("rigid", (), rotation=turn, shift_um=np.array([0.1, 0.1, 0.5]))
    other = moved(planted)
    assert other.heights is not None
    z_um = other.heights.z_um.copy()
    z_um[:50, :90] = np.nan  # a quarter of the picture, on one side
    z_um[80:110, 100:150] += 2.0  # a tenth is wrong
    found = compare(plain, surface(z_um, "b"), gauge="rigid")
    np.testing.assert_allclose(found.alignment.rotation @ turn, np.eye(3), atol=np.deg2rad(0.05))
    assert found.quantile_um(0.5) < 5e-3


def test_different_reference_views_agree_to_interpolation() -> None:
    tilts = rotations_from_tilts(np.array([0.0, 6.0]))
    a = seen_by(tilts[0], np.zeros(3), "a", "one.tif")
    b = seen_by(tilts[1], np.array([0.4, -0.3, 0.2]), "b", "two.tif")
    found = compare(a, b)
    assert found.quantile_um(0.95) < 2e-3
    assert found.share_of_first > 0.85
    np.testing.assert_allclose(found.alignment.shift_um, [0.4, -0.3, 0.2], atol=2e-3)
    assert "one.tif and two.tif are different reference views" in found.alignment.reason


def test_missing_heights_never_improve_the_score(plain: SavedSurface) -> None:
    rng = np.random.default_rng(3)
    assert plain.heights is not None
    z_um = plain.heights.z_um + gaussian_filter(rng.normal(0, 1, (ROWS, COLUMNS)), 2)
    full = compare(plain, surface(z_um, "b"))
    worst = np.abs(full.difference_um) > full.quantile_um(0.7)
    fewer = compare(plain, surface(np.where(worst, np.nan, z_um), "b"))
    assert fewer.quantile_um(0.5) < full.quantile_um(0.5)  # what is compared alone would look better
    assert fewer.penalised_median_um > 0.99 * full.penalised_median_um  # the offset follows what is left
    assert fewer.share_of_first == pytest.approx(0.7, abs=0.001)
    assert fewer.share_of_second == 1


def test_sigmas_that_are_right_are_found_right(plain: SavedSurface) -> None:
    rng = np.random.default_rng(4)
    assert plain.heights is not None
    both = (surface(plain.heights.z_um + rng.normal(0, s, (ROWS, COLUMNS)), str(s), sigma=s) for s in (0.3, 0.4))
    found = compare(*both)
    assert found.within(1) == pytest.approx(0.683, abs=0.013)  # one sigma of 19200 pixels is 0.0034
    assert found.within(2) == pytest.approx(0.954, abs=0.006)
    assert found.rms_um == pytest.approx(0.5, rel=0.02)
    assert found.quantile_um(0.5) == pytest.approx(0.6745 * 0.5, rel=0.03)


def test_swapping_turns_the_sign(plain: SavedSurface) -> None:
    rng = np.random.default_rng(5)
    assert plain.heights is not None
    other = surface(plain.heights.z_um + rng.normal(0.3, 0.2, (ROWS, COLUMNS)), "b")
    forth, back = compare(plain, other), compare(other, plain)
    np.testing.assert_allclose(forth.difference_um, -back.difference_um, atol=1e-12)


def written(folder: Path) -> Path:
    write_reconstruction(reconstruct(bump_series(), KnowsTheBump(heights=True)), folder)
    return folder


def test_folders_and_files_of_others_are_read(tmp_path: Path) -> None:
    result = reconstruct(bump_series(), KnowsTheBump(heights=True))
    folder = written(tmp_path / "a")
    found = compare(folder, surface_of(result, "memory"))
    assert found.quantile_um(1.0) < 1e-6  # float32 on disk
    assert str(found).startswith("memory against a: median |difference|")
    by_map = compare(folder / "height.tif", folder / "height.tif")
    assert np.nanmax(np.abs(by_map.difference_um)) == 0
    xyz = read_surface(folder / "points.ply").vertices_um
    assert xyz is not None
    np.savetxt(tmp_path / "c.xyz", xyz)
    by_text, by_mesh = compare(folder, tmp_path / "c.xyz"), compare(folder, folder / "mesh.ply")
    assert by_text.quantile_um(0.5) < 0.05  # points eight pixels apart
    assert by_mesh.quantile_um(0.9) < 0.05  # joins the same points


def test_the_folder_of_a_comparison_is_whole(tmp_path: Path, plain: SavedSurface) -> None:
    found: Comparison = compare(plain, moved(Alignment("offset", (), shift_um=np.array([0, 0, 0.5]))), gauge="rigid")
    files = write_comparison(found, tmp_path / "out")
    assert {path.name for path in files} == set(FILES) == {path.name for path in (tmp_path / "out").iterdir()}
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content == comparison_report(found)
    difference = tifffile.imread(tmp_path / "out" / "difference.tif")
    np.testing.assert_allclose(difference, found.difference_um, atol=1e-6)
    write_comparison(found, tmp_path / "out")  # a former one is replaced
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        write_comparison(found, tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").exists()


def test_what_cannot_be_compared_says_why(tmp_path: Path, plain: SavedSurface) -> None:
    (tmp_path / "empty").mkdir()
    for path, sentence in [
        (tmp_path / "none", "does not exist"),
        (tmp_path / "empty", "is no reconstruction"),
        (Path(__file__), "no surface that is read here"),
    ]:
        with pytest.raises(InputError, match=sentence):
            compare(plain, path)
    with pytest.raises(InputError, match="--gauge knows offset, plane, rigid, similarity, not 'all'"):
        compare(plain, plain, gauge="all")
    assert plain.heights is not None
    left, right = plain.heights.z_um.copy(), plain.heights.z_um.copy()
    left[:, 60:], right[:, :100] = np.nan, np.nan
    with pytest.raises(InputError, match="do not overlap"):
        compare(surface(left), surface(right, "b"))
    with pytest.raises(InputError, match="no height at all"):
        compare(plain, surface(np.full((ROWS, COLUMNS), np.nan), "b"))
    cloud = replace(plain, heights=None, optics=None, vertices_um=np.zeros((3, 3)), sigma_um=np.zeros(3))
    with pytest.raises(InputError, match="no pixel grid"):
        compare(cloud, plain)


def test_damaged_files_are_sentences(tmp_path: Path) -> None:
    folder = written(tmp_path / "a")
    tifffile.imwrite(tmp_path / "bare.tif", np.zeros((9, 9), np.float32))
    (tmp_path / "bad.xyz").write_text("x y z\n1 2\n")
    write_ply(tmp_path / "two.ply", {name: np.zeros(2) for name in "xyz"})
    for path, sentence in [("bare.tif", "no pixel size"), ("bad.xyz", "three numbers"), ("two.ply", "three points")]:
        with pytest.raises(InputError, match=sentence):
            read_surface(tmp_path / path)
    (folder / "height.tif").write_bytes((folder / "height.tif").read_bytes()[:50])
    with pytest.raises(InputError, match=r"height\.tif"):
        read_surface(folder)
    content = json.loads((folder / "report.json").read_text())
    del content["series"]["reference"]
    (folder / "report.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="incomplete"):
        read_surface(folder)
