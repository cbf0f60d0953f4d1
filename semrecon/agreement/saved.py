"""Surfaces read back from disk: a reconstruction folder, or the height map or cloud of other software."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, HeightMap, Optics
from semrecon.errors import InputError
from semrecon.geometry import CAM_FROM_VIEW, back_project, nominal_poses, rotations_from_tilts
from semrecon.reconstruction import SCHEMA, Reconstruction

UNITS_UM = {"um": 1.0, "µm": 1.0, "μm": 1.0, "\\u00B5m": 1.0, "micron": 1.0, "microns": 1.0, "nm": 1e-3, "mm": 1e3}
"""Units of length that image programs write beside the resolution of a TIFF."""


@dataclass(frozen=True)
class SavedSurface:
    """A surface with what is needed to bring it into one frame with another.

    Parameters
    ----------
    name
        What to call it in messages and pictures.
    heights
        Along the beam of its reference view on that view's pixels; None for a cloud or a mesh.
    optics, rotation, translation_um
        Grid, projection and pose of that view, R_cam_from_world (3, 3) and t (3,); for a cloud only the frame.
    vertices_um, sigma_um
        Of a cloud or mesh in the world frame, (n, 3) and (n,); None for a height map.
    faces
        Of a mesh, (faces, 3); None for a cloud or a height map.
    view
        Name of the image whose pixels the heights stand on; empty where it is not known.
    """

    name: str
    heights: HeightMap | None
    optics: Optics | None
    rotation: Array
    translation_um: Array
    vertices_um: Array | None = None
    sigma_um: Array | None = None
    faces: NDArray[np.int64] | None = None
    view: str = ""


def is_saved_reconstruction(folder: Path) -> bool:
    """Whether a folder holds a report of ours."""
    try:
        content = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == SCHEMA


def surface_of(result: Reconstruction, name: str = "") -> SavedSurface:
    """Take the height map of a reconstruction that is still in memory."""
    series = result.series
    poses = result.estimate.poses or nominal_poses(series)
    i = series.reference
    return SavedSurface(
        name or result.method,
        result.heights,
        series.optics,
        poses.rotations[i],
        poses.translations_um[i],
        view=series.views[i].name,
    )


def read_surface(path: Path | str, pixel_size_um: float | None = None) -> SavedSurface:
    """Read a surface.

    Parameters
    ----------
    path
        A reconstruction folder; a PLY (cloud or mesh) or XYZ file in um; or a 32 bit TIFF of heights in um.
    pixel_size_um
        Of a TIFF; by default what an ImageJ-like program wrote into it.

    Raises
    ------
    InputError
        It is none of these, is damaged, or a TIFF states no pixel size.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist; give a reconstruction folder, or a PLY, XYZ or TIFF file")
    if path.is_dir():
        return _read_folder(path)
    kind = path.suffix.lower()
    if kind in {".tif", ".tiff"}:
        return _read_map(path, pixel_size_um)
    if kind == ".ply":
        return _read_ply(path)
    if kind in {".xyz", ".txt", ".asc"}:
        return _read_xyz(path)
    raise InputError(f"{path} is no surface that is read here; give a reconstruction folder, or PLY, XYZ or TIFF")


def _read_folder(folder: Path) -> SavedSurface:
    if not is_saved_reconstruction(folder):
        raise InputError(f"{folder} is no reconstruction: its report.json is missing or not of this program")
    content = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    try:
        optics, rotation, translation, view = _reference(content)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{folder / 'report.json'} is incomplete ({error!r}); reconstruct again") from None
    maps = [_read_tiff(folder / name) for name in ("height.tif", "sigma.tif")]
    for name, values in zip(("height.tif", "sigma.tif"), maps, strict=True):
        if values.shape != optics.shape:
            raise InputError(f"{folder / name} is not of the size that report.json states; reconstruct again")
    heights = HeightMap(maps[0], maps[1], optics.pixel_size_um)
    return SavedSurface(folder.name, heights, optics, rotation, translation, view=view)


