"""The surface of any other software against the truth of a scene, judged as methods are once it was aligned.

A height map on the pixels of the reference view needs no motion: a gauge is removed from its heights, as from those of
a method. Anything else (cloud, mesh, height map on another grid) is moved within stated freedoms and drawn on those
pixels, the highest surface where several overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.judging.judge import TOLERANCES_PX, Metrics, grid_um, judge
from benchmarks.judging.placing import OVERTURNED, Motion, Wanted, fitted, named, placed
from benchmarks.judging.submission import Options, Subject, TrueTarget, read_submission, to_view, to_world
from benchmarks.judging.surface_score import f_scores
from semrecon.agreement.resampling import draw_faces
from semrecon.agreement.saved import SavedSurface, is_saved_reconstruction
from semrecon.agreement.surface_alignment import Target
from semrecon.data import Array, Estimate, HeightMap, Mask, PointCloud
from semrecon.errors import InputError
from semrecon.judging.gauge import GaugeFit, gauge_fit
from semrecon.methods.base import Gauge
from semrecon.surface.meshing import mesh_from_heights
from semrecon.surface.triangles import triangulate

if TYPE_CHECKING:
    from benchmarks.scenes import SimulatedSource

EVENLY, SEED = 40_000, 1
"""Points strewn over a mesh so that large triangles count by their area, and the seed of their places."""
MUCH = 3.0
"""How many times nearer a mirror image must lie before it is spoken of."""


@dataclass(frozen=True)
class Scored:
    """A submission and its scores.

    Parameters
    ----------
    what
        What was read, in words.
    reason
        Which alignment was made, and why.
    removed
        Amounts of it, in words.
    before, after
        Scores as submitted with nothing removed, and aligned: those of `benchmarks.judging.judge`, and of a cloud or a
        mesh ``own_precision``, the share of its own points within each tolerance.
    error_um
        Aligned minus true height where it is judged, (rows, columns).
    motion
        What was done to a cloud or mesh; None where heights alone were changed.
    gauge
        Removed from the heights, at the end.
    notes
        What a reader must know beside.
    """

    name: str
    what: str
    reason: str
    removed: tuple[str, ...]
    before: Metrics
    after: Metrics
    error_um: Array
    motion: Motion | None
    gauge: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Body:
    """A surface in space: points (n, 3) um in the view frame, and triangles of them; None for a cloud."""

    points_um: Array
    faces: NDArray[np.int64] | None

    def moved(self, motion: Motion) -> _Body:
        return replace(self, points_um=motion.apply(self.points_um))


def score_submission(path: Path, subject: Subject, options: Options) -> Scored:
    """Read, align and judge the surface in a file or a reconstruction folder.

    Raises
    ------
    InputError
        The file holds no surface, or it cannot be aligned as asked.
    """
    surface = read_submission(path, subject, options)
    if surface.heights is not None and surface.heights.z_um.shape == subject.judged.shape and not options.align:
        return _on_the_pixels(surface, path, subject, options)
    if options.gauge:
        raise InputError(
            f"--gauge is for a height map on the {_size(subject.judged.shape)} pixels of the reference view, which "
            f"{path} is not; give --align instead"
        )
    return _in_space(surface, subject, options)


def _on_the_pixels(surface: SavedSurface, path: Path, subject: Subject, options: Options) -> Scored:
    """Judge heights as those of a method: by the gauge asked for, or that of the method, or an offset."""
    assert surface.heights is not None
    heights = replace(surface.heights, pixel_size_um=subject.pixel_um)
    gauge, why = _gauge(path, options)
    estimate = Estimate(heights=heights)
    fit = gauge_fit(heights.z_um, subject.true_um, gauge, _xy(subject), "absolute", narrower=False)
    reference = subject.series.views[subject.view].name
    what = f"a height map of {_size(heights.z_um.shape)}, {np.isfinite(heights.z_um).mean():.1%} of it known"
    reason = f"It stands on the pixels of the reference view, {reference}, so nothing was moved or turned; {why}."
    before = _judged(estimate, subject, ())
    after = _judged(estimate, subject, gauge)
    return Scored(
        surface.name,
        what,
        reason,
        tuple(_fit_named(fit, gauge)),
        before,
        after,
        _error(heights.z_um, subject, fit),
        None,
        gauge,
        tuple(_inside_out(heights.z_um, subject, gauge, after)),
    )


def _gauge(path: Path, options: Options) -> tuple[tuple[Gauge, ...], str]:
    """Choose what is removed from heights, and say why."""
    if options.gauge:
        asked = cast("tuple[Gauge, ...]", options.gauge)
        return asked, f"{', '.join(asked)} of its heights were removed, as asked for"
    if path.is_dir() and is_saved_reconstruction(path):
        import json

        from semrecon.methods import all_methods

        name = json.loads((path / "report.json").read_text(encoding="utf-8")).get("method")
        for method in all_methods():
            if method.name == name:
                return method.gauge, f"{', '.join(method.gauge)} removed, which {name} declares unobservable"
    return ("offset",), "a constant height was removed, since no picture tells it"


def _in_space(surface: SavedSurface, subject: Subject, options: Options) -> Scored:
    """Judge a cloud, a mesh or a map on a grid of its own, aligned in space."""
    is_map = surface.heights is not None
    body = _body(surface, subject, options)
    gauge_name = options.align or "rigid"
    either = options.frame == "unknown" and not is_map
    target = TrueTarget(subject)
    motion = Motion()
    if gauge_name != "none":
        motion = placed(_evenly(body), target, Wanted(gauge_name, either, options.mirror, body.faces is not None))
    moved = body.moved(motion)
    gauge: tuple[Gauge, ...] = () if gauge_name == "none" else ("offset",)
    estimate = _estimate(moved, subject)
    assert estimate.heights is not None
    fit = gauge_fit(estimate.heights.z_um, subject.true_um, gauge, _xy(subject), "absolute", narrower=False)
    error = _error(estimate.heights.z_um, subject, fit)
    if fit is not None:
        motion = motion.then(Motion(shift_um=np.array([0.0, 0.0, -fit.offset_um])))
        lowered = replace(estimate.heights, z_um=estimate.heights.z_um - fit.offset_um)
        estimate = replace(estimate, heights=lowered)
    kind = "a height map on a grid of its own" if is_map else ("a cloud" if body.faces is None else "a mesh")
    triangles = "" if body.faces is None else f" and {len(body.faces)} triangles"
    return Scored(
        surface.name,
        f"{kind} of {len(body.points_um)} points{triangles}, a unit taken to be {options.unit_um:g} um",
        _why(gauge_name, kind, options),
        tuple(named(motion)) if gauge_name != "none" else ("nothing",),
        _judged(_estimate(body, subject), subject, ()) | _own(body, subject),
        _judged(estimate, subject, gauge) | _own(body.moved(motion), subject),
        error,
        motion,
        gauge,
        tuple(_cautions(body, target, motion, gauge_name, options)),
    )


def _why(gauge: str, kind: str, options: Options) -> str:
    said = {
        "none": "Nothing was moved, as asked for: the frame of the file is taken to be that of the scene",
        "offset": "The frame was said to be that of the scene, so a constant height alone was removed",
        "plane": "The frame was said to be that of the scene but for a plane, which was removed from the heights",
        "rigid": f"{kind[0].upper()}{kind[1:]} does not say how it lies to the pictures, so it was moved and turned as "
        "a rigid body; its size was kept",
        "similarity": "Position, orientation and size were all fitted, as asked for, so its size is not judged",
    }
    sides = {"world": "z is to the gun", "camera": "z goes into the specimen", "unknown": "either side may be up"}
    if gauge not in ("rigid", "similarity"):
        return said[gauge] + "."
    mirror = "it might be turned inside out" if options.mirror else "a mirror image was not tried"
    return f"{said[gauge]}; {sides[options.frame]}; {mirror}."


def _body(surface: SavedSurface, subject: Subject, options: Options) -> _Body:
    """Points in the view frame of the reference view, as far as the file's frame is known."""
    if surface.heights is not None:
        assert surface.optics is not None
        mesh = mesh_from_heights(
            surface.heights, surface.rotation, surface.translation_um, surface.optics.inverse_working_distance
        )
        return _Body(to_view(mesh.vertices_um, subject), np.asarray(mesh.faces, dtype=np.int64))
    assert surface.vertices_um is not None
    points = surface.vertices_um
    in_view = points @ OVERTURNED if options.frame == "camera" else to_view(points, subject)
    return _Body(in_view, surface.faces)


