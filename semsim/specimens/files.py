"""Specimens from files: triangle meshes, and measured height maps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.specimens.noise import speckle
from semsim.specimens.sheet import sheet
from semsim.specimens.substrate import visible_median_um

Array = NDArray[np.float64]

HEIGHT_MAP_SUFFIXES = (".npz", ".tif", ".tiff")


@dataclass(frozen=True)
class MeshFile:
    """A mesh in any format that trimesh reads.

    Parameters
    ----------
    file
        The mesh.
    unit_um
        Length of the file's unit.
    centred
        Move the middle of the mesh, seen from above, to the origin and its median visible height to 0; else leave it
        in place.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    """

    name: ClassVar[str] = "mesh file"
    file: Path
    unit_um: float = 1.0
    centred: bool = True
    contrast: float = 0.0
    grain_um: float = 1.0

    def __post_init__(self) -> None:
        _require_positive(self.file, "unit_um", self.unit_um)

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the mesh in um; raise `InputError` where the file is missing or holds no triangles."""
        vertices, faces = _read_mesh(_existing(self.file))
        vertices = self.unit_um * vertices
        if self.centred:
            vertices = _centred(vertices, faces)
        return Mesh(vertices, faces, speckle(vertices, self.contrast, self.grain_um, rng))


@dataclass(frozen=True)
class HeightMapFile:
    """A measured surface on a regular grid: row 0 is the image's top (highest y), NaN is a hole.

    Parameters
    ----------
    file
        An npz with `z_um` (rows, columns) and, unless given here, `pixel_size_um`; or a TIFF of float heights in um.
    pixel_size_um
        Spacing of columns and rows. None takes it from the npz, where it may be a pair (x, y).
    height_scale
        Factor on the heights: where measured relief is too small for parallax. Say so where the result is used.
    smooth_um
        Standard deviation of a Gaussian that averages the heights before anything else: the lines and the noise of a
        measurement show in a micrograph long before they show in its heights. Holes stay holes. 0 leaves them alone.
    contrast, grain_um
        Speckle of the electron yield: standard deviation as a fraction, and width.
    """

    name: ClassVar[str] = "height map file"
    file: Path
    pixel_size_um: float | None = None
    height_scale: float = 1.0
    smooth_um: float = 0.0
    contrast: float = 0.0
    grain_um: float = 1.0

    def __post_init__(self) -> None:
        if self.pixel_size_um is not None:
            _require_positive(self.file, "pixel_size_um", self.pixel_size_um)
        if not (np.isfinite(self.smooth_um) and self.smooth_um >= 0):
            raise InputError(f"smooth_um of {self.file} must be a number of um, 0 or more; it is {self.smooth_um:g}")

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the open surface about the origin, median height at 0; cells with a NaN corner are left out."""
        z_um, (step_x, step_y) = self._read()
        rows, columns = z_um.shape
        x_um = step_x * (np.arange(columns) - (columns - 1) / 2)
        y_um = step_y * (np.arange(rows) - (rows - 1) / 2)
        z_um = _smoothed(z_um, (self.smooth_um / step_y, self.smooth_um / step_x))
        heights = self.height_scale * (z_um - np.nanmedian(z_um))
        vertices, faces = sheet(x_um, y_um, heights[::-1].T)  # the last row of the image has the lowest y
        vertices, faces = _measured_part(vertices, faces)
        if len(faces) == 0:
            raise InputError(f"{self.file} has no four neighbouring heights that are numbers; a surface needs some")
        return Mesh(vertices, faces, speckle(vertices, self.contrast, self.grain_um, rng))

    def _read(self) -> tuple[Array, tuple[float, float]]:
        """Return heights (rows, columns) in um and the spacing along x and y."""
        path = _existing(self.file)
        z_um, stored = _read_npz(path) if path.suffix.lower() == ".npz" else (_read_tiff(path), None)
        if z_um.ndim != 2 or min(z_um.shape) < 2 or not np.isfinite(z_um).any():
            raise InputError(
                f"{path} must hold a table of heights, two rows and columns or more; its shape is {z_um.shape}"
            )
        spacing = stored if self.pixel_size_um is None else (self.pixel_size_um, self.pixel_size_um)
        if spacing is None:
            raise InputError(
                f"{path} does not say its pixel size; add pixel_size_um, the grid spacing in um, to the specimen"
            )
        return z_um, spacing


def _require_positive(path: Path, option: str, value: float) -> None:
    """Raise `InputError` unless an option of a file specimen is a positive, finite number."""
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{option} of {path} must be a positive number of um; it is {value:g}")


def _existing(path: Path) -> Path:
    """Return a path that is a file; raise `InputError` otherwise."""
    if not path.is_file():
        raise InputError(f"there is no specimen file {path}; give the path of a mesh or a height map")
    return path


def _read_mesh(path: Path) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices and faces as they stand in the file; corners that a format repeats (STL) are welded."""
    import trimesh

    try:
        mesh: Any = trimesh.load_mesh(path, process=False)
    except Exception as error:  # whatever a reader of some format raises, the file is what is wrong
        raise InputError(f"{path} cannot be read as a mesh ({error}); PLY, OBJ, STL, OFF and glTF are read") from error
    if len(getattr(mesh, "faces", ())) == 0:
        raise InputError(f"{path} holds no triangles; a specimen needs a surface, not a point cloud")
    if path.suffix.lower() == ".stl":
        mesh.merge_vertices()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32)


