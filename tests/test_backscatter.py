"""Segments of a backscatter detector against Lambert's law in closed form, symmetry, and walls in the way."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from semsim.backscatter import BackscatterOptions, backscatter_coefficient, backscatter_rates, emission
from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses
from semsim.surface import surface_buffer

MICROSCOPE = Microscope(0.25, 24, 18)
LAMBERT = BackscatterOptions(forward=0.0, inner_deg=15.0, outer_deg=50.0)


def plane(vertex_yield=None, width: float = 100.0) -> Mesh:
    vertices = np.array([[-width, -width, 0], [width, -width, 0], [-width, width, 0], [width, width, 0]])
    return Mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]], dtype=np.int32), vertex_yield)


def wall(height_um: float = 30.0) -> Mesh:
    """Level ground at x > 0 beside an upright wall at x = 0; strips that share no vertex."""
    x, z = [-100.0, 0.0, 0.0, 100.0], [height_um, height_um, 0.0, 0.0]
    vertices = [(x[k], y, z[k]) for i in range(3) for y in (-100.0, 100.0) for k in (i, i + 1)]
    faces = [f for i in range(0, 12, 4) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    return Mesh(np.array(vertices), np.array(faces, dtype=np.int32))


def rates(mesh: Mesh, options: BackscatterOptions, tilt_deg: float = 0.0, axis_deg: float = 0.0):
    pose = poses(TiltSchedule((tilt_deg,), axis_deg))[0]
    buffer = surface_buffer(mesh, MICROSCOPE, pose)
    return buffer, backscatter_rates(buffer, pose, options, mesh, MICROSCOPE.pixel_size_um, 0.1)


def at_centre(options: BackscatterOptions, tilt_deg: float, axis_deg: float = 0.0) -> dict[str, float]:
    return {name: float(rate[9, 12]) for name, rate in rates(plane(), options, tilt_deg, axis_deg)[1].items()}


@pytest.mark.parametrize("segments", [2, 3, 4])
@pytest.mark.parametrize(("tilt_deg", "axis_deg"), [(0.0, 0.0), (10.0, 0.0), (25.0, 70.0), (-38.0, 200.0)])
def test_a_tilted_plane_obeys_lamberts_law_over_each_segment(segments, tilt_deg, axis_deg):
    """While the whole segment stays above the plane the integral of the cosine is the dot product of two vectors."""
    options = replace(LAMBERT, segments=segments)
    inner, outer = np.radians([options.inner_deg, options.outer_deg])
    axial = 2 * np.pi / segments * (np.sin(outer) ** 2 - np.sin(inner) ** 2) / 2
    lateral = 2 * np.sin(np.pi / segments) * ((outer - inner) / 2 - (np.sin(2 * outer) - np.sin(2 * inner)) / 4)
    tilt, axis = np.radians([tilt_deg, axis_deg])
    growth = ((1 + np.cos(tilt)) / 2) ** (-9 / np.sqrt(options.atomic_number))
    for k, name in enumerate(["bse_a", "bse_b", "bse_c", "bse_d"][:segments]):
        middle = 2 * np.pi * k / segments
        # A positive tilt about image up leans the normal to the right; the axis turns clockwise.
        lean = np.sin(tilt) * np.cos(middle + axis)
        expected = growth * (np.cos(tilt) * axial + lean * lateral) / (segments * axial)
        assert at_centre(options, tilt_deg, axis_deg)[name] == pytest.approx(expected, abs=1e-3)


@given(st.floats(0, 80), st.floats(0, 360), st.sampled_from([1, 2, 3, 4]))
@settings(max_examples=30)
def test_the_sum_is_even_in_azimuth_and_the_same_however_the_ring_is_cut(tilt_deg, axis_deg, segments):
    whole = at_centre(BackscatterOptions(segments=1), tilt_deg)["bse"]
    assert at_centre(BackscatterOptions(segments=segments), tilt_deg, axis_deg)["bse"] == pytest.approx(whole, rel=0.01)


def test_a_level_sheet_gives_every_segment_its_part():
    seen = at_centre(BackscatterOptions(segments=4), 0.0)
    assert list(seen) == ["bse_a", "bse_b", "bse_c", "bse_d", "bse"]
    assert list(seen.values()) == pytest.approx([0.25] * 4 + [1.0], abs=1e-9)
    assert list(at_centre(BackscatterOptions(segments=1), 0.0)) == ["bse"]


@given(st.floats(1, 60))
@settings(max_examples=20)
def test_the_segment_that_the_surface_faces_is_brightest(tilt_deg):
    seen = at_centre(BackscatterOptions(), tilt_deg)  # leans to the right, where segment a is
    assert seen["bse_a"] > seen["bse_b"] > seen["bse_c"]
    assert seen["bse_b"] == pytest.approx(seen["bse_d"], rel=1e-3)


def test_turning_surface_and_detector_together_changes_nothing():
    for turn in (40.0, 111.0, -75.0):
        turned = at_centre(replace(BackscatterOptions(), azimuth_deg=turn), 35.0, -turn)
        assert turned == pytest.approx(at_centre(BackscatterOptions(), 35.0), rel=1e-6)


def test_a_quarter_turn_of_the_tilt_axis_passes_the_segments_on():
    right, up = at_centre(BackscatterOptions(), 30.0), at_centre(BackscatterOptions(), 30.0, -90.0)
    names = ["bse_a", "bse_b", "bse_c", "bse_d"]
    assert [up[name] for name in names] == pytest.approx([right[name] for name in names[-1:] + names[:-1]], rel=1e-6)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 75.0])
@pytest.mark.parametrize("forward", [0.0, 0.7])
def test_emission_into_the_half_space_above_the_surface_is_all_there_is(tilt_deg, forward):
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    u, azimuth = (np.arange(400) + 0.5) / 200 - 1, (np.arange(400) + 0.5) * np.pi / 200
    across = np.sqrt(1 - u[:, None] ** 2)
    direction = np.stack(np.broadcast_arrays(across * np.cos(azimuth), across * np.sin(azimuth), u[:, None]), axis=-1)
    assert emission(direction, normal, forward).mean() * 4 * np.pi == pytest.approx(1.0, abs=2e-3)


@given(st.floats(6, 79))
def test_heavy_elements_send_back_as_much_as_measured(z):
    """Reuter's polynomial fits coefficients measured at normal incidence."""
    measured = -0.0254 + 0.016 * z - 1.86e-4 * z**2 + 8.3e-7 * z**3
    assert backscatter_coefficient(z, np.ones(1))[0] == pytest.approx(measured, abs=0.025)
    assert backscatter_coefficient(z, np.zeros(1))[0] == 1.0


