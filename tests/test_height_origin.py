"""Claims on height 0: the median goes there, and no image notices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_surface import KnowsTheBump, bump_series

from semrecon.geometry import project
from semrecon.surface.height_origin import with_median_zero


@pytest.mark.parametrize("reference", [0, 2])
def test_the_median_is_zero_and_every_sighting_stays(reference: int) -> None:
    series = bump_series((4.0, 6.0, 12.0))
    found = KnowsTheBump(heights=True)(series, rng=np.random.default_rng(0))
    found = replace(found, ties=found.points.keep(np.arange(len(found.points)) < 5))
    moved = with_median_zero(found, reference)
    assert np.nanmedian(moved.heights.z_um) == pytest.approx(0.0, abs=1e-12)
    for view in range(3):
        one, other = (
            project(each.points.xyz_um, each.poses.rotations[view], each.poses.translations_um[view], series.optics)
            for each in (found, moved)
        )
        np.testing.assert_allclose(other, one, atol=1e-9)
    camera = moved.points.xyz_um @ moved.poses.rotations[reference].T + moved.poses.translations_um[reference]
    before = found.points.xyz_um @ found.poses.rotations[reference].T + found.poses.translations_um[reference]
    np.testing.assert_allclose(before[:, 2] - camera[:, 2], -np.nanmedian(found.heights.z_um))
    np.testing.assert_array_equal(moved.ties.xyz_um, moved.points.xyz_um[:5])


def test_nothing_measured_stays_as_it_is() -> None:
    series = bump_series()
    found = KnowsTheBump()(series, rng=np.random.default_rng(0))
    assert with_median_zero(found, 0) is found