def _reference(content: dict[str, Any]) -> tuple[Optics, Array, Array, str]:
    """Grid, pose and name of the reference view; where the method found no poses, those that the stage stated."""
    series = content["series"]
    i, k = series["reference"], series["inverse_working_distance"]
    optics = Optics(float(series["pixel_size_um"]), int(series["width_px"]), int(series["height_px"]), float(k))
    view, poses = series["views"][i], content["poses"]
    if poses is None:
        rotation = rotations_from_tilts(np.array([view["tilt_deg"]]), series["tilt_axis_deg"])[0]
        return optics, rotation, np.zeros(3), str(view["image"])
    rotation = np.array(poses[i]["rotation_cam_from_world"], dtype=np.float64)
    translation = np.array(poses[i]["translation_um"], dtype=np.float64)
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise ValueError("a pose has the wrong shape")
    return optics, rotation, translation, str(view["image"])


def _read_tiff(path: Path) -> Array:
    import tifffile

    try:
        values = tifffile.imread(path)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; the reconstruction folder is incomplete") from None
    except Exception as error:  # a damaged TIFF can trip the parser anywhere
        raise InputError(f"{path} is a damaged TIFF ({str(error)[:80]}); write it again") from None
    if values.ndim != 2 or values.dtype.kind != "f":
        raise InputError(f"{path} holds no height map: one layer of floating-point numbers in um is needed")
    return np.asarray(values, dtype=np.float64)


def _read_map(path: Path, pixel_size_um: float | None) -> SavedSurface:
    z_um = _read_tiff(path)
    size = pixel_size_um if pixel_size_um is not None else _stated_pixel_um(path)
    if size is None:
        raise InputError(f"{path} states no pixel size in um; save it with one (ImageJ: Image > Properties)")
    optics = Optics(size, z_um.shape[1], z_um.shape[0])
    heights = HeightMap(z_um, np.full_like(z_um, np.nan), size)
    return SavedSurface(path.name, heights, optics, CAM_FROM_VIEW, np.zeros(3))


def _stated_pixel_um(path: Path) -> float | None:
    """Pixel size by the resolution and the unit that ImageJ and its kin write; None where there is no such unit."""
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        unit = (tiff.imagej_metadata or {}).get("unit", "")
        tag = tiff.pages[0].tags.get("XResolution")
    if tag is None or unit not in UNITS_UM or not tag.value[0]:
        return None
    return float(tag.value[1] / tag.value[0] * UNITS_UM[unit])


def _read_ply(path: Path) -> SavedSurface:
    import trimesh

    try:
        shape: Any = trimesh.load(path, process=False)
        vertices = np.asarray(shape.vertices, dtype=np.float64)
        faces = np.asarray(getattr(shape, "faces", np.zeros((0, 3))), dtype=np.int64)
    except Exception as error:  # its parsers raise whatever they trip over
        raise InputError(f"{path} is a damaged PLY ({str(error)[:80]}); write it again") from None
    return _cloud(path, vertices, faces if len(faces) else None)


def _read_xyz(path: Path) -> SavedSurface:
    try:
        xyz = np.loadtxt(path, dtype=np.float64, usecols=(0, 1, 2), ndmin=2)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} must hold three numbers a line, x y z in um ({str(error)[:80]})") from None
    return _cloud(path, xyz, None)


def _cloud(path: Path, xyz_um: Array, faces: NDArray[np.int64] | None) -> SavedSurface:
    finite = np.isfinite(xyz_um).all(axis=1)
    if faces is None:
        xyz_um = xyz_um[finite]
    if finite.sum() < 3:
        raise InputError(f"{path} has fewer than three points; a surface needs more")
    sigma = np.full(len(xyz_um), np.nan)
    return SavedSurface(path.name, None, None, CAM_FROM_VIEW, np.zeros(3), xyz_um, sigma, faces)


def world_points(surface: SavedSurface) -> tuple[Array, Array]:
    """Points (..., 3) in the world and their sigma (...): the pixels of a height map with NaN holes, or a cloud's."""
    if surface.heights is None or surface.optics is None:
        assert surface.vertices_um is not None
        assert surface.sigma_um is not None
        return surface.vertices_um, surface.sigma_um
    z_um = surface.heights.z_um
    rows, columns = np.indices(z_um.shape, dtype=np.float64)
    xy_px = np.stack([columns, rows], axis=-1)
    xyz = back_project(xy_px, -z_um, surface.rotation, surface.translation_um, surface.optics)
    return xyz, surface.heights.sigma_um
