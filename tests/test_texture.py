"""Claims on surface texture: closed forms, the plane that is taken off, missing pixels, units."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_surface import KnowsTheBump, bump_series

from semrecon.data import HeightMap
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import report
from semrecon.surface.texture import Texture, surface_texture, texture_of

PIXEL_UM = 0.2
AMPLITUDE_UM = 1.5


def heights(z: np.ndarray, pixel_um: float = PIXEL_UM) -> HeightMap:
    return HeightMap(z, np.full_like(z, 0.1), pixel_um)


def sine(amplitude: float = AMPLITUDE_UM, periods: int = 8, size: int = 800) -> np.ndarray:
    """Whole periods across, constant down: half a pixel off the zero, so that the samples are symmetric."""
    phase = 2 * np.pi * periods * (np.arange(size) + 0.5) / size
    return np.tile(amplitude * np.sin(phase), (20, 1))


def inclined(z: np.ndarray, slope_x: float, slope_y: float, pixel_um: float = PIXEL_UM) -> np.ndarray:
    rows, columns = np.indices(z.shape)
    return z + slope_x * columns * pixel_um - slope_y * rows * pixel_um


def test_a_sine_wave() -> None:
    found = texture_of(sine(), PIXEL_UM)
    assert found.Sq_um == pytest.approx(AMPLITUDE_UM / np.sqrt(2), rel=1e-9)
    assert found.Sa_um == pytest.approx(2 * AMPLITUDE_UM / np.pi, rel=1e-3)
    assert found.Sz_um == pytest.approx(2 * AMPLITUDE_UM, rel=1e-3)
    assert found.Sp_um == pytest.approx(found.Sv_um, rel=1e-9)
    assert found.Ssk == pytest.approx(0, abs=1e-9)
    assert found.Sku == pytest.approx(1.5, rel=1e-9)
    wave_number = 2 * np.pi * 8 / (800 * PIXEL_UM)
    assert found.Sdq == pytest.approx(AMPLITUDE_UM * wave_number / np.sqrt(2), rel=1e-3)


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.7, 0.0), (0.3, -0.4)])
def test_a_plane_has_no_texture_but_an_area(slope_x: float, slope_y: float) -> None:
    found = surface_texture(heights(inclined(np.full((30, 40), 5.0), slope_x, slope_y)))
    assert (found.slope_x, found.slope_y) == pytest.approx((slope_x, slope_y), abs=1e-12)
    for value in (found.levelled.Sa_um, found.levelled.Sq_um, found.levelled.Sz_um, found.levelled.Sdq):
        assert value == pytest.approx(0, abs=1e-10)
    assert np.isnan(found.levelled.Ssk)
    assert np.isnan(found.levelled.Sku)
    assert found.unlevelled.Sdq == pytest.approx(np.hypot(slope_x, slope_y), abs=1e-9)
    assert found.unlevelled.Sdr == pytest.approx(np.sqrt(1 + slope_x**2 + slope_y**2) - 1, abs=1e-9)


def test_levelling_takes_off_the_plane_and_nothing_else() -> None:
    rough = np.random.default_rng(0).normal(size=(60, 80))
    flat, steep = surface_texture(heights(rough)), surface_texture(heights(inclined(rough, 0.9, -0.2)))
    for name, value in dataclasses.asdict(flat.levelled).items():
        assert getattr(steep.levelled, name) == pytest.approx(value, rel=1e-9, abs=1e-9), name
    assert steep.unlevelled.Sq_um > 3 * flat.unlevelled.Sq_um


def test_known_skewness_and_kurtosis() -> None:
    share = 0.2  # pits of depth 1 in a flat surface: a Bernoulli variable, mirrored
    z = np.where(np.random.default_rng(1).permutation(10_000) < share * 10_000, -1.0, 0.0).reshape(100, 100)
    found = texture_of(z, PIXEL_UM)
    variance = share * (1 - share)
    assert found.Ssk == pytest.approx(-(1 - 2 * share) / np.sqrt(variance))
    assert found.Sku == pytest.approx(3 + (1 - 6 * variance) / variance)
    assert (found.Sp_um, found.Sv_um) == pytest.approx((share, 1 - share))


def test_normal_heights_have_the_moments_of_the_normal_distribution() -> None:
    found = surface_texture(heights(np.random.default_rng(2).normal(scale=0.3, size=(400, 500)))).levelled
    n = 200_000
    assert abs(found.Sq_um / 0.3 - 1) < 4 / np.sqrt(2 * n)
    assert found.Sa_um == pytest.approx(0.3 * np.sqrt(2 / np.pi), rel=0.01)
    assert abs(found.Ssk) < 4 * np.sqrt(6 / n)
    assert abs(found.Sku - 3) < 4 * np.sqrt(24 / n)


@settings(max_examples=25, deadline=None)
@given(factor=st.floats(1e-3, 1e3), offset=st.floats(-100, 100), seed=st.integers(0, 1000))
def test_units_and_offset(factor: float, offset: float, seed: int) -> None:
    z = np.random.default_rng(seed).gamma(2.0, size=(12, 15))
    one = surface_texture(heights(z)).levelled
    other = surface_texture(heights(factor * (z + offset), factor * PIXEL_UM)).levelled
    for field in dataclasses.fields(Texture):
        scale = factor if field.name.endswith("_um") else 1.0
        assert getattr(other, field.name) == pytest.approx(scale * getattr(one, field.name), rel=1e-6), field.name


def test_upside_down_swaps_peaks_and_pits() -> None:
    z = np.random.default_rng(3).gamma(2.0, size=(20, 25))
    up, down = texture_of(z, PIXEL_UM), texture_of(-z, PIXEL_UM)
    assert (up.Sp_um, up.Sv_um, up.Ssk) == pytest.approx((down.Sv_um, down.Sp_um, -down.Ssk))
    assert (up.Sq_um, up.Sdr) == pytest.approx((down.Sq_um, down.Sdr))


def test_missing_pixels_take_no_part() -> None:
    z = inclined(sine(), 0.05, 0.02)
    holed = z.copy()
    holed[:, 400:] = np.nan  # half the periods go; the plane is that of the rest
    whole, rest = surface_texture(heights(z[:, :400])), surface_texture(heights(holed))
    assert rest.coverage == 0.5
    assert whole.coverage == 1.0
    for name, value in dataclasses.asdict(whole.levelled).items():
        assert getattr(rest.levelled, name) == pytest.approx(value, rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("known", [0, 1, 2])
def test_hardly_any_heights(known: int) -> None:
    z = np.full((5, 6), np.nan)
    z.flat[:known] = [1.0, 2.0][:known]
    found = surface_texture(heights(z))
    assert found.coverage == pytest.approx(known / 30)
    assert np.isnan(found.levelled.Sq_um) == (known == 0)
    assert np.isnan(found.levelled.Sdr)
    assert known == 0 or found.levelled.Sq_um == pytest.approx(0, abs=1e-12)


def test_the_report_states_it_and_what_it_rests_on() -> None:
    result = reconstruct(bump_series(), KnowsTheBump(heights=True))
    content = json.loads(json.dumps(report(result), allow_nan=False))
    found = content["texture"]
    assert found["coverage"] == pytest.approx(result.completeness)
    z = result.heights.z_um[np.isfinite(result.heights.z_um)]
    assert found["unlevelled"]["Sq_um"] == pytest.approx(z.std())
    assert found["unlevelled"]["Sa_um"] == pytest.approx(np.abs(z - z.mean()).mean())
    assert found["levelled"]["Sz_um"] == pytest.approx(3.0, abs=0.1)
