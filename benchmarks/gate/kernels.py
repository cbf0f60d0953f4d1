"""The kernels that are guarded, each on a problem whose answer is known.

What a kernel is to find comes from a formula or from the simulator's projection, never from the code that is tried, so
that a sign that is wrong on both sides cannot cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.gate.commitment import Figures
from benchmarks.running.runner import seed_of
from semrecon.adjustment import refinement
from semrecon.clouds import icp as registration
from semrecon.data import Array, Optics, PointCloud, Poses, Tracks
from semrecon.dense import surface
from semrecon.dense.pictures import Level
from semrecon.dense.sightlines import sightlines
from semrecon.geometry import centred_um, rotations_from_tilts
from semrecon.judging.metrics import relative_rotation_error_deg
from semrecon.matches import semiglobal
from semrecon.points import translation, triangulation
from semsim import zbuffer
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses, project
from semsim.specimens import Sphere

SCENE = "kernels"
REPETITIONS = 4
MICROSCOPE = Microscope(0.147, 854, 640)
OPTICS = Optics(0.147, 854, 640)
NOISE_PX = 0.3
AXIS_DEG = 20.0
"""Of the tilt: neither rows nor columns, so that both coordinates count."""


@dataclass(frozen=True)
class Trial:
    """A problem made ready: the call, which may be repeated, and what its answer is worth."""

    call: Callable[[], Any]
    judge: Callable[[Any], Figures]


@dataclass(frozen=True)
class Kernel:
    """A kernel under guard: the problem that a generator makes for it, and the reference beside which it is timed."""

    name: str
    reference: str
    prepare: Callable[[np.random.Generator], Trial]

    def trial(self, repetition: int) -> Trial:
        """Problem of one repetition."""
        return self.prepare(np.random.default_rng(seed_of(f"{SCENE}/{self.name}", repetition)))

    def figures(self, repetitions: int) -> list[Figures]:
        """Accuracy in every repetition."""
        trials = (self.trial(each) for each in range(repetitions))
        return [trial.judge(trial.call()) for trial in trials]


def cloud(rng: np.random.Generator, points: int) -> Array:
    """Points in a box that all views see, um, (points, 3)."""
    return np.asarray(rng.uniform(-1, 1, (points, 3)) * [55.0, 40.0, 20.0])


def sightings(xyz_um: Array, tilts_deg: tuple[float, ...], shifts_um: Array) -> Array:
    """Where the simulator says that views see points, px, (points, views, 2)."""
    schedule = TiltSchedule(tilts_deg, AXIS_DEG, tuple((float(x), float(y)) for x, y in shifts_um))
    return np.stack([project(MICROSCOPE, pose, xyz_um) for pose in poses(schedule)], axis=1)


def triangulating(rng: np.random.Generator, noise_px: float) -> Trial:
    """Intersect beams of five known poses: error along the beam, in the plane, and beside what the covariance says."""
    tilts = (-6.0, -3.0, 0.0, 3.0, 6.0)
    xyz, shifts = cloud(rng, 4000), rng.uniform(-3, 3, (5, 2))
    xy = sightings(xyz, tilts, shifts)
    tracks = Tracks(xy + noise_px * rng.standard_normal(xy.shape))
    known = Poses(rotations_from_tilts(np.array(tilts), AXIS_DEG), np.pad(shifts, ((0, 0), (0, 1))))

    def judge(found: PointCloud) -> Figures:
        error = found.xyz_um - xyz
        figures = {
            "depth_bias_um": float(error[:, 2].mean()),
            "depth_rms_um": float(np.sqrt(np.mean(error[:, 2] ** 2))),
        }
        figures["plane_rms_um"] = float(np.sqrt(np.mean(error[:, :2] ** 2)))
        if noise_px:
            sigma = np.sqrt(found.covariance_um2[:, 2, 2])
            figures["depth_rms_by_sigma"] = float(np.sqrt(np.mean((error[:, 2] / sigma) ** 2)))
        return figures

    return Trial(lambda: triangulation.triangulate(tracks, known, OPTICS, sigma_px=noise_px or 1.0, reference=2), judge)


def translating(rng: np.random.Generator) -> Trial:
    """Find translation and depths of a pair from matches with noise, a twentieth of them wrong."""
    xyz, shift = cloud(rng, 20_000), rng.uniform(-3, 3, 2)
    xy = sightings(xyz, (0.0, 3.0), np.array([[0.0, 0.0], shift]))
    xy += NOISE_PX * rng.standard_normal(xy.shape)
    wrong = slice(0, len(xyz) // 20)
    xy[wrong, 1] += rng.uniform(-20, 20, xy[wrong, 1].shape)
    first, second = (centred_um(xy[:, view], OPTICS) for view in range(2))
    rotations = rotations_from_tilts(np.array([0.0, 3.0]), AXIS_DEG)

    def judge(found: translation.PairTranslation) -> Figures:
        depth = -xyz[:, 2]  # into the specimen
        error = found.depth_um - depth
        slope = np.polyfit(depth[wrong.stop :], found.depth_um[wrong.stop :], 1)[0]
        across = np.array([-found.parallax[1], found.parallax[0]]) / np.linalg.norm(found.parallax)
        return {
            "depth_median_um": float(np.median(np.abs(error - np.median(error)))),
            "depth_scale": float(slope),
            "across_error_um": abs(float((found.translation_um - shift) @ across)),
        }

    return Trial(lambda: translation.solve_closed_form(first, second, rotations[1] @ rotations[0].T), judge)


def adjusting(rng: np.random.Generator) -> Trial:
    """Refine nine views whose tilts the stage states to a tenth of a degree."""
    stated = np.linspace(-24.0, 24.0, 9)
    true = stated + np.where(stated == 0, 0.0, rng.normal(0, 0.1, 9))
    xyz = cloud(rng, 1500)
    xy = sightings(xyz, tuple(map(float, true)), rng.uniform(-3, 3, (9, 2)))
    tracks = Tracks(xy + NOISE_PX * rng.standard_normal(xy.shape))

    def judge(found: refinement.Refinement) -> Figures:
        known = np.isfinite(found.points.xyz_um[:, 2])
        height, true_height = found.points.xyz_um[known, 2], xyz[known, 2]
        steps = np.diff(found.tilts_deg) - np.diff(true)
        return {
            "depth_rms_um": float(np.std(height - true_height)),
            "depth_scale": float(np.polyfit(true_height, height, 1)[0]),
            "tilt_step_rms_deg": float(np.sqrt(np.mean(steps**2))),
            "sigma_px": found.sigma_px,
            "points": float(known.sum()),
        }

    return Trial(lambda: refinement.refine(tracks, stated, OPTICS, tilt_axis_deg=AXIS_DEG), judge)


Paint = Callable[[Array, Array], Array]
"""Grey value at places (x, y), px."""


def paint(rng: np.random.Generator) -> Paint:
    """Sum of waves of 5 to 20 px, of standard deviation 1: a texture that is known between the pixels too."""
    angle, length, phase = rng.uniform(0, np.pi, 40), rng.uniform(5, 20, 40), rng.uniform(0, 2 * np.pi, 40)
    kx, ky = 2 * np.pi / length * np.cos(angle), 2 * np.pi / length * np.sin(angle)

    def grey(x: Array, y: Array) -> Array:
        waves = (np.sin(a * x + b * y + c) for a, b, c in zip(kx, ky, phase, strict=True))
        return np.asarray(sum(waves) / np.sqrt(20))

    return grey


def matching_rows(rng: np.random.Generator) -> Trial:
    """Match the rows of a slanted plane whose disparity runs from 2 to 10 px."""
    grey, (rows, columns) = paint(rng), np.mgrid[0:160, 0:240].astype(float)
    slope, least = 8.0 / 240, 2.0
    pictures = [grey(columns, rows), grey((columns + least) / (1 - slope), rows)]
    left, right = ((each + 0.1 * rng.standard_normal(each.shape)).astype(np.float32) for each in pictures)
    options = semiglobal.SemiGlobalOptions()

    def judge(found: semiglobal.Disparities) -> Figures:
        error = (found.values_px - (least + slope * columns))[10:-10, 20:-10]
        known = np.isfinite(error)
        return {
            "disparity_bias_px": float(error[known].mean()),
            "disparity_rms_px": float(np.sqrt(np.mean(error[known] ** 2))),
            "completeness": float(known.mean()),
        }

    return Trial(lambda: semiglobal.match_rows(left, right, 12, options), judge)


def sweeping(rng: np.random.Generator) -> Trial:
    """Sweep three views of a slope of a quarter, tilted about the image's y axis, and aggregate."""
    slope, tilts, shape = 0.25, np.array([-8.0, 0.0, 8.0]), (96, 128)
    grey, (rows, columns) = paint(rng), np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    x = columns - (shape[1] - 1) / 2
    # seen at x' = x cos + z sin, with z = slope x
    stretch = [np.cos(tilt) + slope * np.sin(tilt) for tilt in np.deg2rad(tilts)]
    pictures = [(grey(x / each, rows) + 0.2 * rng.standard_normal(shape)).astype(np.float32) for each in stretch]
    levels = [Level(each, np.ones(shape, dtype=bool)) for each in pictures]
    optics, still = Optics(1.0, shape[1], shape[0]), np.tile(np.eye(2), (3, 1, 1))
    lines = sightlines(Poses(rotations_from_tilts(tilts), np.zeros((3, 3))), still, optics, 1)

    def judge(found: Array) -> Figures:
        error = (found - slope * x)[10:-10, 10:-10]
        known = error[np.isfinite(error)]
        return {
            "height_median_px": float(np.median(np.abs(known))),
            "height_bias_px": float(np.median(known)),
            "completeness": float(np.mean(np.isfinite(error))),
        }

    return Trial(lambda: surface.wide_sweep(levels, lines, (-20.0, 20.0), 0.04, surface.SweepOptions()), judge)


