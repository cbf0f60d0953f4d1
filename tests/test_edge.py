"""The glow of edges against its closed forms: none on planes, a strip beside walls, curvature on what is smooth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.edge import STRIP, edge_glow, edge_response
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses
from semsim.surface import SurfaceBuffer, surface_buffer

LEVEL = poses(TiltSchedule((0.0,)))[0]


def of_heights(z: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, pixel_um: float) -> SurfaceBuffer:
    """The surface that an untilted view would meet, from heights and slopes (to the right, up) by formula."""
    normal = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    rows, columns = np.indices(z.shape)
    position = np.stack([columns * pixel_um, -rows * pixel_um, z], axis=-1)
    missing = np.isnan(z)
    normal[missing] = np.nan
    return SurfaceBuffer(-z, position, normal, np.where(missing, -1, 0).astype(np.int32))


def terrace(columns: int, edge: int, drop_um: float, rows: int = 61) -> SurfaceBuffer:
    """Level ground that ends after `edge` columns at an upright wall."""
    z = np.where(np.arange(columns) < edge, 0.0, -drop_um) * np.ones((rows, 1))
    return of_heights(z, np.zeros_like(z), np.zeros_like(z), 0.1)


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-25, 25), st.sampled_from([0.1, 0.5, 3.0]))
def test_no_plane_glows(slope_x, slope_y, tilt_deg, escape_depth_um):
    x, y = np.meshgrid([-100.0, 100.0], [-100.0, 100.0])
    vertices = np.stack([x.ravel(), y.ravel(), (slope_x * x + slope_y * y).ravel()], axis=1)
    mesh = Mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]], dtype=np.int32))
    pose = poses(TiltSchedule((tilt_deg,), 20.0))[0]
    buffer = surface_buffer(mesh, Microscope(0.25, 48, 36), pose)
    assert np.nanmax(edge_glow(buffer, pose, 0.25, escape_depth_um)) < 1e-9


def test_beside_a_high_wall_the_missing_share_is_that_of_a_ball_cut_off():
    escape_um, edge = 3.0, 60
    glow = edge_glow(terrace(120, edge, 50.0), LEVEL, 0.1, escape_um)[30]
    s = np.minimum((edge - 0.5 - np.arange(edge)) * 0.1 / escape_um, 1.0)
    assert np.allclose(glow[:edge], (1 - s) ** 2 * (2 + s) / 4, atol=0.07)
    assert (glow[edge:] == 0).all()  # the foot of the wall has all its material, and more


@pytest.mark.parametrize("escape_depth_um", [0.005, 0.05, 0.2, 0.33, 0.6, 2.0])
@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_the_strip_beside_an_edge_holds_the_same_light_at_any_ratio_of_escape_depth_to_pixel(escape_depth_um, turn):
    buffer = terrace(101, 51, 50.0, rows=101)
    turned = of_heights(np.rot90(-buffer.depth_um, turn), np.zeros((101, 101)), np.zeros((101, 101)), 0.1)
    middle = np.rot90(edge_glow(turned, LEVEL, 0.1, escape_depth_um), -turn)[50]
    assert middle.sum() * 0.1 == pytest.approx(STRIP * escape_depth_um, rel=0.02)


@pytest.mark.parametrize("escape_depth_um", [0.02, 0.25, 0.5, 1.5])
def test_a_smooth_ridge_glows_by_its_mean_curvature(escape_depth_um):
    x = (np.arange(81) - 40) * 0.1 * np.ones((81, 1))
    radius = 15.0
    z = np.sqrt(radius**2 - x**2) - radius
    glow = edge_glow(of_heights(z, -x / (z + radius), np.zeros_like(z), 0.1), LEVEL, 0.1, escape_depth_um)
    assert glow[40, 40] == pytest.approx(3 / 8 * escape_depth_um / (2 * radius), rel=0.1)
    valley = edge_glow(of_heights(-z, x / (z + radius), np.zeros_like(z), 0.1), LEVEL, 0.1, escape_depth_um)
    assert valley[40, 40] == 0.0


def test_a_wall_thinner_than_the_escape_depth_glows_from_both_sides():
    z = np.where(np.abs(np.arange(81) - 40) <= 2, 0.0, -50.0) * np.ones((81, 1))
    thin = edge_glow(of_heights(z, np.zeros_like(z), np.zeros_like(z), 0.1), LEVEL, 0.1, 1.0)
    one_sided = edge_glow(terrace(81, 43, 50.0, rows=81), LEVEL, 0.1, 1.0)
    assert thin[40, 40] == pytest.approx(2 * one_sided[40, 40], rel=0.02)
    assert thin[40, 40] > 0.6


def test_the_facets_of_a_smooth_mesh_do_not_show():
    """Triangles four pixels wide on a cylinder: with normals spread over them the ridge is as even as the cylinder."""
    x = (np.arange(81) - 40) * 0.1
    knots = np.arange(-5.0, 5.01, 0.4)
    height = lambda at: np.sqrt(10.0**2 - at**2) - 10.0  # noqa: E731
    z = np.interp(x, knots, height(knots)) * np.ones((41, 1))
    slope = np.interp(x, knots, -knots / (height(knots) + 10.0)) * np.ones((41, 1))
    glow = edge_glow(of_heights(z, slope, np.zeros_like(z), 0.1), LEVEL, 0.1, 0.4)[20, 10:-10]
    assert np.ptp(glow) < 0.2 * glow.mean()


@pytest.mark.parametrize("escape_depth_um", [0.3, 1.1])
@pytest.mark.parametrize("turn", [1, 2, 3])
def test_turning_the_specimen_turns_the_glow(escape_depth_um, turn):
    z = np.where(np.random.default_rng(3).uniform(size=(40, 40)) < 0.2, -5.0, 0.0)
    flat = np.zeros_like(z)
    glow = edge_glow(of_heights(z, flat, flat, 0.1), LEVEL, 0.1, escape_depth_um)
    turned = edge_glow(of_heights(np.rot90(z, turn), flat, flat, 0.1), LEVEL, 0.1, escape_depth_um)
    assert np.ptp(glow) > 0.1
    assert np.allclose(np.rot90(turned, -turn), glow, atol=1e-12)


def test_what_is_missed_is_empty_and_what_is_beyond_the_picture_is_full():
    buffer = terrace(40, 20, np.nan)
    glow = edge_glow(buffer, LEVEL, 0.1, 0.5)
    assert np.isnan(glow[:, 20:]).all()
    assert glow[30, 19] == edge_glow(terrace(40, 20, 50.0), LEVEL, 0.1, 0.5)[30, 19] > 0.3
    assert (glow[:, :10] == 0).all()


def test_without_depth_or_strength_nothing_glows():
    assert (edge_glow(terrace(40, 20, 5.0), LEVEL, 0.1, 0.0) == 0).all()
    assert (edge_response(np.array([0.0, 0.3, 1.0]), 0.0) == 1).all()
    assert edge_response(np.array([0.5]), 2.0)[0] == 2.0
