"""Each contrast mechanism against its formula, and each off switch against the identity."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semsim.backscatter import BackscatterOptions
from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses
from semsim.shadowing import sky_visibility
from semsim.signal import (
    SignalOptions,
    as_seen,
    cos_incidence,
    electron_rates,
    secant_yield,
    secondary_rate,
    shadow_response,
    side_detector_response,
)
from semsim.surface import surface_buffer

MICROSCOPE = Microscope(0.25, 48, 36)
OFF = SignalOptions(yield_exponent=0.0, edge_strength=0.0, asymmetry=0.0, shadowing=0.0)


def plane(slope_x: float = 0.0, slope_y: float = 0.0, width: float = 100.0, vertex_yield=None) -> Mesh:
    x, y = np.meshgrid([-width, width], [-width, width])
    vertices = np.stack([x.ravel(), y.ravel(), (slope_x * x + slope_y * y).ravel()], axis=1)
    return Mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]], dtype=np.int32), vertex_yield)


def groove(half_width: float, depth: float) -> Mesh:
    """A V along y in a level plane, its bottom at x = 0; four strips that share no vertex, so that edges are sharp."""
    x, z = [-100.0, -half_width, 0.0, half_width, 100.0], [0.0, 0.0, -depth, 0.0, 0.0]
    vertices = [(x[k], y, z[k]) for i in range(4) for y in (-100.0, 100.0) for k in (i, i + 1)]
    faces = [f for i in range(0, 16, 4) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    return Mesh(np.array(vertices), np.array(faces, dtype=np.int32))


def trench(half_width: float, depth: float) -> Mesh:
    """A trench along y with upright walls in a level plane; five strips that share no vertex."""
    x, z = [-100, -half_width, -half_width, half_width, half_width, 100], [0, 0, -depth, -depth, 0, 0]
    vertices = [(x[k], y, z[k]) for i in range(5) for y in (-100.0, 100.0) for k in (i, i + 1)]
    faces = [f for i in range(0, 20, 4) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    return Mesh(np.array(vertices, dtype=float), np.array(faces, dtype=np.int32))


def view(mesh: Mesh, tilt_deg: float = 0.0, axis_deg: float = 0.0, microscope: Microscope = MICROSCOPE):
    pose = poses(TiltSchedule((tilt_deg,), axis_deg))[0]
    return surface_buffer(mesh, microscope, pose), pose


@given(st.floats(0, 80), st.floats(0.5, 1.5))
def test_the_yield_is_the_secant_to_a_power_up_to_its_bound(phi_deg, exponent):
    bound = 3.0
    expected = min(np.cos(np.radians(phi_deg)) ** -exponent, bound)
    assert secant_yield(np.cos(np.radians([phi_deg])), exponent, bound)[0] == pytest.approx(expected, rel=1e-12)


def test_the_yield_at_glancing_incidence_is_the_bound():
    assert secant_yield(np.zeros(1), 0.8, 3.0)[0] == pytest.approx(3.0, rel=1e-12)


def test_the_side_detector_sees_what_faces_it_brighter():
    right, up, beam = np.eye(3)
    assert side_detector_response(right, 0.0, 0.3) == pytest.approx(1.3)
    assert side_detector_response(-right, 0.0, 0.3) == pytest.approx(0.7)
    assert side_detector_response(up, np.pi / 2, 0.3) == pytest.approx(1.3)
    assert side_detector_response(beam, 1.0, 0.3) == pytest.approx(1.0)


@given(st.floats(-7, 7), st.floats(-3, 3))
def test_turning_normal_and_detector_together_changes_nothing(turn, azimuth):
    normal = np.array([0.6, 0.48, 0.64])
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ normal
    before, after = side_detector_response(normal, azimuth, 0.4), side_detector_response(turned, azimuth + turn, 0.4)
    assert after == pytest.approx(before, abs=1e-12)


@given(st.floats(-40, 40), st.floats(-40, 40))
def test_a_tilted_plane_shows_the_stage_tilt_and_its_own_slope(tilt_deg, slope_deg):
    mesh = plane(slope_x=np.tan(np.radians(slope_deg)))
    buffer, pose = view(mesh, tilt_deg)
    # A slope that rises to the right turns its normal to the left, by the angle that tilting turns it back.
    assert np.allclose(cos_incidence(buffer, pose, MICROSCOPE), np.cos(np.radians(slope_deg - tilt_deg)), atol=1e-9)


def test_under_perspective_the_beam_slants_away_from_the_axis():
    microscope = Microscope(0.25, 49, 37, working_distance_um=20.0)
    buffer, pose = view(plane(), microscope=microscope)
    cosine = cos_incidence(buffer, pose, microscope)
    assert cosine[18, 24] == pytest.approx(1.0, abs=1e-12)
    assert cosine[18, 48] == pytest.approx(20 / np.hypot(20, 6), abs=1e-12)


def test_with_everything_off_the_rate_is_one_everywhere():
    mesh = groove(4.0, 3.0)
    buffer, pose = view(mesh, 20.0, 35.0)
    assert np.array_equal(secondary_rate(buffer, pose, OFF, mesh, MICROSCOPE), np.ones(MICROSCOPE.shape))


@pytest.mark.parametrize("switch", ["yield_exponent", "edge_strength", "asymmetry", "shadowing"])
def test_each_effect_alone_changes_the_picture_and_its_off_switch_does_not(switch):
    mesh = groove(4.0, 3.0)
    buffer, pose = view(mesh)
    on = replace(OFF, **{switch: getattr(SignalOptions(), switch)}, detector_azimuth_deg=0.0)
    assert np.ptp(secondary_rate(buffer, pose, on, mesh, MICROSCOPE)) > 0.05


def test_the_rate_is_the_product_of_the_effects():
    mesh = groove(4.0, 3.0)
    buffer, pose = view(mesh, 10.0)
    strengths = {"yield_exponent": 1.0, "edge_strength": 1.3, "asymmetry": 0.3, "shadowing": 0.8}
    one = [replace(OFF, **{name: strength}) for name, strength in strengths.items()]
    every = replace(OFF, **strengths)
    product = np.prod([secondary_rate(buffer, pose, options, mesh, MICROSCOPE) for options in one], axis=0)
    assert np.allclose(secondary_rate(buffer, pose, every, mesh, MICROSCOPE), product, rtol=1e-12)


def test_the_yield_of_the_material_is_interpolated_between_vertices():
    mesh = plane(width=10.0, vertex_yield=np.array([1.0, 2.0, 3.0, 4.0]))  # 1 + (x + 10)/20 + 2 (y + 10)/20
    buffer, pose = view(mesh)
    x, y = buffer.position_um[..., 0], buffer.position_um[..., 1]
    assert np.allclose(secondary_rate(buffer, pose, OFF, mesh, MICROSCOPE), 1 + (x + 10) / 20 + (y + 10) / 10)


def test_beside_the_specimen_there_is_background():
    mesh = plane(width=2.0)
    buffer, pose = view(mesh)
    rate = secondary_rate(buffer, pose, replace(OFF, background=0.07), mesh, MICROSCOPE)
    assert (rate[buffer.miss] == 0.07).all()
    assert (rate[~buffer.miss] == 1.0).all()
    assert 0 < buffer.miss.mean() < 1


def test_the_brightness_of_a_tilted_plane_is_the_yield_law():
    """All effects on, at their defaults but for the side detector: a plane has no edges and hides nothing."""
    options = replace(SignalOptions(), asymmetry=0.0, yield_exponent=1.1)
    for tilt_deg in (0.0, 20.0, 40.0, 60.0, 80.0):
        buffer, pose = view(plane(), tilt_deg, 30.0)
        expected = min(np.cos(np.radians(tilt_deg)) ** -1.1, options.max_yield)
        assert np.allclose(secondary_rate(buffer, pose, options, plane(), MICROSCOPE), expected, rtol=1e-9)


def test_a_groove_is_darker_and_an_edge_brighter_than_a_flat_by_the_stated_amounts():
    """The amounts of docs/physics.md: a trench 4 um wide and 8 um deep with upright walls, pixels of 0.1 um."""
    mesh, microscope = trench(2.0, 8.0), Microscope(0.1, 240, 60)
    buffer, pose = view(mesh, microscope=microscope)
    x, rate = buffer.position_um[30, :, 0], {}
    for detector in ("everhart-thornley", "in-lens"):
        options = replace(SignalOptions(), asymmetry=0.0, detector=detector)
        rate[detector] = secondary_rate(buffer, pose, options, mesh, microscope)[30]
    flat, bottom = np.abs(x) > 11, np.abs(x) < 0.2
    edge = np.abs(np.abs(x) - 2.05) < 0.02
    assert edge.sum() == 2
    for look, dark, bright in (("everhart-thornley", 0.61, 1.38), ("in-lens", 0.54, 1.58)):
        assert rate[look][flat] == pytest.approx(1.0, abs=1e-9)
        assert rate[look][bottom].mean() == pytest.approx(dark, abs=0.02)
        assert rate[look][edge].mean() == pytest.approx(bright, abs=0.02)


def test_an_in_lens_detector_favours_no_side():
    buffer, pose = view(groove(4.0, 3.0))
    sides = (replace(SignalOptions(), detector="in-lens", detector_azimuth_deg=azimuth) for azimuth in (0.0, 90.0))
    first, second = (secondary_rate(buffer, pose, options, groove(4.0, 3.0), MICROSCOPE) for options in sides)
    assert np.array_equal(first, second)
    left, right = (np.abs(buffer.position_um[18, :, 0] - x).argmin() for x in (-2.125, 2.125))
    assert first[18, left] == pytest.approx(first[18, right], rel=0.01)


@given(st.floats(0, 1), st.floats(0, 3))
def test_an_in_lens_detector_keeps_off_switches_off_and_strengthens_what_is_on(shadowing, edge_strength):
    stated = SignalOptions(shadowing=shadowing, edge_strength=edge_strength)
    assert as_seen(stated) == stated
    seen = as_seen(replace(stated, detector="in-lens"))
    assert seen.asymmetry == 0
    assert seen.edge_strength == 1.5 * edge_strength
    assert 1 - seen.shadowing == pytest.approx((1 - shadowing) ** 2)


def test_channels_stand_in_their_order():
    buffer, pose = view(plane())
    both = replace(OFF, backscatter=BackscatterOptions(segments=3))
    assert list(electron_rates(buffer, pose, OFF, plane(), MICROSCOPE)) == ["se"]
    assert list(electron_rates(buffer, pose, both, plane(), MICROSCOPE)) == ["se", "bse_a", "bse_b", "bse_c", "bse"]


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-25, 25))
def test_any_plane_sees_the_whole_sky(slope_x, slope_y, tilt_deg):
    mesh = plane(slope_x, slope_y)
    buffer, _ = view(mesh, tilt_deg, 20.0)
    assert np.allclose(sky_visibility(buffer, mesh, 0.25, 5.0), 1.0, atol=1e-9)


def test_a_convex_ridge_sees_the_whole_sky():
    ridge = groove(4.0, -3.0)
    buffer, _ = view(ridge)
    inside = np.abs(buffer.position_um[..., 0]) < 3.5
    assert np.allclose(sky_visibility(buffer, ridge, 0.25, 0.5)[inside], 1.0, atol=1e-9)


def floor_beside_a_wall(reach_um: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance from a wall 40 um high, and the sky seen there, along one row of the level floor beside it."""
    x, z = [-100.0, 0.0, 0.0, 100.0], [0.0, 0.0, 40.0, 40.0]
    vertices = [(x[k], y, z[k]) for i in range(3) for y in (-100.0, 100.0) for k in (i, i + 1)]
    faces = [f for i in range(0, 12, 4) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    microscope = Microscope(0.05, 241, 41)
    mesh = Mesh(np.array(vertices), np.array(faces, dtype=np.int32))
    buffer, _ = view(mesh, microscope=microscope)
    floor = buffer.position_um[20, :, 0] < -0.01
    return -buffer.position_um[20, floor, 0], sky_visibility(buffer, mesh, 0.05, reach_um)[20, floor]


def test_at_the_foot_of_a_high_wall_the_half_sky_is_gone():
    """Seven of the sixteen directions face the wall and see nothing; two run along it and seven away."""
    distance, sky = floor_beside_a_wall(4.0)
    assert distance[-1] == pytest.approx(0.05)
    assert sky[-1] == pytest.approx(9 / 16, abs=0.002)


def test_a_shadow_grows_towards_the_wall_and_begins_softly():
    distance, sky = floor_beside_a_wall(4.0)
    assert (sky[distance > 4.0 + 0.05] == 1).all()
    assert (np.diff(sky) < 0.02).all()
    assert np.abs(np.diff(sky[distance > 1.0])).max() < 0.06
    assert sky[np.argmin(np.abs(distance - 0.5))] < 0.7


def test_deeper_is_darker_and_the_bottom_darkest():
    microscope = Microscope(0.1, 121, 21)
    bottoms = []
    for depth in (0.5, 1.0, 2.0, 4.0):
        mesh = groove(4.0, depth)
        buffer, _ = view(mesh, microscope=microscope)
        sky = sky_visibility(buffer, mesh, 0.1, 8.0)[10]
        assert sky[60] <= sky[70] + 1e-9 <= sky[105] + 2e-9
        bottoms.append(sky[60])
    assert np.all(np.diff(bottoms) < -0.01)


@given(st.floats(0, 1))
def test_shadowing_takes_its_share(share):
    assert shadow_response(np.array([1.0, 0.0]), share).tolist() == pytest.approx([1.0, 1.0 - share])


@pytest.mark.parametrize(
    ("key", "value"),
    [("asymmetry", 1.5), ("max_yield", 0.5), ("shadowing", float("nan")), ("edge_strength", -1.0), ("detector", "bse")],
)
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        SignalOptions(**{key: value})
