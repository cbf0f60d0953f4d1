"""Shape from shading: one view, the secant law of secondary electrons, and an assumption on which way things fall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import numpy as np
from scipy.ndimage import gaussian_filter

from semrecon.data import Array, Estimate, HeightMap, Mask, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.methods.base import Gauge, Need
from semrecon.photometry.photometric import usable
from semrecon.photometry.shading import Lowest, first_relief, improve, misfit, steepness


@dataclass(frozen=True)
class ShapeFromShading:
    """Steepness from brightness, direction from an assumption, heights from both.

    The secant law stands for the reflectance map of Ikeuchi and Horn (1981), who first read SEM pictures so. Where we
    deviate: they iterate on normals that meet known ones along a silhouette; here the eikonal equation is solved for
    heights, globally, and then improved with the frame set free. Wang et al. (2013) analyse the grey values of one top
    view; their own paper was not at hand, and what the seed says of it is all that is followed.

    Neither the exponent nor the black level can be read off a picture: for gentle slopes ``tan(theta)^2`` is about
    ``(2 / n) (I / I0 - 1)``, so both are a scale of the heights, which the gauge declares. Whether relief rises or
    falls cannot be seen either.

    Parameters
    ----------
    lowest
        "frame": the frame is lowest, and what has a bright rim rises. "bright": all falls from the darkest place.
    exponent
        n of the secant law: 0.8 for heavy to 1.2 for light elements.
    flat_percentile
        Percentile of the brightness that is taken for I0, that of a place facing the beam: noise and closed-in
        places make a share of the picture darker than that.
    black_level
        Grey value of no electron.
    steepest
        Slope beyond which brightness is not believed: edges glow.
    blur_px
        Standard deviation of the blur that keeps the noise from looking steep, px; 0 is none.
    rounds, smooth_px
        Rounds of improvement, and the blur of the directions in them, px.
    """

    lowest: Lowest = "frame"
    exponent: float = 1.0
    flat_percentile: float = 25.0
    black_level: float = 0.0
    steepest: float = 3.0
    blur_px: float = 1.0
    rounds: int = 30
    smooth_px: float = 1.0

    name: ClassVar[str] = "shape_from_shading"
    citation: ClassVar[str] = "Ikeuchi and Horn 1981; Rouy and Tourin 1992; after Wang et al. 2013"
    needs: ClassVar[tuple[Need, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (1, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "scale", "mirror")

    def __post_init__(self) -> None:
        if self.lowest not in get_args(Lowest):
            raise InputError(f'option lowest must be "frame" or "bright", not {self.lowest!r}')
        if not 0.2 <= self.exponent <= 3:
            raise InputError(f"option exponent must lie between 0.2 and 3, not {self.exponent:g}; metals are near 0.8")
        if not 0 <= self.flat_percentile <= 90:
            raise InputError(f"option flat_percentile must lie between 0 and 90, not {self.flat_percentile:g}")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:  # noqa: ARG002 - nothing is drawn
        """Reconstruct from the reference view; raises `MethodError` where its picture shows no shading."""
        view, pixel_um = series.views[series.reference], series.optics.pixel_size_um
        known = _known(view)
        brightness = _blurred(view.image.astype(np.float64) - self.black_level, known, self.blur_px)
        flat = float(np.percentile(brightness[known], self.flat_percentile))
        if flat <= 0:
            raise MethodError(f"{_called(view)} is darker than the black level {self.black_level:g}; state a lower one")
        if np.ptp(brightness[known]) < 1e-6 * flat:
            raise MethodError(f"{_called(view)} shows no shading: all of it is equally bright; use another view")
        slope = np.where(known, steepness(brightness, flat, self.exponent, self.steepest), 0.0)
        start = first_relief(slope, pixel_um, self.lowest)
        height = improve(start, slope, pixel_um, self.rounds, self.smooth_px)
        z_um = np.where(known, height - np.median(height[known]), np.nan)
        return Estimate(
            heights=HeightMap(z_um, np.full(z_um.shape, np.nan), pixel_um),
            diagnostics=self._found(flat, slope, start, height, pixel_um),
            warnings=("shape from shading assumes one material, and which way the relief rises",),
        )

    def _found(self, flat: float, slope: Array, start: Array, height: Array, pixel_um: float) -> dict[str, Any]:
        return {
            "flat_grey": flat + self.black_level,
            "share_steepest": float(np.mean(slope >= self.steepest)),
            "misfit_of_start": misfit(start, slope, pixel_um),
            "misfit": misfit(height, slope, pixel_um),
        }


def _known(view: View) -> Mask:
    """Where the picture says how bright the surface is: white is at least that bright, and is kept."""
    known = np.isfinite(view.image) if view.image.dtype.kind == "f" else np.ones(view.image.shape, dtype=bool)
    known = known if view.mask is None else known & view.mask
    if known.sum() < 16 or usable(view.image)[known].mean() < 0.1:
        raise MethodError(f"{_called(view)} is nearly all black, white or missing, so it shows no shading; record anew")
    return known


def _called(view: View) -> str:
    return view.name or "the reference view"


def _blurred(image: Array, known: Mask, blur_px: float) -> Array:
    """Blur what is known; NaN elsewhere."""
    if blur_px > 0:
        share = gaussian_filter(known.astype(np.float64), blur_px)
        image = gaussian_filter(np.where(known, image, 0.0), blur_px) / np.maximum(share, 1e-9)
    return np.where(known, image, np.nan)