def _centred(vertices_um: Array, faces: NDArray[np.int32]) -> Array:
    """Return vertices with the middle of their bounding box over the origin and the median visible height at 0."""
    low, high = vertices_um.min(axis=0), vertices_um.max(axis=0)
    moved = vertices_um - [*(low + high)[:2] / 2, 0.0]
    width_um, height_um = (high - low)[:2]
    moved[:, 2] -= visible_median_um(moved, faces, width_um, height_um)
    return np.asarray(moved)


def _read_npz(path: Path) -> tuple[Array, tuple[float, float] | None]:
    """Return `z_um` and, where it is there, `pixel_size_um` as a pair (x, y)."""
    try:
        with np.load(path) as stored:
            arrays = {key: stored[key] for key in stored.files}
    except Exception as error:
        raise InputError(f"{path} cannot be read as an npz archive ({error})") from error
    if "z_um" not in arrays:
        raise InputError(
            f"{path} has no array z_um with the heights in um; it has {', '.join(sorted(arrays)) or 'none'}"
        )
    spacing = arrays.get("pixel_size_um")
    if spacing is None:
        return arrays["z_um"].astype(np.float64), None
    x, y = np.broadcast_to(np.asarray(spacing, dtype=np.float64).ravel(), 2)
    _require_positive(path, "pixel_size_um", min(x, y))
    return arrays["z_um"].astype(np.float64), (float(x), float(y))


def _read_tiff(path: Path) -> Array:
    """Return the heights of a float TIFF; raise `InputError` for an ordinary picture."""
    import tifffile

    try:
        values = tifffile.imread(path)
    except Exception as error:
        raise InputError(f"{path} cannot be read as a TIFF ({error})") from error
    if values.dtype.kind != "f":
        raise InputError(f"{path} holds {values.dtype} grey values; a height map is a TIFF of float32 heights in um")
    return np.asarray(values, dtype=np.float64)


def _smoothed(z_um: Array, sigma_px: tuple[float, float]) -> Array:
    """Return heights (rows, columns) averaged by a Gaussian over what was measured; NaN stays NaN."""
    from scipy.ndimage import gaussian_filter

    if max(sigma_px) == 0:
        return z_um
    known = np.isfinite(z_um)
    total = gaussian_filter(np.where(known, z_um, 0.0), sigma_px)
    weight = gaussian_filter(known.astype(np.float64), sigma_px)
    return np.where(known, total / np.where(known, weight, 1.0), np.nan)


def _measured_part(vertices: Array, faces: NDArray[np.int32]) -> tuple[Array, NDArray[np.int32]]:
    """Return the faces whose corners are all numbers, and the vertices that they use."""
    known = np.isfinite(vertices[:, 2])
    faces = faces[known[faces].all(axis=1)]
    used, position = np.unique(faces, return_inverse=True)
    return vertices[used], position.reshape(faces.shape).astype(np.int32)
