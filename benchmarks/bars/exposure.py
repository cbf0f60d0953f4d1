"""Several pictures of one specimen: other doses and misstated tilts, on surfaces that are found once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.running.runner import digest
from benchmarks.scenes import Progress, SimulatedSource
from semrecon.data import TiltSeries
from semsim.capture import Surfaces
from semsim.detector import DetectorOptions
from semsim.scene import tables


@dataclass(frozen=True)
class ExposedSource(SimulatedSource):
    """A scene whose surfaces serve every dose, and whose stage may state other tilts than it took.

    Parameters
    ----------
    tilt_errors_deg
        Added to what the stage states of each view; empty is none. Images and truth stay as they are.
    """

    tilt_errors_deg: tuple[float, ...] = ()

    @property
    def identity(self) -> str:
        """Digest of the scene's settings and of what is misstated."""
        return digest(tables(self.scene), self.tilt_errors_deg) if self.tilt_errors_deg else super().identity

    def prepare(self, progress: Progress | None = None) -> None:
        """Make the surfaces that all exposures share."""
        self._shared.prepare(progress)

    def series(self, repetition: int) -> TiltSeries:
        """Expose with the noise of this repetition, and state the tilts."""
        return with_tilt_errors(super().series(repetition), self.tilt_errors_deg)

    def surfaces(self) -> Surfaces:
        """Read the shared surfaces, as this exposure lights them."""
        return replace(self._shared.surfaces(), scene=self.scene)

    @property
    def _shared(self) -> SimulatedSource:
        return SimulatedSource(replace(self.scene, detector=DetectorOptions()), self.cache)


def exposed(source: SimulatedSource, dose_e: float | None, tilt_errors_deg: Sequence[float] = ()) -> ExposedSource:
    """Photograph the specimen of a source with another dose (None: its own), and state the tilts so far off."""
    scene = source.scene
    changed: dict[str, Any] = {} if dose_e is None else {"dose_e": dose_e}
    return ExposedSource(
        replace(scene, detector=replace(scene.detector, **changed)), source.cache, tuple(tilt_errors_deg)
    )


def with_tilt_errors(series: TiltSeries, errors_deg: Sequence[float]) -> TiltSeries:
    """Add to the stated tilt of every view; nothing is added where there is nothing to add."""
    if not errors_deg:
        return series
    views = zip(series.views, errors_deg, strict=True)
    return replace(series, views=tuple(replace(view, tilt_deg=view.tilt_deg + error) for view, error in views))
