"""The recipe: specimen, poses, surface, signal, spot, counting, grey levels. The only file that knows the order.

Two halves. `prepare` does what is the same in every repetition and costs most; `expose` adds what chance adds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from semsim.charging import charged
from semsim.detector import (
    Contrast,
    DetectorOptions,
    Image,
    contrasts,
    count_electrons,
    digitise,
    expected_electrons,
    random_children,
)
from semsim.mesh import Array
from semsim.microscope import Pose, pixel_grid, poses
from semsim.scan import scan_offsets
from semsim.scene import Scene
from semsim.signal import electron_rates
from semsim.spot import SpotOptions, blur_by_spot
from semsim.surface import Backend, SurfaceBuffer, surface_buffer
from semsim.truth import GroundTruth

Seed: TypeAlias = int | np.random.SeedSequence | np.random.Generator
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what was just finished, how many steps are done, and how many there are."""

MAIN, RING, SEGMENT = "se", "bse", "bse_"
"""The channel that is the image of a view; that of a whole backscatter detector; and how those of its parts begin."""


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
        Per view, by channel ("se" first), relative electrons per incident electron before the spot blurs them,
        (rows, columns).
    """

    scene: Scene
    truth: GroundTruth
    rates: tuple[Mapping[str, Array], ...]


@dataclass(frozen=True, eq=False)
class Capture:
    """A simulated tilt series.

    Parameters
    ----------
    images
        Per view, the secondary-electron image: grey levels (rows, columns), uint8 or uint16.
    scene, truth
        What was photographed, how, and what is true of it.
    channels
        Per view, the images of the other detectors by name, recorded in the same scan; empty where there are none.
    """

    images: tuple[Image, ...]
    scene: Scene
    truth: GroundTruth
    channels: tuple[Mapping[str, Image], ...] = ()


def simulate(
    scene: Scene,
    seed: Seed,
    surfaces: Surfaces | None = None,
    progress: Progress | None = None,
    backend: Backend = "auto",
) -> Capture:
    """Photograph a scene.

    Parameters
    ----------
    seed
        Of the noise; the same seed gives the same bits. A generator is spawned from and moves on.
    surfaces
        Of the same scene, prepared before; only spot and detector may differ.
    progress
        Told after each step.

    Raises
    ------
    InputError
        The scene cannot be photographed as it stands.
    """
    return expose(surfaces or prepare(scene, progress, backend), seed, scene.detector, scene.spot)


def prepare(scene: Scene, progress: Progress | None = None, backend: Backend = "auto") -> Surfaces:
    """Make the mesh, find the surface in every view, and work out the noise-free signal.

    Errors of stage, column and scan come from the scene's `instrument_seed`, not from that of the noise: they decide
    what the beam meets, which is what costs most and is done here once.
    """
    report = _steps(progress, 1 + 2 * len(scene.schedule.tilts_deg))
    mesh = scene.specimen(np.random.default_rng(scene.specimen_seed))
    report("specimen")
    views, offsets = true_views(scene)
    buffers, rates = [], []
    for i, pose in enumerate(views):
        beam = pixel_grid(scene.microscope) + offsets[i] if offsets else None
        buffers.append(surface_buffer(mesh, scene.microscope, pose, backend, beam_px=beam))
        report(f"surface of view {i}")
        rates.append(electron_rates(buffers[i], pose, scene.signal, mesh, scene.microscope))
        report(f"signal of view {i}")
    return Surfaces(scene, GroundTruth(mesh, scene.microscope, views, tuple(buffers), offsets), tuple(rates))


def true_views(scene: Scene) -> tuple[tuple[Pose, ...], tuple[Array, ...]]:
    """Draw what the instrument really does: the pose of each view, and the scan offsets, if any, (rows, columns, 2)."""
    stage, scanning = np.random.default_rng(scene.instrument_seed).spawn(2)
    views = poses(scene.schedule, scene.stage_errors, scene.view_errors, stage)
    if scene.scan.off:
        return views, ()
    return views, tuple(scan_offsets(scene.microscope, scene.scan, child) for child in scanning.spawn(len(views)))


def expose(
    surfaces: Surfaces, seed: Seed, detector: DetectorOptions | None = None, spot: SpotOptions | None = None
) -> Capture:
    """Take one set of micrographs of prepared surfaces.

    Parameters
    ----------
    seed
        Each channel of each view draws from a child of its own, so that neither order nor number of the others matters.
    detector, spot
        Instead of the scene's: another dose, contrast or sharpness of the same surfaces.
    """
    scene = replace(surfaces.scene, detector=detector or surfaces.scene.detector, spot=spot or surfaces.scene.spot)
    expected = [
        _expected(rates, buffer, scene) for rates, buffer in zip(surfaces.rates, surfaces.truth.buffers, strict=False)
    ]
    children = random_children(np.random.default_rng(seed), len(expected), len(expected[0]))
    contrast = channel_contrasts(expected, scene.detector)
    pictures = [_read_out(*each, scene.detector) for each in zip(expected, contrast, children, strict=True)]
    images = tuple(view.pop(MAIN) for view in pictures)
    return Capture(images, scene, surfaces.truth, tuple(pictures))


def channel_contrasts(
    expected_e: Sequence[Mapping[str, Array]], options: DetectorOptions
) -> tuple[dict[str, Contrast], ...]:
    """Set the amplifiers, per view and channel, from the noise-free pictures.

    Each detector has a setting of its own. The segments of one share theirs, so that they can be compared.

    Parameters
    ----------
    expected_e
        Expected electrons of each view by channel, (rows, columns).
    """
    answer: tuple[dict[str, Contrast], ...] = tuple({} for _ in expected_e)
    segments = [name for name in expected_e[0] if name.startswith(SEGMENT)]
    single = [[name] for name in expected_e[0] if name not in segments]
    for names in filter(None, (*single, segments)):
        together = [[view[name] for name in names] for view in expected_e]
        pictures = [each[0] if len(each) == 1 else np.concatenate(each) for each in together]  # no copy of large ones
        for of_view, contrast in zip(answer, contrasts(pictures, options), strict=True):
            of_view.update(dict.fromkeys(names, contrast))
    return answer


def _expected(rates: Mapping[str, Array], buffer: SurfaceBuffer, scene: Scene) -> dict[str, Array]:
    """Electrons to be counted on average by each channel of a view.

    Charging comes after the spot, for it follows what the beam, as wide as it is, sets free along its line; and it
    holds back slow electrons only.
    """
    seen = {name: blur_by_spot(rate, buffer.depth_um, scene.spot, scene.microscope) for name, rate in rates.items()}
    seen[MAIN] = charged(seen[MAIN], scene.charging)
    return {name: expected_electrons(rate, scene.detector) for name, rate in seen.items()}


def _read_out(
    expected: Mapping[str, Array],
    contrast: Mapping[str, Contrast],
    children: Sequence[np.random.Generator],
    options: DetectorOptions,
) -> dict[str, Image]:
    """Count and digitise the channels of one view."""
    counted = {
        name: count_electrons(mean, options.summed_read_noise_e, child)
        for (name, mean), child in zip(expected.items(), children, strict=True)
    }
    if segments := [electrons for name, electrons in counted.items() if name.startswith(SEGMENT)]:
        counted[RING] = np.sum(segments, axis=0)  # the same electrons, not others
    return {name: digitise(electrons, contrast[name], options.bits) for name, electrons in counted.items()}


def _steps(progress: Progress | None, total: int) -> Callable[[str], None]:
    """Count the steps for whoever watches."""
    done = 0

    def report(finished: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(finished, done, total)

    return report
