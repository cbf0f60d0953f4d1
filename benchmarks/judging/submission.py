"""What is handed in for judging, read in um, and what it is judged against."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.judging.evaluate import commonly_visible
from benchmarks.judging.placing import OVERTURNED
from semrecon.agreement.saved import SavedSurface, read_surface
from semrecon.agreement.surface_alignment import FREE, Target
from semrecon.data import Array, Mask, TiltSeries
from semrecon.errors import InputError
from semrecon.judging.gauge import GAUGES
from semsim.truth import GroundTruth

FRAMES = ("world", "camera", "unknown")
ALIGNMENTS = ("none", *FREE)
MESHES = (".stl", ".obj")
"""Read here, beside what `semrecon.agreement.saved` reads."""


@dataclass(frozen=True)
class Subject:
    """What is judged against: the truth of a scene, and the nominal series that was photographed from it.

    `judged` is what all views see of the pixels of the reference view.
    """

    name: str
    truth: GroundTruth
    series: TiltSeries
    judged: Mask

    @property
    def view(self) -> int:
        """Index of the reference view."""
        return self.series.reference

    @property
    def pixel_um(self) -> float:
        """Edge of a pixel."""
        return self.series.optics.pixel_size_um

    def judgeable(self, views: tuple[int, ...], step: int) -> Mask:  # noqa: ARG002 - the only views there are
        """Tell what all views see; the judge asks its source for it."""
        return self.judged[::step, ::step]

    @property
    def true_um(self) -> Array:
        """True heights where they are judged, (rows, columns)."""
        return np.where(self.judged, self.truth.height_map(self.view), np.nan)


@dataclass(frozen=True)
class Options:
    """How a submission is to be read and aligned.

    Parameters
    ----------
    unit_um
        Length of one unit of the file, um.
    pixel_size_um
        Of a height map on a grid of its own that states none.
    missing
        Number that a height map has where it has no height, beside NaN.
    frame
        Of a cloud or mesh: "world" has z to the gun, "camera" y down and z into the specimen, "unknown" either side
        up. Heights of a map grow towards the gun unless the frame is "camera".
    align
        One of `ALIGNMENTS`; "" is offset for what stands on the pixels of the reference view, else rigid.
    gauge
        For a map on those pixels, instead of an alignment: removed from its heights.
    mirror
        Whether the surface may be turned inside out.
    """

    unit_um: float = 1.0
    pixel_size_um: float | None = None
    missing: float | None = None
    frame: str = "unknown"
    align: str = ""
    gauge: tuple[str, ...] = ()
    mirror: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.unit_um) and self.unit_um > 0):
            raise InputError(f"--unit-um must be a positive number of micrometres, not {self.unit_um:g}")
        if self.frame not in FRAMES:
            raise InputError(f"--frame knows {', '.join(FRAMES)}, not {self.frame!r}")
        if self.align and self.align not in ALIGNMENTS:
            raise InputError(f"--align knows {', '.join(ALIGNMENTS)}, not {self.align!r}")
        if strangers := [each for each in self.gauge if each not in GAUGES]:
            raise InputError(f"--gauge knows {', '.join(GAUGES)}, not {strangers[0]!r}")
        if self.align and self.gauge:
            raise InputError("--align moves a surface and --gauge changes its heights alone; give one of them")
        if self.mirror and (self.gauge or self.align in ("none", "offset", "plane")):
            raise InputError(
                "--mirror goes with --align rigid or similarity; for a height map say --gauge offset,mirror"
            )


class TrueTarget(Target):
    """Truth on the pixels of a view whose picture may be bent: places are those at which the view records points."""

    def __init__(self, subject: Subject) -> None:
        optics = subject.series.optics
        height_map = subject.truth.height_map(subject.view)
        super().__init__(height_map, optics.pixel_size_um, optics.inverse_working_distance)
        object.__setattr__(self, "subject", subject)

    def places(self, xyz_um: Array) -> Array:
        """Pixel (column, row) at which points of the view frame are seen, (n, 2)."""
        subject: Subject = getattr(self, "subject")  # noqa: B009 - a frozen parent has no such field
        return subject.truth.image_of(subject.view, to_world(xyz_um, subject))


def subject_of(name: str, truth: GroundTruth, series: TiltSeries) -> Subject:
    """Make what is judged against from truth and the nominal series."""
    view = series.reference
    judged = commonly_visible(truth, view, [each for each in range(len(series)) if each != view])
    return Subject(name, truth, series, judged)


def to_world(xyz_um: Array, subject: Subject) -> Array:
    """Take points from the view frame of the reference view to the world, (..., 3)."""
    pose = subject.truth.poses[subject.view]
    return np.asarray((xyz_um * [1.0, -1.0, -1.0] - pose.translation_um) @ pose.rotation)


def to_view(xyz_um: Array, subject: Subject) -> Array:
    """Take points from the world to the view frame of the reference view, (..., 3)."""
    pose = subject.truth.poses[subject.view]
    return np.asarray((xyz_um @ pose.rotation.T + pose.translation_um) * [1.0, -1.0, -1.0])


def read_submission(path: Path, subject: Subject, options: Options) -> SavedSurface:
    """Read a surface in um; a TIFF of the size of the pictures needs no pixel size."""
    kind = path.suffix.lower()
    if not path.is_dir() and kind in MESHES:
        return _scaled(_read_mesh(path), options)
    if not path.is_dir() and kind in (".tif", ".tiff"):
        surface = read_surface(path, options.pixel_size_um or subject.pixel_um)
        assert surface.heights is not None
        if surface.heights.z_um.shape != subject.judged.shape:
            surface = read_surface(path, options.pixel_size_um)
        return _scaled(surface, options)
    if path.exists() and not path.is_dir() and kind not in (".ply", ".xyz", ".txt", ".asc"):
        raise InputError(f"{path} is no surface that is read here; give PLY, STL, OBJ, XYZ, TIFF or a reconstruction")
    return _scaled(read_surface(path), options)


def _read_mesh(path: Path) -> SavedSurface:
    import trimesh

    try:
        shape: Any = trimesh.load(path, process=True, force="mesh")  # STL repeats the corners of every triangle
        vertices, faces = np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int64)
    except Exception as error:  # its parsers raise whatever they trip over
        raise InputError(f"{path} is missing or damaged ({str(error)[:80]}); write it again") from None
    if not len(faces):
        raise InputError(f"{path} has no triangle; give a mesh, or the points as PLY or XYZ")
    nothing = np.full(len(vertices), np.nan)
    return SavedSurface(path.name, None, None, OVERTURNED, np.zeros(3), vertices, nothing, faces)


def _scaled(surface: SavedSurface, options: Options) -> SavedSurface:
    """Turn units into um; in a map set what stands for missing to NaN, and depths to heights."""
    if surface.heights is None:
        assert surface.vertices_um is not None
        return replace(surface, vertices_um=surface.vertices_um * options.unit_um)
    z = surface.heights.z_um
    z = np.where(np.isfinite(z) & (z != options.missing), z, np.nan)
    if not np.isfinite(z).any():
        raise InputError(f"{surface.name} has no height at all; there is nothing to judge")
    z = z * options.unit_um * (-1.0 if options.frame == "camera" else 1.0)
    return replace(surface, heights=replace(surface.heights, z_um=z))
