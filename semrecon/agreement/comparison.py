"""Two surfaces of one specimen against each other: where they agree, and by how much more than their sigmas say.

Uses: even views against odd views of a series, registration against global poses, two methods, yesterday against
today. The second surface is drawn on the pixel grid of the first, after an alignment within declared freedoms.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from semrecon.agreement.resampling import draw_faces, draw_grid
from semrecon.agreement.saved import SavedSurface, read_surface, world_points
from semrecon.agreement.surface_alignment import FREE, SHIFTS, Alignment, Target, align, find_shift
from semrecon.data import Array, Optics
from semrecon.errors import InputError
from semrecon.folder import check_target, whole_folder
from semrecon.geometry import CAM_FROM_VIEW, project
from semrecon.output.export import write_map
from semrecon.reconstruction import jsonable
from semrecon.surface.triangles import triangulate

SCHEMA = "semrecon.agreement.comparison/1"
FILES = ("difference.tif", "comparison.json", "comparison.png")
MOST_ASKED = 60_000
"""Points of the second surface that take part in the alignment, evenly spread; seven numbers need no more."""
LEAST_PIXELS = 30


@dataclass(frozen=True)
class Comparison:
    """Two surfaces on the pixel grid of the first.

    Parameters
    ----------
    first, second
        Their names.
    alignment
        What was done to the second before comparing, and why.
    first_um, second_um
        Heights along the beam of the first's reference view, (rows, columns); the second aligned and resampled.
    sigma_um
        Of the difference, from the sigmas of both as if their errors were independent; NaN where either is unknown.
    pixel_size_um
        Of the grid.
    share_of_first, share_of_second
        Part of the measured pixels (or points) of each that was compared.
    """

    first: str
    second: str
    alignment: Alignment
    first_um: Array
    second_um: Array
    sigma_um: Array
    pixel_size_um: float
    share_of_first: float
    share_of_second: float

    @property
    def difference_um(self) -> Array:
        """Second minus first, (rows, columns); NaN where either is missing."""
        return self.second_um - self.first_um

    @property
    def compared(self) -> int:
        """How many pixels were compared."""
        return int(np.isfinite(self.difference_um).sum())

    @property
    def normalised(self) -> Array:
        """Difference over its sigma where that is known, (n,)."""
        values = self.difference_um / np.where(self.sigma_um > 0, self.sigma_um, np.nan)
        return np.asarray(values[np.isfinite(values)])

    def quantile_um(self, share: float) -> float:
        """Absolute difference that this share of the compared pixels does not exceed."""
        size = np.abs(self.difference_um)
        return float(np.quantile(size[np.isfinite(size)], share))

    @property
    def penalised_median_um(self) -> float:
        """Median over all pixels that either surface has, one that the other lacks counted as infinitely wrong."""
        either = np.isfinite(self.first_um) | np.isfinite(self.second_um)
        size = np.where(np.isfinite(self.difference_um), np.abs(self.difference_um), np.inf)[either]
        return float(np.partition(size, size.size // 2)[size.size // 2])

    @property
    def rms_um(self) -> float:
        """Root mean square difference."""
        return float(np.sqrt(np.nanmean(self.difference_um**2)))

    def within(self, sigmas: float) -> float:
        """Share of the compared pixels whose difference is within so many sigmas; NaN where no sigma is stated."""
        values = self.normalised
        return float(np.mean(np.abs(values) <= sigmas)) if values.size else math.nan

    def __str__(self) -> str:
        """Say it in a few lines."""
        agree = (
            f"{self.within(1):.0%} within 1 sigma of both together (68% expected), {self.within(2):.0%} within 2 (95%)"
        )
        return "\n".join(
            [
                f"{self.second} against {self.first}: median |difference| {self.quantile_um(0.5):.3g} um, rms "
                f"{self.rms_um:.3g} um, 68% within {self.quantile_um(0.68):.3g} um, 95% within "
                f"{self.quantile_um(0.95):.3g} um",
                agree if self.normalised.size else "not both state a sigma",
                f"compared {self.compared} pixels: {self.share_of_first:.1%} of {self.first}, "
                f"{self.share_of_second:.1%} of {self.second}",
                f"aligned: {self.alignment}; {self.alignment.reason}",
            ]
        )


def compare(
    first: Path | str | SavedSurface,
    second: Path | str | SavedSurface,
    *,
    gauge: str = "offset",
    pixel_size_um: float | None = None,
) -> Comparison:
    """Compare two surfaces.

    Parameters
    ----------
    first, second
        Reconstruction folders, PLY or XYZ files in um, 32 bit TIFF height maps in um, or surfaces read before. Their
        frames are those of their poses. The first gives the grid, so it must be a height map.
    gauge
        What is taken away before they are compared: "offset" of heights; "plane", a slope as well; "rigid", any motion;
        "similarity", a change of size as well. Where the reference views differ or are unknown, nothing states how the
        specimen was shifted between them, so a shift in the image plane is free in any case.
    pixel_size_um
        Of TIFF files that state none.

    Raises
    ------
    InputError
        A path holds no surface, the gauge is not known, the first has no grid, or the two do not overlap.
    """
    if gauge not in FREE:
        raise InputError(f"--gauge knows {', '.join(FREE)}, not {gauge!r}")
    a, b = (_read(one, pixel_size_um) for one in (first, second))
    if a.heights is None or a.optics is None:
        raise InputError(f"{a.name} has no pixel grid to compare on; give a reconstruction or a height map first")
    xyz, sigma = world_points(b)
    points = _in_view(xyz, a)
    alignment = _aligned(points, a, b, gauge)
    moved = alignment.apply(points)
    drawn, sigma_b = _drawn(moved, sigma, a.optics, b)
    if _same_grid(a, b) and alignment.lifts_only:
        assert b.heights is not None
        drawn, sigma_b = b.heights.z_um + alignment.offset_um, b.heights.sigma_um  # to the last bit
    return _settled(a, b, alignment, drawn, sigma_b, moved)


def _settled(
    a: SavedSurface, b: SavedSurface, alignment: Alignment, drawn_um: Array, sigma_um: Array, moved_um: Array
) -> Comparison:
    """Take away what is left of the median difference, and count what was compared."""
    assert a.heights is not None
    assert a.optics is not None
    difference = drawn_um - a.heights.z_um
    compared = np.isfinite(difference)
    if compared.sum() < LEAST_PIXELS:
        raise InputError(f"{a.name} and {b.name} overlap in {int(compared.sum())} pixels; nothing can be compared")
    rest = float(np.median(difference[compared]))
    alignment = replace(alignment, shift_um=alignment.shift_um - [0.0, 0.0, rest])
    return Comparison(
        _label(a, b, 0),
        _label(a, b, 1),
        alignment,
        a.heights.z_um,
        drawn_um - rest,
        np.sqrt(a.heights.sigma_um**2 + sigma_um**2),
        a.heights.pixel_size_um,
        float(compared.sum() / np.isfinite(a.heights.z_um).sum()),
        _share(moved_um, compared, a.optics),
    )


def _read(one: Path | str | SavedSurface, pixel_size_um: float | None) -> SavedSurface:
    surface = one if isinstance(one, SavedSurface) else read_surface(one, pixel_size_um)
    if surface.heights is not None and not np.isfinite(surface.heights.z_um).any():
        raise InputError(f"{surface.name} has no height at all; there is nothing to compare")
    return surface


def _label(a: SavedSurface, b: SavedSurface, which: int) -> str:
    """Name a surface; of equal names, which one it is."""
    return (a, b)[which].name if a.name != b.name else f"{a.name} ({('first', 'second')[which]})"


def _in_view(xyz_um: Array, a: SavedSurface) -> Array:
    """World points in the view frame of the reference view of a surface (x right, y up, z to the gun)."""
    return np.asarray((xyz_um @ a.rotation.T + a.translation_um) @ CAM_FROM_VIEW)


def _target(a: SavedSurface) -> Target:
    assert a.heights is not None
    assert a.optics is not None
    return Target(a.heights.z_um, a.heights.pixel_size_um, a.optics.inverse_working_distance)


def _aligned(points_um: Array, a: SavedSurface, b: SavedSurface, gauge: str) -> Alignment:
    """Fit what the gauge leaves free; an unknown shift is searched first, and kept if it fits better."""
    free, reason = _freedoms(a, b, gauge)
    flat = points_um.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    asked = flat[:: max(1, len(flat) // MOST_ASKED)]
    target, start = _target(a), Alignment(gauge, free, reason)
    if set(SHIFTS) <= set(free) and not _same_frame(a, b):
        start = find_shift(asked, target, start)
    return align(asked, target, start)


def _freedoms(a: SavedSurface, b: SavedSurface, gauge: str) -> tuple[tuple[str, ...], str]:
    """Say what is free, and a sentence why."""
    free = FREE[gauge]
    why = "heights are known up to a constant" if gauge == "offset" else f"gauge {gauge} was asked for"
    if _same_frame(a, b):
        return free, f"{why}; both stand on {a.view or 'the same grid'}"
    known = (
        f"{a.view} and {b.view} are different reference views" if a.view and b.view else "a reference view is unknown"
    )
    free = (*free, *(name for name in SHIFTS if name not in free))
    return free, f"{why}; {known}, and nobody states the shift between them, so it was fitted"


def _same_frame(a: SavedSurface, b: SavedSurface) -> bool:
    """Whether the images of both say where the middle of the picture is: one reference view, or maps of one grid."""
    if a.view or b.view:
        return a.view == b.view
    return _same_grid(a, b)


def _same_grid(a: SavedSurface, b: SavedSurface) -> bool:
    return (
        a.optics == b.optics
        and a.optics is not None
        and a.view == b.view
        and np.array_equal(a.rotation, b.rotation)
        and np.array_equal(a.translation_um, b.translation_um)
    )


def _camera(points_um: Array, optics: Optics) -> Array:
    """Project points of the view frame, (..., 2)."""
    return project(points_um, CAM_FROM_VIEW, np.zeros(3), optics)


def _drawn(points_um: Array, sigma_um: Array, optics: Optics, b: SavedSurface) -> tuple[Array, Array]:
    """Heights and sigma of the second surface on the first one's grid; sigma is taken over along the slanted beam."""
    xy_px, values = _camera(points_um, optics), np.stack([points_um[..., 2], sigma_um], axis=-1)
    if b.heights is not None:
        height, sigma = draw_grid(xy_px, values, optics.shape)
        return height, sigma
    faces = triangulate(xy_px) if b.faces is None else b.faces
    height, sigma = draw_faces(xy_px, faces, values, optics.shape)
    return height, sigma


