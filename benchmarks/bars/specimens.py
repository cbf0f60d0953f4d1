"""Specimens that nobody tuned on: the scenes of the suite, each with several meshes of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.bars.exposure import exposed
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import BenchScene, Purpose
from benchmarks.sweeping.sweeps import offered
from semsim.scene import Scene

FIRST_SEED: dict[Purpose, int] = {"reporting": 8001, "development": 501}
"""Seeds of the specimens begin here: others than those of the suite, in both cases."""


@dataclass(frozen=True)
class Specimens:
    """Scenes to choose from.

    Parameters
    ----------
    scenes
        Those of the suite.
    meshes
        How many specimens of each kind.
    purpose
        "development" has other specimens and other noise than what is reported.
    """

    scenes: tuple[BenchScene, ...]
    meshes: int
    purpose: Purpose = "reporting"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scenes, in the order of the suite."""
        return tuple(each.name for each in self.scenes)

    def of(
        self,
        name: str,
        *,
        dose_e: float | None = None,
        tilt_errors_deg: Sequence[float] = (),
        said: str = "",
        channels: bool = False,
    ) -> tuple[BenchScene, ...]:
        """Make a scene with each of its meshes.

        Parameters
        ----------
        dose_e
            Electrons a pixel; None is the dose of the suite.
        tilt_errors_deg, said
            By how much the stage misstates each tilt, and what tables call that.
        channels
            Whether backscatter images are taken as well; they cost time.

        Raises
        ------
        ValueError
            There is no scene of that name.
        """
        base = next((each for each in self.scenes if each.name == name), None)
        if base is None:
            raise ValueError(f"there is no scene {name!r}; there are {', '.join(self.names)}")
        words = [] if dose_e is None else [f"{dose_e:g} e/px"]
        words += ([said] if said else []) + (["all detectors"] if channels else [])
        answer = []
        for seed in range(FIRST_SEED[self.purpose], FIRST_SEED[self.purpose] + self.meshes):
            scene = _with_mesh(base, seed, self.purpose, channels)
            source = exposed(SimulatedSource(scene, base.source.cache), dose_e, tilt_errors_deg)
            title = ", ".join([name, f"specimen {seed}", *words])
            answer.append(replace(base, name=title, source=source, offers=offered(scene)))
        return tuple(answer)


def _with_mesh(base: BenchScene, seed: int, purpose: Purpose, channels: bool) -> Scene:
    """Put in another specimen of the kind; its name, and with it the noise, is that of no other study."""
    scene = base.source.scene
    signal = scene.signal if channels else replace(scene.signal, backscatter=None)
    name = f"{base.name}-bars-{purpose}-{seed}"
    return replace(scene, name=name, specimen_seed=seed, signal=signal)


def tilts_apart(scene: Scene) -> np.ndarray:
    """Tilt of each view from that of the reference, degrees, (views,)."""
    tilts = np.asarray(scene.schedule.tilts_deg)
    return np.asarray(tilts - tilts[scene.schedule.reference])
