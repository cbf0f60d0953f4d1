"""The scenes on which methods are compared, and what each of them offers."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from benchmarks.running.runner import code_version, digest, seed_of
from benchmarks.scenes import SimulatedSource
from semrecon.data import TiltSeries
from semrecon.errors import InputError
from semsim.backscatter import BackscatterOptions
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene, scaled, tables
from semsim.scenes import NAMED, PRINT, scene
from semsim.signal import SignalOptions
from semsim.specimens import specimen_from

Purpose = Literal["reporting", "development"]
"""Methods are tuned on development scenes only: other specimens of the same kind, other noise."""
SPECIMEN_SEEDS: dict[Purpose, int] = {"reporting": 7001, "development": 1}
ALWAYS = ("pixel_size", "tilt_axis", "channels")
"""What every scene of the suite offers."""
REAL_DATA = "SEM_REAL_DATA"
"""Environment variable: folder with real meshes and height maps."""


@dataclass(frozen=True)
class BenchScene:
    """A simulated scene as methods are offered it.

    Parameters
    ----------
    name, about
        Name in tables, and a sentence on what is photographed.
    source
        Where series and truth come from; its name tells the purposes apart, so that they share no noise.
    offers
        What a method may need and gets here.
    content
        Digest of the specimen's file, where it has one.
    """

    name: str
    about: str
    source: SimulatedSource
    offers: tuple[str, ...]
    content: str = ""

    @property
    def identity(self) -> str:
        """Digest of all that decides images and truth, the simulator's code included."""
        return digest(self.source.identity, self.content, code_version("semsim", "benchmarks/adapt.py"))

    def series(self, repetition: int) -> TiltSeries:
        """Images of one repetition, with nominal settings."""
        return self.source.series(repetition)

    def seed(self, repetition: int) -> int:
        """Seed of a method's random choices: of scene and repetition, never of the method."""
        return seed_of(f"{self.source.name}/method", repetition)


def suite(cache: Path, *, quick: bool = False, purpose: Purpose = "reporting") -> tuple[BenchScene, ...]:
    """Make all scenes; those of real data only where `SEM_REAL_DATA` names the folder.

    Parameters
    ----------
    cache
        Folder where surfaces are kept, by content.
    quick
        About 427 columns instead of 640.
    """
    small = 2 / 3 if quick else 1.0
    full = [(each, _about(each.name), "") for each in _simulated(0.75 * small, 0.25 * small)]
    full += [(scaled(each, small), about, content) for each, about, content in _real()]
    return tuple(_bench_scene(*each, cache, purpose) for each in full)


def chosen(scenes: Sequence[BenchScene], names: Sequence[str]) -> tuple[BenchScene, ...]:
    """Pick scenes by name, all if none is named; raises `InputError` for a name that is not one."""
    known = {each.name: each for each in scenes}
    for name in names:
        if name not in known:
            raise InputError(f"--scenes names no scene {name!r}; there are {', '.join(known)}")
    return tuple(known[name] for name in names) if names else tuple(scenes)


def _simulated(factor: float, of_diatom: float) -> list[Scene]:
    rough = {"name": "fracture", "hurst": 0.7, "rms_um": 6.0}
    smooth = {"name": "fracture", "hurst": 0.9, "rms_um": 3.0, "faceting": 0.0, "roughness_um": 0.01, "contrast": 0.02}
    fractures = [
        replace(scene("fracture"), name=f"fracture_{name}", specimen=specimen_from(options))
        for name, options in (("rough", rough), ("smooth", smooth))
    ]
    names = ("pollen", "grains", "steps", "spheres", "pyramid", "wires")
    printed = [scaled(each, factor) for each in (*map(scene, names), *fractures)]
    return [*printed, scaled(scene("diatom"), of_diatom), scaled(scene("translation"), factor)]


def _about(name: str) -> str:
    said = {
        "fracture_rough": "A rugged fracture with facets.",
        "fracture_smooth": "A smooth fracture with little material contrast: hardly a feature to match.",
    }
    return said.get(name) or NAMED[name].about


def _real() -> list[tuple[Scene, str, str]]:
    """Specimens from files: scene, what it is, digest of the file."""
    folder = os.environ.get(REAL_DATA)
    if not folder:
        return []
    microscope = replace(PRINT, pixel_size_um=PRINT.pixel_size_um / 0.75, width_px=640, height_px=480)
    tilts = TiltSchedule((-6.0, 0.0, 6.0))
    grains = ("ct_grains", "meshes/ct_grains.ply", {"unit_um": 1.6, "contrast": 0.05}, microscope)
    scan = {"height_scale": 6.0, "smooth_um": 0.6, "contrast": 0.05}
    worn = ("focus_variation", "heights/focus_variation.npz", scan, Microscope(0.12, 640, 480))
    about = {
        "ct_grains": "Rounded grains as an X-ray tomograph measured them; a voxel is taken to be 1.6 um.",
        "focus_variation": "A surface measured by focus variation; its heights are multiplied by 6.",
    }
    answer = []
    for name, file, options, optics in (grains, worn):
        path = Path(folder) / file
        if path.is_file():
            specimen = specimen_from({"file": str(path), **options})
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            answer.append((Scene(name, specimen, optics, tilts), about[name], content))
    return answer


def _bench_scene(plain: Scene, about: str, content: str, cache: Path, purpose: Purpose) -> BenchScene:
    signal: SignalOptions = replace(
        plain.signal, backscatter=BackscatterOptions(shadow_reach_um=plain.signal.shadow_reach_um)
    )
    whole = replace(plain, name=f"{plain.name}-{purpose}", signal=signal, specimen_seed=SPECIMEN_SEEDS[purpose])
    folder = cache / content[:12] if content else cache
    return BenchScene(plain.name, about, SimulatedSource(whole, folder), _offers(plain), content)


def _offers(plain: Scene) -> tuple[str, ...]:
    """List what a scene has: tilts that differ, a scan pivot that is near, a stage that slides."""
    tilted = ("rotations",) if len(set(plain.schedule.tilts_deg)) > 1 else ()
    near = ("perspective",) if plain.microscope.working_distance_um is not None else ()
    slides = ("stage_path",) if plain.schedule.shifts_um else ()
    return (*ALWAYS, *tilted, *near, *slides)


def described(each: BenchScene) -> str:
    """Digest-free words on a scene for a report: geometry from the settings."""
    microscope = tables(each.source.scene)["microscope"]
    tilts = ", ".join(f"{tilt:g}" for tilt in each.source.scene.schedule.tilts_deg)
    return f"{each.about} {microscope['width_px']} x {microscope['height_px']} px, tilts {tilts} degrees."