def drawing(rng: np.random.Generator) -> Trial:
    """Draw a ball beside the tilt axis as the simulator does, against the ball's formula."""
    radius, tilt, size = 20.0, np.deg2rad(25.0), 0.3
    ball, at = Sphere(radius_um=radius, subdivisions=5)(rng), rng.uniform(5, 8, 3)
    mesh = Mesh(ball.vertices_um - ball.vertices_um.mean(axis=0) + at, ball.faces)
    microscope, pose = Microscope(size, 240, 180), poses(TiltSchedule((25.0,)))[0]
    centre = at[0] * np.cos(tilt) + at[2] * np.sin(tilt), at[1], at[2] * np.cos(tilt) - at[0] * np.sin(tilt)
    rows, columns = np.mgrid[0:180, 0:240].astype(float)
    square = radius**2 - ((columns - 119.5) * size - centre[0]) ** 2 - ((89.5 - rows) * size - centre[1]) ** 2
    above = centre[2] + np.sqrt(np.where(square > 0, square, np.nan))

    def judge(found: tuple[Array, Any]) -> Figures:
        error = -found[0] - above
        well = square > (radius / 4) ** 2  # the rim, where facets and ball part, apart
        return {
            "depth_bias_um": float(error[well].mean()),
            "depth_rms_um": float(np.sqrt(np.mean(error[well] ** 2))),
            "area": float(np.mean(np.isfinite(found[0]))),
        }

    return Trial(lambda: zbuffer.rasterise(mesh, microscope, pose), judge)


