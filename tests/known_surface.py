"""A textured bump photographed at several tilts, and a method that knows it: for tests of what surrounds methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from semrecon.data import Estimate, HeightMap, Optics, PointCloud, TiltSeries, View
from semrecon.errors import MethodError
from semrecon.geometry import nominal_poses
from semrecon.methods.base import Gauge, Need

PIXEL_UM = 0.1
HEIGHT_PX, WIDTH_PX = 120, 160


def bump_um(x_um: np.ndarray, y_um: np.ndarray) -> np.ndarray:
    """Height of the surface at world x, y: a smooth hill of 3 um."""
    return 3.0 * np.exp(-(x_um**2 + y_um**2) / (2 * 3.0**2))


def grid_um() -> tuple[np.ndarray, np.ndarray]:
    """World x and y of every pixel of the reference view."""
    rows, columns = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX].astype(float)
    return (columns - (WIDTH_PX - 1) / 2) * PIXEL_UM, -(rows - (HEIGHT_PX - 1) / 2) * PIXEL_UM


def picture(tilt_deg: float) -> np.ndarray:
    """Image of the bump with paint on it at one tilt about the vertical axis, uint8."""
    paint = gaussian_filter(np.random.default_rng(5).normal(size=(HEIGHT_PX, WIDTH_PX)), 1.5)
    paint = np.clip(128 + 45 * paint / paint.std(), 1, 254)
    seen_x, y = grid_um()
    tilt = np.deg2rad(tilt_deg)
    x = seen_x.copy()
    for _ in range(30):  # fixed point of x cos + z sin = seen x
        x = (seen_x - bump_um(x, y) * np.sin(tilt)) / np.cos(tilt)
    rows, columns = -y / PIXEL_UM + (HEIGHT_PX - 1) / 2, x / PIXEL_UM + (WIDTH_PX - 1) / 2
    return map_coordinates(paint, [rows, columns], order=3, mode="reflect").round().clip(0, 255).astype(np.uint8)


def bump_series(tilts_deg: tuple[float, ...] = (0.0, 6.0, 12.0)) -> TiltSeries:
    """A series of the bump at the tilts given."""
    views = tuple(View(picture(tilt), tilt, name=f"bump_{i}.tif") for i, tilt in enumerate(tilts_deg))
    return TiltSeries(views, Optics(PIXEL_UM, WIDTH_PX, HEIGHT_PX))


@dataclass(frozen=True)
class KnowsTheBump:
    """Answer the true bump as points (every eighth pixel), as heights, or both; draw sigma from the generator."""

    points: bool = True
    heights: bool = False
    fails: bool = False

    name: ClassVar[str] = "knows_the_bump"
    citation: ClassVar[str] = "none"
    needs: ClassVar[tuple[Need, ...]] = ("rotations",)
    views: ClassVar[tuple[int, int | None]] = (2, 9)
    gauge: ClassVar[tuple[Gauge, ...]] = ()

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Reconstruct."""
        if self.fails:
            raise MethodError("only 3 matches between a.tif and b.tif, at least 8 are needed; check the tilts")
        x, y = grid_um()
        z = bump_um(x, y)
        sigma = rng.uniform(0.05, 0.15, z.shape)
        z[:2], sigma[:2] = np.nan, np.nan
        return Estimate(
            points=self._cloud(x, y, z, sigma) if self.points else None,
            heights=HeightMap(z, sigma, PIXEL_UM) if self.heights else None,
            poses=nominal_poses(series),
            diagnostics={"residual": np.float64("nan"), "matches": np.array([1, 2])},
            warnings=("a sentence from the method",),
        )

    @staticmethod
    def _cloud(x: np.ndarray, y: np.ndarray, z: np.ndarray, sigma: np.ndarray) -> PointCloud:
        keep = np.zeros(z.shape, dtype=bool)
        keep[4::8, 4::8] = True
        xyz = np.stack([x[keep], y[keep], z[keep]], axis=1)
        covariance = sigma[keep, None, None] ** 2 * np.eye(3)
        rows, columns = np.nonzero(keep)
        return PointCloud(xyz, covariance, np.full(len(xyz), 0.2), np.column_stack([columns, rows]).astype(float))
