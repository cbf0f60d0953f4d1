"""Meshes and height maps: orientation, exactness on planes and at points, and holes that stay holes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semrecon.data import HeightMap, Optics, PointCloud
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, back_project, rotations_from_tilts, tilt_rotation
from semrecon.surface.meshing import (
    height_map_from_points,
    mesh_from_heights,
    mesh_from_points,
    statistical_outliers,
    without_outliers,
)
from semrecon.surface.triangles import TriangleLimits, fill_triangles, triangulate

OPTICS = Optics(0.5, 48, 40)


def strewn(points=600, seed=0, size=20.0):
    return np.random.default_rng(seed).uniform(-size, size, (points, 2))


def cloud(xyz, sigma=0.1):
    covariance = np.zeros((len(xyz), 3, 3))
    covariance[:, 2, 2] = np.broadcast_to(np.asarray(sigma) ** 2, len(xyz))
    return PointCloud(np.asarray(xyz, float), covariance, np.zeros(len(xyz)), np.full((len(xyz), 2), np.nan))


def normals(mesh):
    a, b, c = (mesh.vertices_um[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def grid_cloud(step=4):
    """Points at pixel centres of OPTICS, on a bumpy surface."""
    row, column = np.mgrid[0:40:step, 0:48:step]
    height = np.sin(row / 5) + np.cos(column / 7)
    xy_px = np.stack([column, row], axis=-1).reshape(-1, 2).astype(float)
    xyz = back_project(xy_px, -height.ravel(), CAM_FROM_VIEW, np.zeros(3), OPTICS)
    return row.ravel(), column.ravel(), height.ravel(), cloud(xyz)


# --- meshes of points -----------------------------------------------------------------------------------------------


def test_a_mesh_of_points_faces_the_gun():
    xy = strewn()
    mesh = mesh_from_points(np.column_stack([xy, np.sin(xy[:, 0]) + xy[:, 1] / 3]))
    assert (normals(mesh)[:, 2] > 0).all()
    assert len(mesh.faces) > 1000


@pytest.mark.parametrize("tilt", [-60.0, 60.0])
def test_a_mesh_of_a_tilted_view_faces_that_view(tilt):
    rotation = rotations_from_tilts(np.array([tilt]), 20.0)[0]
    in_view = np.column_stack([strewn(), np.zeros(600)])
    mesh = mesh_from_points(in_view @ tilt_rotation(tilt, 20.0), rotation)
    toward_gun = -rotation[2]
    assert (normals(mesh) @ toward_gun > 0).all()


def test_a_full_lattice_is_covered_once():
    row, column = np.mgrid[0:6, 0:8]
    faces = triangulate(np.column_stack([column.ravel(), row.ravel()]).astype(float))
    assert len(faces) == 2 * 5 * 7


@settings(max_examples=20, deadline=None)
@given(st.floats(0.01, 100), st.floats(-1000, 1000), st.integers(0, 1000))
def test_triangles_do_not_depend_on_unit_and_place(scale, shift, seed):
    xy = strewn(60, seed)
    expected = {frozenset(face) for face in triangulate(xy).tolist()}
    assert {frozenset(face) for face in triangulate(scale * xy + shift).tolist()} == expected


def test_a_hole_far_wider_than_the_spacing_stays_open_and_a_looser_limit_closes_it():
    xy = strewn(4000)
    xy = xy[np.linalg.norm(xy, axis=1) > 5]
    middle = np.linalg.norm(xy[triangulate(xy)].mean(axis=1), axis=1)
    assert middle.min() > 4
    loose = triangulate(xy, TriangleLimits(edge_factor=100))
    assert np.linalg.norm(xy[loose].mean(axis=1), axis=1).min() < 4


def test_points_strewn_at_random_keep_their_triangles():
    xy = strewn(20000)
    everything = triangulate(xy, TriangleLimits(edge_factor=1e9))
    kept = {frozenset(face) for face in triangulate(xy).tolist()}
    inner = everything[np.abs(xy[everything].mean(axis=1)).max(axis=1) < 19]
    lost = np.mean([frozenset(face) not in kept for face in inner.tolist()])
    assert lost < 2e-4


def test_points_of_a_mesh_are_points_of_the_cloud_and_all_are_used():
    xyz = np.column_stack([strewn(), np.zeros(600)])
    xyz[5] = np.nan
    mesh = mesh_from_points(cloud(xyz))
    assert np.isfinite(mesh.vertices_um).all()
    assert set(map(tuple, mesh.vertices_um)) <= set(map(tuple, xyz))
    np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices_um)))


@pytest.mark.parametrize(
    ("xyz", "sentence"),
    [
        (np.zeros((2, 3)), "at least three points"),
        (np.array([[0.0, 0, 0], [1, 1, 5], [2, 2, 0], [3, 3, 1]]), "one line"),
        (np.full((5, 3), np.nan), "at least three points"),
    ],
)
def test_points_without_a_surface_get_a_sentence(xyz, sentence):
    with pytest.raises(InputError, match=sentence):
        mesh_from_points(xyz)
    with pytest.raises(InputError, match=sentence):
        height_map_from_points(cloud(xyz), OPTICS)


def test_limits_must_be_positive():
    with pytest.raises(InputError, match="edge_factor"):
        TriangleLimits(edge_factor=0)


# --- meshes of height maps ------------------------------------------------------------------------------------------


def heights(z):
    return HeightMap(np.asarray(z, float), np.full(np.shape(z), np.nan), 0.5)


def test_pixels_go_where_the_conventions_put_them():
    mesh = mesh_from_heights(heights([[1, 2, 3], [4, 5, 6]]))
    expected = [[-0.5, 0.25, 1], [0, 0.25, 2], [0.5, 0.25, 3], [-0.5, -0.25, 4], [0, -0.25, 5], [0.5, -0.25, 6]]
    np.testing.assert_allclose(mesh.vertices_um, expected, atol=1e-15)
    assert len(mesh.faces) == 4
    assert (normals(mesh)[:, 2] > 0).all()


@pytest.mark.parametrize("missing", range(4))
def test_a_cell_with_one_missing_corner_keeps_the_other_triangle(missing):
    z = np.zeros(4)
    z[missing] = np.nan
    mesh = mesh_from_heights(heights(z.reshape(2, 2)))
    assert mesh.faces.shape == (1, 3)
    assert normals(mesh)[0, 2] == pytest.approx(0.25)
    assert len(mesh.vertices_um) == 3


def test_holes_leave_no_vertex_and_no_face():
    z = np.random.default_rng(0).normal(size=(12, 14))
    z[4:8, 5:9] = np.nan
    mesh = mesh_from_heights(heights(z))
    assert len(mesh.vertices_um) == 12 * 14 - 16
    assert np.isfinite(mesh.vertices_um).all()
    area = normals(mesh)[:, 2].sum() / 2 / 0.25
    assert area == pytest.approx(11 * 13 - 25 + 4 * 0.5)  # the hole's corner cells keep half


def test_a_tilted_reference_view_lands_in_the_world_frame():
    rotation = rotations_from_tilts(np.array([30.0]), 10.0)[0]
    translation = np.array([0.3, -0.2, 0.1])
    mesh = mesh_from_heights(heights(np.random.default_rng(0).normal(size=(5, 6))), rotation, translation)
    camera = mesh.vertices_um @ rotation.T + translation
    columns, rows = np.meshgrid(np.arange(6) - 2.5, np.arange(5) - 2.0)
    np.testing.assert_allclose(camera[:, :2], 0.5 * np.column_stack([columns.ravel(), rows.ravel()]), atol=1e-12)
    assert (normals(mesh) @ -rotation[2] > 0).all()


def test_perspective_widens_what_is_farther_from_the_gun():
    k = 1e-3
    mesh = mesh_from_heights(heights(np.full((3, 3), -20.0)), inverse_working_distance=k)
    assert mesh.vertices_um[:, 0].max() == pytest.approx(0.5 * (1 + k * 20))


def test_a_step_takes_every_other_pixel_at_its_own_place():
    z = np.arange(35, dtype=float).reshape(5, 7)
    coarse, fine = mesh_from_heights(heights(z), step=2), mesh_from_heights(heights(z))
    assert len(coarse.faces) == 2 * 2 * 3
    assert set(map(tuple, coarse.vertices_um)) <= set(map(tuple, fine.vertices_um))
    with pytest.raises(InputError, match="step"):
        mesh_from_heights(heights(z), step=0)


# --- height maps of points ------------------------------------------------------------------------------------------


def test_a_height_map_is_exact_at_its_points():
    row, column, height, points = grid_cloud()
    found = height_map_from_points(points, OPTICS)
    np.testing.assert_allclose(found.z_um[row, column], height, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.sigma_um[row, column], 0.1, rtol=0, atol=1e-12)
    assert np.isnan(found.z_um[37:, :]).all()  # rows 37 to 39 lie outside of all triangles
    assert found.z_um.shape == OPTICS.shape
    assert found.pixel_size_um == OPTICS.pixel_size_um


def test_filling_is_bit_exact_at_corners_and_leaves_no_pixel_between_triangles():
    row, column, height, _ = grid_cloud()
    xy = np.column_stack([column, row]).astype(float)
    filled = fill_triangles(xy, triangulate(xy), height[:, None], OPTICS.shape)[0]
    np.testing.assert_array_equal(filled[row, column], height)
    assert np.isfinite(filled[:37, :45]).all()


@settings(max_examples=25, deadline=None)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-50, 50), st.integers(0, 99))
def test_a_plane_comes_back_exactly(p, q, offset, seed):
    xy = strewn(300, seed, 13.0)
    points = cloud(np.column_stack([xy, p * xy[:, 0] + q * xy[:, 1] + offset]))
    found = height_map_from_points(points, OPTICS)
    x, y = (np.arange(48) - 23.5) * 0.5, (19.5 - np.arange(40)) * 0.5
    expected = p * x[None, :] + q * y[:, None] + offset
    covered = np.isfinite(found.z_um)
    assert covered.mean() > 0.8
    np.testing.assert_allclose(found.z_um[covered], expected[covered], atol=1e-10)


def test_a_height_map_agrees_with_scipys_interpolator_inside():
    from scipy.interpolate import LinearNDInterpolator

    rng = np.random.default_rng(1)
    xyz = np.column_stack([strewn(400, 1, 13.0), rng.normal(size=400)])
    found = height_map_from_points(cloud(xyz), OPTICS, limits=TriangleLimits(edge_factor=1e9, flatness=0))
    x, y = np.meshgrid((np.arange(48) - 23.5) * 0.5, (19.5 - np.arange(40)) * 0.5)
    expected = LinearNDInterpolator(xyz[:, :2], xyz[:, 2])(x, y)
    assert np.isfinite(expected).mean() > 0.9
    np.testing.assert_array_equal(np.isfinite(found.z_um), np.isfinite(expected))
    np.testing.assert_allclose(found.z_um, expected, atol=1e-9)


def test_a_hole_in_the_points_is_a_hole_in_the_map():
    xy = strewn(6000, 0, 13.0)
    xy = xy[np.linalg.norm(xy, axis=1) > 4]
    found = height_map_from_points(cloud(np.column_stack([xy, np.zeros(len(xy))])), OPTICS)
    x, y = np.meshgrid((np.arange(48) - 23.5) * 0.5, (19.5 - np.arange(40)) * 0.5)
    radius = np.hypot(x, y)
    assert np.isnan(found.z_um[radius < 3.3]).all()
    assert np.isfinite(found.z_um[(radius > 4.8) & (np.abs(y) < 9)]).mean() > 0.99


def test_a_tilted_reference_view_sees_heights_along_its_beam():
    """Points on the plane z_view = 2 of a view tilted by 25 degrees: the map is 2 wherever it is filled."""
    rotation = rotations_from_tilts(np.array([25.0]))[0]
    in_view = np.column_stack([strewn(500, 0, 13.0), np.full(500, 2.0)])
    points = cloud(in_view @ tilt_rotation(25.0))
    found = height_map_from_points(points, OPTICS, rotation)
    assert np.isfinite(found.z_um).mean() > 0.8
    np.testing.assert_allclose(found.z_um[np.isfinite(found.z_um)], 2.0, atol=1e-12)
    along_beam = 0.1 * np.cos(np.deg2rad(25))
    np.testing.assert_allclose(found.sigma_um[np.isfinite(found.z_um)], along_beam, rtol=1e-9)


def test_unknown_sigmas_leave_heights_known():
    xyz = np.column_stack([strewn(500, 0, 13.0), np.zeros(500)])
    found = height_map_from_points(cloud(xyz, np.nan), OPTICS)
    assert np.isfinite(found.z_um).mean() > 0.8
    assert np.isnan(found.sigma_um).all()


def test_mesh_and_map_of_one_another_keep_the_heights():
    z = np.random.default_rng(0).normal(size=(40, 48))
    mesh = mesh_from_heights(heights(z))
    again = height_map_from_points(cloud(mesh.vertices_um), OPTICS)
    np.testing.assert_allclose(again.z_um, z, atol=1e-9)


# --- outliers -------------------------------------------------------------------------------------------------------


def test_mismatched_heights_are_found_and_slopes_and_noise_are_not():
    rng = np.random.default_rng(0)
    xy = strewn(3000)
    z = 0.8 * xy[:, 0] + 2 * np.sin(xy[:, 1] / 3) + rng.normal(0, 0.1, 3000)
    wrong = rng.random(3000) < 0.05
    z[wrong] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(5, 20, wrong.sum())
    marked = statistical_outliers(np.column_stack([xy, z]))
    assert marked[wrong].mean() > 0.95
    assert marked[~wrong].mean() < 0.02


def test_outliers_do_not_depend_on_the_order_of_points_nor_on_points_at_one_place():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([strewn(200), rng.normal(size=200) ** 3])
    order = rng.permutation(200)
    marked = statistical_outliers(xyz)
    assert marked.any()
    np.testing.assert_array_equal(statistical_outliers(xyz[order]), marked[order])
    stacked = np.zeros((40, 3))
    stacked[0, 2] = 1.0
    assert statistical_outliers(stacked).tolist() == [True] + [False] * 39


def test_outliers_are_left_out_as_the_view_sees_them():
    """A point off a plane that leans by 40 degrees goes, and the plane stays: its own view sees it flat."""
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(-10, 10, (400, 2)), rng.uniform(-0.01, 0.01, 400)])
    flat[7, 2] += 3.0
    rotation = CAM_FROM_VIEW @ tilt_rotation(40.0)
    world = flat @ (CAM_FROM_VIEW @ rotation)
    kept = without_outliers(PointCloud(world, np.zeros((400, 3, 3)), np.zeros(400), flat[:, :2]), rotation)
    assert 0.95 * 400 < len(kept) < 400
    assert not (kept.xyz_um == world[7]).all(axis=1).any()
    np.testing.assert_array_equal(kept.xyz_um, world[~statistical_outliers(flat)])


def test_few_points_have_no_outliers():
    assert not statistical_outliers(np.eye(3)).any()