def registering(rng: np.random.Generator) -> Trial:
    """Register a relief turned by three degrees, point to point; half the points are new."""
    xy = rng.uniform(-50, 50, (3000, 2))
    z = 20 * np.cos(xy[:, 0] / 30) * np.cos(xy[:, 1] / 25) + 0.3 * rng.standard_normal(len(xy))
    turn = np.deg2rad(3.0)
    rotation = np.array([[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]])
    every = np.column_stack([xy, z])
    clouds = [
        PointCloud(each, np.zeros((len(each), 3, 3)), each[:, 2], each[:, :2]) for each in (every[:2000], every[1000:])
    ]
    moving = replace(clouds[0], xyz_um=clouds[0].xyz_um @ rotation.T)

    def judge(found: registration.Registration) -> Figures:
        return {"rre_deg": relative_rotation_error_deg(rotation.T, found.rotation), "rmse_um": found.rmse_um}

    return Trial(lambda: registration.icp(moving, clouds[1]), judge)


KERNELS = (
    Kernel("triangulation of exact matches", "arrays", lambda rng: triangulating(rng, 0.0)),
    Kernel("triangulation", "arrays", lambda rng: triangulating(rng, NOISE_PX)),
    Kernel("translation", "arrays", translating),
    Kernel("bundle adjustment", "arrays", adjusting),
    Kernel("semi-global matching", "loops", matching_rows),
    Kernel("plane sweep", "loops", sweeping),
    Kernel("raster buffer", "loops", drawing),
    Kernel("ICP", "arrays", registering),
)
