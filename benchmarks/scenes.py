"""What a study photographs or reads: sources of tilt series, simulated with truth or real without."""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from benchmarks.adapt import series_from_capture
from benchmarks.judging.evaluate import commonly_visible
from benchmarks.running.read_only import can_be_written
from benchmarks.running.runner import code_version, digest, seed_of
from semrecon.data import Array, Mask, TiltSeries
from semrecon.geometry import tilt_rotation
from semsim.capture import Surfaces, expose, prepare
from semsim.scene import Scene, scaled, tables
from semsim.scenes import scene
from semsim.truth import GroundTruth

Progress = Callable[[str, int, int], None]


class Source(Protocol):
    """Where the series of a study come from."""

    @property
    def name(self) -> str:
        """What tables call it."""

    @property
    def identity(self) -> str:
        """Digest of all that decides its images."""

    def series(self, repetition: int) -> TiltSeries:
        """Images of one repetition, with nominal settings."""

    def truth(self) -> GroundTruth | None:
        """Exact truth; None where nobody knows it."""

    def judgeable(self, views: tuple[int, ...], step: int) -> Mask:
        """Tell what all of `views` see, on every `step`-th row and column of the first of them."""


@dataclass(frozen=True)
class SimulatedSource:
    """A scene photographed anew, with new noise, in every repetition.

    Parameters
    ----------
    scene
        What is photographed.
    cache
        Folder where its surfaces are kept: they are the same in all repetitions and cost most.
    """

    scene: Scene
    cache: Path

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.scene.name

    @property
    def identity(self) -> str:
        """Digest of the scene's settings."""
        return digest(tables(self.scene))

    def prepare(self, progress: Progress | None = None) -> None:
        """Make mesh, surfaces and noise-free signal, once; a file that was half written is never seen."""
        if self._path.is_file():
            return
        self.cache.mkdir(parents=True, exist_ok=True)
        partial = self._path.with_suffix(f".{os.getpid()}.partial")
        partial.write_bytes(pickle.dumps(prepare(self.scene, progress), protocol=5))
        partial.replace(self._path)

    def series(self, repetition: int) -> TiltSeries:
        """Expose the prepared surfaces with the noise of this repetition."""
        return _exposed(self, repetition)

    def truth(self) -> GroundTruth:
        """Truth of the scene."""
        return self.surfaces().truth

    def judgeable(self, views: tuple[int, ...], step: int) -> Mask:
        """Tell what all of `views` see, on every `step`-th row and column of the first of them."""
        return _judgeable(self, views, step)

    @property
    def _path(self) -> Path:
        return self.cache / f"{self.name}-{digest(tables(self.scene), code_version('semsim'))}.pickle"

    def surfaces(self) -> Surfaces:
        """Read the prepared surfaces of the scene from the cache, or make them; a read-only cache stays as it is."""
        if not self._path.is_file() and not can_be_written(self.cache):
            return _made(self)
        self.prepare()
        return _loaded(self._path)


@lru_cache(maxsize=1)
def _loaded(path: Path) -> Surfaces:
    surfaces = pickle.loads(path.read_bytes())  # written by `prepare` in this very folder
    assert isinstance(surfaces, Surfaces)
    return surfaces


@lru_cache(maxsize=1)
def _made(source: SimulatedSource) -> Surfaces:
    return prepare(source.scene)


@lru_cache(maxsize=1)
def _exposed(source: SimulatedSource, repetition: int) -> TiltSeries:
    """Series of a repetition, kept for the methods and the judge that ask for it one after the other.

    Nobody may write to it: what one method does to its input must not reach the next.
    """
    rng = np.random.default_rng(seed_of(source.name, repetition))
    series = series_from_capture(expose(source.surfaces(), rng))
    for view in series.views:
        for image in (view.image, *view.channels.values()):
            image.setflags(write=False)
    return series


@lru_cache(maxsize=16)
def _judgeable(source: SimulatedSource, views: tuple[int, ...], step: int) -> Mask:
    return commonly_visible(source.truth(), views[0], views[1:], step)


@dataclass(frozen=True, eq=False)
class RealSource:
    """Real micrographs: the same in every repetition, and without truth."""

    name: str
    images: TiltSeries

    @property
    def identity(self) -> str:
        """Digest of pixels and settings."""
        series = self.images
        geometry = sorted(series.channel_geometry.items())
        stated = (series.optics, series.tilts_deg, series.tilt_axis_deg, [view.stage_um for view in series.views])
        content = hashlib.sha256(repr((*stated, geometry)).encode())
        for view in series.views:
            content.update(view.image.tobytes())
            for name, image in sorted(view.channels.items()):
                content.update(name.encode() + image.tobytes())
        return content.hexdigest()[:32]

    def series(self, repetition: int) -> TiltSeries:  # noqa: ARG002 - the only images there are
        """Return the series."""
        return self.images

    def truth(self) -> None:
        """Nobody knows it."""

    def judgeable(self, views: tuple[int, ...], step: int) -> Mask:
        """Nothing can be judged."""
        raise ValueError(f"{self.name} is real: there is no truth to judge views {views} by on every {step}-th row")


def paper_scenes(cache: Path, *, quick: bool) -> tuple[SimulatedSource, ...]:
    """Make the two series of the seed's Table 1; `quick` halves the columns of pollen and quarters the diatom's."""
    factors = {"pollen": 0.5, "diatom": 0.25} if quick else {"pollen": 1.0, "diatom": 1.0}
    scenes = (scene(name) if factor == 1 else scaled(scene(name), factor) for name, factor in factors.items())
    return tuple(SimulatedSource(each, cache) for each in scenes)


def with_tilt_step(series: TiltSeries, step_deg: float) -> TiltSeries:
    """State the tilts as multiples of one step from the first view, whatever the files say."""
    views = tuple(replace(view, tilt_deg=i * step_deg) for i, view in enumerate(series.views))
    return replace(series, views=views)


def views_from_world(series: TiltSeries) -> Array:
    """R_view_from_world of every view from the nominal tilts, (views, 3, 3)."""
    return np.stack([tilt_rotation(float(tilt), series.tilt_axis_deg) for tilt in series.tilts_deg])
