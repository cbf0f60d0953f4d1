"""The tilt-series folder on disk: series.toml and pictures for everybody, truth/ for the judge."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from semsim import __version__
from semsim.backscatter import BackscatterOptions
from semsim.capture import Capture
from semsim.databar import with_data_bar
from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.microscope import Pose, pixel_grid
from semsim.scene import tables
from semsim.scenes import load_scene
from semsim.surface import buffer_from_depth
from semsim.truth import GroundTruth

OURS = ("series.toml", "view_*.tif", "truth/mesh.ply", "truth/truth.npz", "truth/settings.toml")
"""Everything that a simulated series may hold."""
POSE = ("rotations", "translations_um", "distortions")
"""Arrays of truth.npz that make the poses, in the order of the fields of one."""


def write_series(capture: Capture, out_dir: str | Path, seed: int | None = None) -> Path:
    """Write a tilt series with its truth; what was there before stays untouched until the last moment.

    Parameters
    ----------
    out_dir
        New, empty, or a series that was written before, which is replaced as a whole.
    seed
        To be noted in the settings.

    Raises
    ------
    InputError
        The folder holds something else.
    """
    out = Path(out_dir).absolute()
    require_free(out)
    with _replacing(out) as folder:
        _write_views(capture, folder)
        (folder / "truth").mkdir()
        write_ply(capture.truth.mesh, folder / "truth" / "mesh.ply")
        _write_truth(capture.truth, folder / "truth" / "truth.npz")
        _write_settings(capture, folder / "truth" / "settings.toml", seed)
    return out


def require_free(out_dir: str | Path) -> None:
    """Raise InputError unless a folder can be made, is empty, or holds nothing but a series that semsim wrote."""
    out = Path(out_dir)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; give a folder for the series")
    home = next(parent for parent in out.absolute().parents if parent.exists())
    if not (home.is_dir() and os.access(home, os.W_OK)):
        raise InputError(f"{out} cannot be made, since {home} is not a folder that can be written to; give another")
    if not out.exists() or not any(out.iterdir()):
        return
    known = {path for pattern in OURS for path in out.glob(pattern)} | {out / "truth"}
    strangers = sorted(path.relative_to(out) for path in out.rglob("*") if path not in known)
    if strangers or not (out / "truth" / "settings.toml").is_file():
        what = strangers[0] if strangers else "no truth/settings.toml"
        raise InputError(f"{out} is not a series written by semsim (it has {what}); give a new or empty folder")


def read_truth(series_dir: str | Path) -> GroundTruth:
    """Read back the truth of a simulated series, to the last bit of what was written.

    Raises
    ------
    InputError
        The folder has no truth, or it cannot be read.
    """
    truth_dir = Path(series_dir) / "truth"
    if not (truth_dir / "truth.npz").is_file():
        raise InputError(f"{series_dir} holds no truth/truth.npz; it is not a series written by semsim")
    microscope = load_scene(truth_dir / "settings.toml").microscope
    mesh = read_ply(truth_dir / "mesh.ply")
    try:
        with np.load(truth_dir / "truth.npz") as stored:
            views = tuple(Pose(*pose) for pose in zip(*(stored[name] for name in POSE), strict=True))
            depths, faces = stored["depth_um"], stored["face"]
            offsets = tuple(stored["scan_offsets_px"]) if "scan_offsets_px" in stored else ()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{truth_dir / 'truth.npz'} cannot be read: {error}") from error
    beams = [pixel_grid(microscope) + offset for offset in offsets] or [None] * len(views)
    buffers = (
        buffer_from_depth(mesh, microscope, pose, depth, face, beam_px=beam)
        for pose, depth, face, beam in zip(views, depths, faces, beams, strict=True)
    )
    return GroundTruth(mesh, microscope, views, tuple(buffers), offsets)


def write_ply(mesh: Mesh, path: Path) -> None:
    """Write a mesh as binary PLY with float64 vertices, and the yield as a vertex property where there is one."""
    names = ["x", "y", "z"] + (["yield"] if mesh.vertex_yield is not None else [])
    columns = [mesh.vertices_um] + ([mesh.vertex_yield[:, None]] if mesh.vertex_yield is not None else [])
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", "comment um", f"element vertex {len(mesh.vertices_um)}"]
    lines += [f"property double {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        file.write(np.concatenate(columns, axis=1).astype("<f8").tobytes())
        file.write(faces.tobytes())


def read_ply(path: Path) -> Mesh:
    """Read a mesh that `write_ply` wrote; raises InputError for anything else."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    counts = {word[1]: int(word[2]) for word in words if word[:1] == ["element"]}
    columns = [word[2] for word in words if word[:2] == ["property", "double"]]
    vertices, faces = counts.get("vertex", 0), counts.get("face", 0)
    split = 8 * vertices * len(columns)
    if not end or columns[:3] != ["x", "y", "z"] or len(body) != split + 13 * faces:
        raise InputError(f"{path} is not a whole mesh written by semsim")
    values = np.frombuffer(body[:split], dtype="<f8").reshape(vertices, len(columns))
    corners = np.frombuffer(body[split:], dtype=[("count", "u1"), ("corners", "<i4", 3)])["corners"]
    return Mesh(values[:, :3].copy(), corners.copy(), values[:, 3].copy() if "yield" in columns else None)