@given(st.floats(-75, 75), st.floats(0, 360))
@example(70.0, 0.0)  # the tangent plane meets the inner rim of the ring
@settings(max_examples=20)
def test_a_plane_hides_nothing_from_itself(tilt_deg, axis_deg):
    free = at_centre(BackscatterOptions(shadowing=0.0), tilt_deg, axis_deg)
    assert at_centre(BackscatterOptions(), tilt_deg, axis_deg) == pytest.approx(free, rel=1e-6, abs=1e-9)


def test_a_wall_hides_the_segment_behind_it():
    buffer, seen = rates(wall(), BackscatterOptions(shadow_reach_um=4.0))
    foot = (buffer.position_um[9, :, 0] > 0).argmax()
    assert seen["bse_c"][9, foot] == 0.0  # the wall is at the left, and higher than the line to the segment
    assert seen["bse_a"][9, foot] == pytest.approx(0.25, abs=1e-9)
    _, open_ = rates(wall(), BackscatterOptions(shadowing=0.0))
    assert open_["bse_c"][9, foot] == pytest.approx(0.25, abs=1e-9)
    _, half = rates(wall(), BackscatterOptions(shadowing=0.5, shadow_reach_um=4.0))
    assert half["bse_c"][9, foot] == pytest.approx(0.125, abs=1e-9)
    _, low = rates(wall(0.5), BackscatterOptions(shadow_reach_um=4.0))  # its line to the segment falls within 1.4 um
    assert low["bse_c"][9, foot] < 0.1
    assert low["bse_c"][9, -1] == pytest.approx(0.25, abs=1e-9)


def test_material_multiplies_and_beside_the_specimen_there_is_background():
    mesh = plane(np.full(4, 1.7), width=2.0)
    buffer, seen = rates(mesh, BackscatterOptions(segments=2))
    assert 0 < buffer.miss.mean() < 1
    assert np.allclose(seen["bse"][~buffer.miss], 1.7)
    assert np.allclose(seen["bse"][buffer.miss], 0.1)
    assert np.allclose(seen["bse_b"][buffer.miss], 0.05)


@pytest.mark.parametrize(("key", "value"), [("segments", 5), ("outer_deg", 10.0), ("atomic_number", 0.0)])
def test_options_out_of_range_are_named(key, value):
    with pytest.raises(InputError, match=key):
        BackscatterOptions(**{key: value})
