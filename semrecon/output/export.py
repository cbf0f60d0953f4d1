"""The reconstruction folder: height and sigma maps, points, mesh, report and a picture, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from semrecon.data import Array
from semrecon.errors import InputError
from semrecon.folder import check_target, whole_folder
from semrecon.output.ply import write_ply
from semrecon.output.sdf import write_sdf
from semrecon.output.stl import write_stl
from semrecon.output.x3p import write_x3p
from semrecon.output.xyz import write_xyz
from semrecon.reconstruction import SCHEMA, Reconstruction, report

FILES = ("height.tif", "sigma.tif", "points.ply", "mesh.ply", "report.json", "summary.png")
RECORDING = "reconstruction.rrd"
MORE: dict[str, tuple[str, Callable[[Reconstruction, Path], None]]] = {
    "stl": ("mesh.stl", lambda result, path: write_stl(path, result.mesh)),
    "xyz": ("points.xyz", lambda result, path: write_xyz(path, result.points)),
    "sdf": ("height.sdf", lambda result, path: write_sdf(path, result.heights)),
    "x3p": ("height.x3p", lambda result, path: write_x3p(path, result.heights)),
}
"""Further formats by name, each with its file in the folder and its writer."""


def write_reconstruction(
    result: Reconstruction, out: Path | str, *, rerun: bool = False, also: Sequence[str] = ()
) -> tuple[Path, ...]:
    """Write the reconstruction folder of docs/output.md.

    Parameters
    ----------
    out
        A new or empty folder, or a former reconstruction, which is then replaced as a whole.
    rerun
        Also write a recording for the rerun viewer.
    also
        Names of further formats, of `MORE`.

    Returns
    -------
    The files written.

    Raises
    ------
    InputError
        The folder holds something else, which stays as it was, or a format is not known.
    """
    out = Path(out)
    check_formats(also)
    with whole_folder(out, is_reconstruction) as folder:
        _write_arrays(result, folder)
        for name, write in (MORE[name] for name in also):
            write(result, folder / name)
        _write_report(result, folder / "report.json")
        _write_pictures(result, folder, rerun)
        names = sorted(path.name for path in folder.iterdir())
    return tuple(out / name for name in names)


def check_out(out: Path | str) -> None:
    """Refuse an output folder that holds something else, before any work is done; raises `InputError`."""
    check_target(Path(out), is_reconstruction)


def check_formats(names: Sequence[str]) -> None:
    """Refuse a format that is not known, before any work is done; raises `InputError`."""
    for name in names:
        if name not in MORE:
            raise InputError(f"--also knows the formats {', '.join(MORE)}, with commas between, not {name!r}")


def is_reconstruction(folder: Path) -> bool:
    """Whether a folder holds a former reconstruction and nothing beside it."""
    if not {path.name for path in folder.iterdir()} <= {*FILES, RECORDING, *(name for name, _ in MORE.values())}:
        return False
    try:
        content = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == SCHEMA


def _write_arrays(result: Reconstruction, folder: Path) -> None:
    heights, points, mesh = result.heights, result.points, result.mesh
    write_map(folder / "height.tif", heights.z_um, heights.pixel_size_um)
    write_map(folder / "sigma.tif", heights.sigma_um, heights.pixel_size_um)
    x, y, z = points.xyz_um.T
    write_ply(folder / "points.ply", {"x": x, "y": y, "z": z, "sigma": points.sigma_um})
    x, y, z = mesh.vertices_um.T
    write_ply(folder / "mesh.ply", {"x": x, "y": y, "z": z}, mesh.faces)


def write_map(path: Path, values_um: Array, pixel_size_um: float) -> None:
    """Write a map as float32 TIFF, with the pixel size where ImageJ and its kin look for it."""
    import tifffile

    per_um = (1 / pixel_size_um, 1 / pixel_size_um)
    tifffile.imwrite(path, values_um.astype(np.float32), imagej=True, resolution=per_um, metadata={"unit": "um"})


def _write_report(result: Reconstruction, path: Path) -> None:
    text = json.dumps(report(result), indent=2, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")


def _write_pictures(result: Reconstruction, folder: Path, rerun: bool) -> None:
    from semrecon.output.figures import write_summary

    write_summary(result, folder / "summary.png")
    if rerun:
        from semrecon.output.recording import write_recording

        write_recording(result, folder / RECORDING)