def _share(moved_um: Array, compared: Array, optics: Optics) -> float:
    """Part of the second surface's points that fall on a compared pixel."""
    points = moved_um.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    column, row = np.rint(_camera(points, optics)).astype(np.int64).T
    inside = (column >= 0) & (column < optics.width_px) & (row >= 0) & (row < optics.height_px)
    return float(compared[row[inside], column[inside]].sum() / max(len(points), 1))


def comparison_report(comparison: Comparison) -> dict[str, Any]:
    """Put a comparison into numbers and short words, ready for strict JSON."""
    done = comparison.alignment
    content = {
        "schema": SCHEMA,
        "first": comparison.first,
        "second": comparison.second,
        "alignment": {
            "gauge": done.gauge,
            "free": done.free,
            "reason": done.reason,
            "offset_um": done.offset_um,
            "shift_um": done.shift_um[:2],
            "tilt_deg": done.tilt_deg,
            "turn_deg": done.turn_deg,
            "scale": done.scale,
            "slope": done.slope,
            "rotation": done.rotation,
            "pivot_um": done.pivot_um,
        },
        "difference": {
            "median_abs_um": comparison.quantile_um(0.5),
            "rms_um": comparison.rms_um,
            "p68_um": comparison.quantile_um(0.68),
            "p95_um": comparison.quantile_um(0.95),
            "penalised_median_abs_um": comparison.penalised_median_um,
        },
        "normalised": {"within_1_sigma": comparison.within(1), "within_2_sigma": comparison.within(2)},
        "compared": {
            "pixels": comparison.compared,
            "share_of_first": comparison.share_of_first,
            "share_of_second": comparison.share_of_second,
        },
    }
    plain = jsonable(content)
    assert isinstance(plain, dict)
    return plain


def write_comparison(comparison: Comparison, out: Path | str) -> tuple[Path, ...]:
    """Write difference map, numbers and a picture into a folder, whole or not at all.

    Raises
    ------
    InputError
        The folder holds something else than a former comparison.
    """
    from semrecon.agreement.comparison_figure import write_figure

    out = Path(out)
    with whole_folder(out, is_comparison) as folder:
        write_map(folder / "difference.tif", comparison.difference_um, comparison.pixel_size_um)
        text = json.dumps(comparison_report(comparison), indent=2, allow_nan=False, ensure_ascii=False)
        (folder / "comparison.json").write_text(text + "\n", encoding="utf-8")
        write_figure(comparison, folder / "comparison.png")
    return tuple(out / name for name in sorted(FILES))


def check_comparison_out(out: Path | str) -> None:
    """Refuse an output folder that holds something else, before any work is done; raises `InputError`."""
    check_target(Path(out), is_comparison)


def is_comparison(folder: Path) -> bool:
    """Whether a folder holds a former comparison and nothing beside it."""
    if not {path.name for path in folder.iterdir()} <= set(FILES):
        return False
    try:
        content = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == SCHEMA
