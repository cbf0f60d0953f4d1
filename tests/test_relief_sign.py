"""Claims on the sign of a relief: shading that goes with height says right side out, and turned over the opposite."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from semrecon.data import Array, HeightMap, Optics, TiltSeries, View
from semrecon.errors import InputError
from semrecon.photometry.relief_sign import inside_out_warning, relief_sign

SHAPE = (240, 320)


def rough(seed: int) -> Array:
    z = gaussian_filter(np.random.default_rng(seed).normal(size=SHAPE), 4)
    return np.asarray(z / z.std())


def series(picture: Array) -> TiltSeries:
    image = np.clip(128 + 30 * picture, 0, 255).astype(np.uint8)
    return TiltSeries((View(image, 0.0), View(image, 5.0)), Optics(0.1, SHAPE[1], SHAPE[0]))


def heights(z: Array) -> HeightMap:
    return HeightMap(z, np.full_like(z, 0.1), 0.1)


def test_bright_heights_are_right_and_bright_pits_are_inside_out() -> None:
    z = rough(1)
    seen = series(z + 0.5 * rough(2))
    assert relief_sign(seen, heights(z)).score == pytest.approx(-relief_sign(seen, heights(-z)).score)
    assert inside_out_warning(seen, heights(z)) is None
    assert "--flip-tilt" in str(inside_out_warning(seen, heights(-z)))


def test_chance_and_slope_alone_warn_of_nothing() -> None:
    z = rough(3)
    slope = np.hypot(*np.gradient(z))
    for picture in (rough(4), 4 * slope):
        for sign in (1, -1):
            assert inside_out_warning(series(picture), heights(sign * z)) is None


def test_a_map_of_another_grid_is_refused() -> None:
    with pytest.raises(InputError, match="shape"):
        relief_sign(series(rough(1)), heights(np.zeros((5, 5))))
