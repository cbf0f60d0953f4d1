"""A finished reconstruction and its report."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semrecon.data import Array, Estimate, HeightMap, PointCloud, SurfaceMesh, TiltSeries
from semrecon.surface.texture import surface_texture

SCHEMA = "semrecon.reconstruction/1"
"""Mark by which a reconstruction folder knows its own kind."""
REPORTED_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "scikit-image", "open3d")


@dataclass(frozen=True)
class Reconstruction:
    """All that a reconstruction folder holds.

    Parameters
    ----------
    series
        What was reconstructed.
    method, options
        Name of the method and its options.
    estimate
        The method's answer as it came.
    points, heights, mesh
        World-frame cloud, height map of the reference view and surface; completed from each other.
    warnings
        Sentences for the user, of all stages.
    seed
        Of the random generator that the method was given.
    seconds
        Wall-clock time of every stage.
    sources
        Who stated the pixel size and the tilts.
    meshing
        How the mesh was made: "triangles" of the reference view, or "poisson".
    later_views
        Pose of each further image of unknown orientation (`semrecon.pose.later_views`), ready for the report.
    """

    series: TiltSeries
    method: str
    options: Mapping[str, Any]
    estimate: Estimate
    points: PointCloud
    heights: HeightMap
    mesh: SurfaceMesh
    warnings: tuple[str, ...] = ()
    seed: int | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    meshing: str = "triangles"
    later_views: tuple[Mapping[str, Any], ...] = ()

    @property
    def median_sigma_um(self) -> float:
        """Median standard deviation along z of the points, um; NaN where the method states none."""
        return finite_median(self.points.sigma_um)

    @property
    def fitted(self) -> PointCloud:
        """Points whose residuals tell how well the poses fit: the ties where the method names them."""
        return self.points if self.estimate.ties is None else self.estimate.ties

    @property
    def completeness(self) -> float:
        """Fraction of the pixels of the reference view that have a height."""
        return float(np.isfinite(self.heights.z_um).mean())

    @property
    def relief_um(self) -> float:
        """Height between the lowest and the highest percent of the surface, um."""
        finite = self.heights.z_um[np.isfinite(self.heights.z_um)]
        return float(np.subtract(*np.percentile(finite, [99, 1]))) if finite.size else math.nan


def finite_median(values: Array) -> float:
    """Median of the finite values, NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def report(result: Reconstruction) -> dict[str, Any]:
    """Everything worth keeping beside the arrays, ready for strict JSON: what is unknown is null."""
    content = {
        "schema": SCHEMA,
        "method": result.method,
        "options": result.options,
        "seed": result.seed,
        "series": _series(result),
        "poses": _poses(result),
        "counts": _counts(result),
        "residuals": _residuals(result),
        "heights": {"completeness": result.completeness, "relief_um": result.relief_um},
        "texture": surface_texture(result.heights),
        "meshing": result.meshing,
        "later_views": result.later_views,
        "diagnostics": result.estimate.diagnostics,
        "warnings": result.warnings,
        "versions": versions(),
        "seconds": result.seconds,
    }
    plain = jsonable(content)
    assert isinstance(plain, dict)
    return plain


def _series(result: Reconstruction) -> dict[str, Any]:
    optics = result.series.optics
    return {
        "views": [{"image": view.name, "tilt_deg": view.tilt_deg} for view in result.series.views],
        "reference": result.series.reference,
        "tilt_axis_deg": result.series.tilt_axis_deg,
        "pixel_size_um": optics.pixel_size_um,
        "width_px": optics.width_px,
        "height_px": optics.height_px,
        "inverse_working_distance": optics.inverse_working_distance,
        "stated_by": result.sources,
    }


def _poses(result: Reconstruction) -> list[dict[str, Any]] | None:
    poses = result.estimate.poses
    if poses is None:
        return None
    both = zip(poses.rotations, poses.translations_um, strict=True)
    return [{"rotation_cam_from_world": rotation, "translation_um": shift} for rotation, shift in both]


def _counts(result: Reconstruction) -> dict[str, Any]:
    return {
        "points": len(result.points),
        "ties": None if result.estimate.ties is None else len(result.estimate.ties),
        "height_pixels": int(np.isfinite(result.heights.z_um).sum()),
        "mesh_vertices": len(result.mesh.vertices_um),
        "mesh_faces": len(result.mesh.faces),
        "clouds": [len(cloud) for cloud in result.estimate.clouds],
        "pairs": result.estimate.pairs,
    }


def _residuals(result: Reconstruction) -> dict[str, Any]:
    residual = result.fitted.residual_px
    finite = residual[np.isfinite(residual)]
    return {
        "reprojection_median_px": finite_median(residual),
        "reprojection_rms_px": float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan,
        "sigma_median_um": result.median_sigma_um,
    }


def versions() -> dict[str, str]:
    """Versions of what the numbers rest on."""
    from importlib.metadata import PackageNotFoundError, version

    from semrecon import __version__

    found = {"semrecon": __version__, "python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def jsonable(value: Any) -> Any:
    """Turn NumPy, dataclasses, mappings and tuples into what strict JSON knows; numbers that are none become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else _known(value)


def _known(value: Any) -> Any:
    """Pass what JSON knows; everything else by its text."""
    return value if value is None or isinstance(value, bool | int | str) else str(value)