def _write_views(capture: Capture, folder: Path) -> None:
    import tomli_w

    microscope, schedule = capture.scene.microscope, capture.scene.schedule
    views = [_write_view(capture, i, folder) for i in range(len(capture.images))]
    series: dict[str, Any] = {"pixel_size_um": microscope.pixel_size_um, "tilt_axis_deg": schedule.tilt_axis_deg}
    if microscope.working_distance_um is not None:
        series["working_distance_um"] = microscope.working_distance_um
    if geometry := nominal_channel_geometry(capture.scene.signal.backscatter):
        series["channel"] = geometry
    rows = capture.scene.data_bar.height_px
    note = f"# The lowest {rows} rows of every picture are a data bar: crop them.\n" if rows else ""
    (folder / "series.toml").write_text(note + tomli_w.dumps({**series, "view": views}), encoding="utf-8")


def nominal_channel_geometry(backscatter: BackscatterOptions | None) -> dict[str, dict[str, float]]:
    """Say where the segments of a backscatter detector sit, as a maker's drawing would; the whole ring has no side.

    Returns
    -------
    For each segment `azimuth_deg`, counter-clockwise from image right to its middle, and `elevation_deg`, above the
    image plane, of the middle between the inner and the outer edge of the ring.
    """
    if backscatter is None or backscatter.segments < 2:
        return {}
    elevation_deg = 90.0 - (backscatter.inner_deg + backscatter.outer_deg) / 2
    step_deg = 360.0 / backscatter.segments
    return {
        f"bse_{letter}": {
            "azimuth_deg": (backscatter.azimuth_deg + i * step_deg) % 360.0,
            "elevation_deg": elevation_deg,
        }
        for i, letter in enumerate("abcd"[: backscatter.segments])
    }


def _write_view(capture: Capture, view: int, folder: Path) -> dict[str, Any]:
    """Write the pictures of a view; return its table of series.toml, with what the stage stated and no more."""
    import tifffile

    table: dict[str, Any] = {"image": f"view_{view:02d}.tif", "tilt_deg": capture.scene.schedule.tilts_deg[view]}
    if capture.scene.schedule.shifts_um:
        table["stage_um"] = list(capture.scene.schedule.shifts_um[view])
    channels = capture.channels[view] if capture.channels else {}
    if channels:
        table["channels"] = {name: f"view_{view:02d}_{name}.tif" for name in channels}
    scene = capture.scene
    recorded = [(table["image"], capture.images[view], scene.data_bar.detector)]
    recorded += [(table["channels"][name], image, name.upper()) for name, image in channels.items()]
    for file, image, detector in recorded:
        bar = replace(scene.data_bar, detector=detector)
        picture = with_data_bar(image, bar, scene.microscope, scene.name)
        tifffile.imwrite(folder / file, picture, photometric="minisblack")
    return table


def _write_truth(truth: GroundTruth, path: Path) -> None:
    """Per view: pose, distortion, depth (float64: float32 is not the truth), triangle, scan offsets; and who sees what.

    `visibility` is [i, j, row, column]; `scan_offsets_px` is there only where the scan had errors.
    """
    views = range(len(truth))
    offsets: dict[str, Any] = {"scan_offsets_px": np.stack(truth.scan_offsets_px)} if truth.scan_offsets_px else {}
    np.savez_compressed(
        path,
        rotations=np.stack([pose.rotation for pose in truth.poses]),
        translations_um=np.stack([pose.translation_um for pose in truth.poses]),
        distortions=np.stack([pose.distortion for pose in truth.poses]),
        depth_um=np.stack([buffer.depth_um for buffer in truth.buffers]),
        face=np.stack([buffer.face for buffer in truth.buffers]),
        visibility=np.stack([np.stack([truth.visibility(i, j) for j in views]) for i in views]),
        **offsets,
    )


def _write_settings(capture: Capture, path: Path, seed: int | None) -> None:
    import tomli_w

    noted = "" if seed is None else f", noise seed {seed}"
    text = f"# The scene, as semsim {__version__} rendered it{noted}.\n" + tomli_w.dumps(tables(capture.scene))
    path.write_text(text, encoding="utf-8")


@contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """Lend a new folder beside `out` that takes its place at the end, or vanishes if anything goes wrong."""
    partial, former = (out.with_name(f".{out.name}.{os.getpid()}.{word}") for word in ("partial", "former"))
    out.parent.mkdir(parents=True, exist_ok=True)
    partial.mkdir()
    try:
        yield partial
        if out.exists():
            out.rename(former)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(former, ignore_errors=True)
