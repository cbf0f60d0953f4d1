"""The recipe: specimen, poses, surface, signal, spot, counting, grey levels. The only file that knows the order.

Two halves. `prepare` does what is the same in every repetition and costs most; `expose` adds what chance adds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from semsim.detector import (
    DetectorOptions,
    Image,
    blur_by_spot,
    contrasts,
    count_electrons,
    digitise,
)
from semsim.mesh import Array
from semsim.microscope import poses
from semsim.scene import Scene
from semsim.signal import electron_rate
from semsim.surface import Backend, surface_buffer
from semsim.truth import GroundTruth

Seed: TypeAlias = int | np.random.SeedSequence | np.random.Generator
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what was just finished, how many steps are done, and how many there are."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """A scene as far as chance has no part in it.

    Parameters
    ----------
    scene
        What was asked for.
    truth
        Mesh, true poses and the surface under each pixel.
    rates
        Per view, relative electrons per incident electron before the spot blurs them, (rows, columns).
    """

    scene: Scene
    truth: GroundTruth
    rates: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Capture:
    """A simulated tilt series.

    Parameters
    ----------
    images
        Per view, grey levels (rows, columns), uint8 or uint16.
    scene, truth
        What was photographed, how, and what is true of it.
    """

    images: tuple[Image, ...]
    scene: Scene
    truth: GroundTruth


def simulate(
    scene: Scene,
    seed: Seed,
    surfaces: Surfaces | None = None,
    progress: Progress | None = None,
    backend: Backend = "raycast",
) -> Capture:
    """Photograph a scene.

    Parameters
    ----------
    seed
        Of the noise; the same seed gives the same bits. A generator is spawned from and moves on.
    surfaces
        Of the same scene, prepared before.
    progress
        Told after each step.

    Raises
    ------
    InputError
        The scene cannot be photographed as it stands.
    """
    surfaces = surfaces or prepare(scene, progress, backend)
    return Capture(expose(surfaces, seed, scene.detector), scene, surfaces.truth)


def prepare(scene: Scene, progress: Progress | None = None, backend: Backend = "raycast") -> Surfaces:
    """Make the mesh, find the surface in every view, and work out the noise-free signal."""
    report = _steps(progress, 1 + 2 * len(scene.schedule.tilts_deg))
    mesh = scene.specimen(np.random.default_rng(scene.specimen_seed))
    report("specimen")
    views, buffers, rates = poses(scene.schedule), [], []
    for i, pose in enumerate(views):
        buffers.append(surface_buffer(mesh, scene.microscope, pose, backend))
        report(f"surface of view {i}")
        rates.append(electron_rate(buffers[i], pose, scene.signal, mesh, scene.microscope))
        report(f"signal of view {i}")
    truth = GroundTruth(mesh, scene.microscope, views, tuple(buffers))
    return Surfaces(scene, truth, tuple(rates))


def expose(surfaces: Surfaces, seed: Seed, detector: DetectorOptions | None = None) -> tuple[Image, ...]:
    """Take one set of micrographs of prepared surfaces.

    Parameters
    ----------
    seed
        Each view draws from a child of its own, so that neither order nor number of the others matters.
    detector
        Instead of the scene's: another dose, spot or contrast of the same surfaces.
    """
    options = detector or surfaces.scene.detector
    expected = [options.dose_e * blur_by_spot(rate, options.spot_sigma_px) for rate in surfaces.rates]
    children = np.random.default_rng(seed).spawn(len(expected))
    electrons = [
        count_electrons(view, options.read_noise_e, child) for view, child in zip(expected, children, strict=True)
    ]
    return tuple(
        digitise(view, contrast, options.bits)
        for view, contrast in zip(electrons, contrasts(expected, options), strict=True)
    )


def _steps(progress: Progress | None, total: int) -> Callable[[str], None]:
    """Count the steps for whoever watches."""
    done = 0

    def report(finished: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(finished, done, total)

    return report