def _evenly(body: _Body) -> Array:
    """Points that stand for the surface by its area, finite, (n, 3)."""
    if body.faces is None:
        return body.points_um
    corners = body.points_um[body.faces]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0:
        raise InputError("the mesh has no triangle with an area; there is no surface to judge")
    rng = np.random.default_rng(SEED)
    of = corners[rng.choice(len(corners), EVENLY, p=area / area.sum())]
    u, v = rng.uniform(size=(2, EVENLY, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(of[:, 0] + u * (of[:, 1] - of[:, 0]) + v * (of[:, 2] - of[:, 0]))


def _estimate(body: _Body, subject: Subject) -> Estimate:
    """Draw a surface on the pixels of the reference view; the points of a cloud are kept beside it."""
    shape = subject.judged.shape
    world = to_world(body.points_um, subject)
    xy_px = subject.truth.image_of(subject.view, world)
    z = np.full(shape, np.nan)
    with np.errstate(invalid="ignore"):
        faces = triangulate(xy_px) if body.faces is None else body.faces
        (z,) = draw_faces(xy_px, faces, body.points_um[:, 2:], (shape[0], shape[1]))
    heights = HeightMap(z, np.full(shape, np.nan), subject.pixel_um)
    if body.faces is not None:
        return Estimate(heights=heights)
    unknown = np.full(len(world), np.nan)
    return Estimate(PointCloud(world, np.broadcast_to(np.nan, (len(world), 3, 3)), unknown, xy_px), heights)


def _judged(estimate: Estimate, subject: Subject, gauge: Sequence[Gauge]) -> Metrics:
    return judge(estimate, subject.truth, subject.series, gauge, cast("SimulatedSource", subject))


def _own(body: _Body, subject: Subject) -> Metrics:
    """Share of points spread over the submitted surface itself that lie within each tolerance of the true mesh."""
    world = to_world(_evenly(body), subject)
    inside = world[_in_picture(world, subject)]
    true = subject.truth.buffers[subject.view].position_um[subject.judged]
    found = f_scores(inside, subject.truth, true, [subject.pixel_um * each for each in TOLERANCES_PX])
    answer = {
        f"own_{name}_{at:g}px": each[i] for at, each in zip(TOLERANCES_PX, found, strict=True) for i, name in _OWN
    }
    return answer | {"share_in_picture": len(inside) / max(len(world), 1)}


_OWN = ((0, "fscore"), (1, "precision"), (2, "recall"))


def _in_picture(world_um: Array, subject: Subject) -> Mask:
    xy = subject.truth.image_of(subject.view, world_um)
    rows, columns = subject.judged.shape
    return np.asarray(((xy >= -0.5) & (xy <= [columns - 0.5, rows - 0.5])).all(axis=1))


def _error(z_um: Array, subject: Subject, fit: GaugeFit | None) -> Array:
    if fit is None:
        return np.full(z_um.shape, np.nan)
    return fit.error(z_um, subject.true_um, _xy(subject))


def _xy(subject: Subject) -> Array:
    return grid_um(subject.judged.shape, subject.pixel_um)


def _fit_named(fit: GaugeFit | None, gauge: Sequence[str]) -> list[str]:
    """Say the amounts of a gauge."""
    if fit is None:
        return ["nothing: no height is known where the truth is"]
    said = [f"offset of {fit.offset_um:.6g} um"] if "offset" in gauge else []
    if "plane" in gauge:
        angles = np.rad2deg(np.arctan([fit.slope_x, fit.slope_y]))
        said.append(f"slope of {angles[0]:.4g} degrees along x and {angles[1]:.4g} along y")
    if {"scale", "mirror"} & set(gauge):
        said.append(f"heights multiplied by {fit.scale:.6g}")
    return said or ["nothing"]


def _inside_out(z_um: Array, subject: Subject, gauge: Sequence[Gauge], after: Metrics) -> list[str]:
    """Say so where the relief fits far better turned inside out: z the other way, or the sign of the tilts."""
    if "mirror" in gauge:
        return []
    turned = gauge_fit(-z_um, subject.true_um, gauge, _xy(subject), "absolute", narrower=False)
    if turned is None:
        return []
    left = np.abs(turned.error(-z_um, subject.true_um, _xy(subject)))
    other = float(np.nanmedian(left))
    if not other * MUCH < after["median_um"]:
        return []
    return [
        f"Turned inside out it would fit far better ({other:.3g} um instead of {after['median_um']:.3g}): its heights "
        "may be depths (--frame camera), or the tilts were taken with the wrong sign."
    ]


def _cautions(body: _Body, target: Target, motion: Motion, gauge: str, options: Options) -> list[str]:
    """Say so where the surface was overturned, or where its mirror image would fit far better."""
    said = []
    if motion.overturned and not motion.mirrored and gauge != "none":
        said.append(
            "It was turned over, as is right where its z goes into the specimen. If its z is up, say --frame world: "
            "its relief is then inside out, which a turn can hide where the specimen is symmetric."
        )
    if gauge not in ("rigid", "similarity") or options.mirror or not len(body.points_um):
        return said
    points = _evenly(body)
    here = fitted(motion.apply(points), target, "offset")
    if here is None or here[0] < target.pixel_size_um:
        return said
    try:
        mirror = placed(points, target, Wanted(gauge, options.frame == "unknown", True, body.faces is not None))
    except InputError:
        return said
    there = fitted(mirror.apply(points), target, "offset")
    if mirror.mirrored and there is not None and there[0] * MUCH < here[0]:
        said.append(
            f"Its mirror image would fit far better ({there[0]:.3g} um instead of {here[0]:.3g}): the tilts may have "
            "been taken with the wrong sign. --mirror allows it."
        )
    return said


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
