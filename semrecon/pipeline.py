"""The recipe of a reconstruction: check the series, run the method, complete the surface, say what to mind."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from semrecon import DEFAULT_METHOD
from semrecon.calibration import perspective_warning
from semrecon.completion import complete
from semrecon.data import TiltSeries
from semrecon.errors import InputError
from semrecon.methods.base import Method
from semrecon.reconstruction import Reconstruction, finite_median

TYPICAL_NOISE_PX = 0.3
"""Matching noise assumed where the residuals say nothing, px."""
Progress = Callable[[str], None]


def reconstruct(
    series: TiltSeries,
    method: Method | str = DEFAULT_METHOD,
    *,
    seed: int = 0,
    working_distance_um: float | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct a surface from a tilt series.

    Parameters
    ----------
    method
        A method, or the name of one with its default options.
    seed
        Of the one random generator; the same seed gives the same result.
    working_distance_um
        Where it is known, for a warning if parallel projection is too simple.
    progress
        Called with the name of every stage as it begins.

    Raises
    ------
    InputError
        The series cannot be reconstructed by any method, or not by this one.
    MethodError
        The method cannot answer for this series.
    """
    method = _method(method)
    check_series(series)
    check_views(series, method)
    clock = Clock(progress)
    with clock.stage(method.name):
        estimate = method(series, rng=np.random.default_rng(seed))
    with clock.stage("surface"):
        points, heights, mesh = complete(estimate, series)
    result = Reconstruction(
        series, method.name, options_of(method), estimate, points, heights, mesh, estimate.warnings, seed, clock.seconds
    )
    return dataclasses.replace(result, warnings=(*result.warnings, *_cautions(result, working_distance_um)))


class Clock:
    """Tell of every stage as it begins, and keep the wall-clock seconds that it took."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        if self.progress is not None:
            self.progress(name)
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def check_series(series: TiltSeries) -> None:
    """Refuse a series without parallax or without a picture; raises `InputError`."""
    if len(series) < 2:
        only = series.views[0].name if series.views else "none"
        raise InputError(f"one image ({only}) cannot show depth; give two or more at different tilts")
    if np.ptp(series.tilts_deg) == 0:
        raise InputError(
            f"all {len(series)} images have the tilt {series.tilts_deg[0]:g} degrees, so there is no parallax; "
            "check --tilts or the metadata"
        )
    for view in series.views:
        if view.image.size == 0 or view.image.min() == view.image.max():
            raise InputError(f"{view.name or 'a view'} is blank: all its pixels have one value; leave it out")


def check_views(series: TiltSeries, method: Method) -> None:
    """Refuse a number of views that the method is not made for; raises `InputError`."""
    least, most = method.views
    if len(series) < least or (most is not None and len(series) > most):
        span = f"at least {least}" if most is None else f"{least} to {most}" if most > least else f"exactly {least}"
        raise InputError(f"method {method.name} takes {span} views, not {len(series)}")


def options_of(method: Method) -> dict[str, Any]:
    """Options of a method, by name."""
    return {f.name: getattr(method, f.name) for f in dataclasses.fields(method) if f.init}  # type: ignore[arg-type]


def _method(method: Method | str) -> Method:
    if not isinstance(method, str):
        return method
    from semrecon.methods import method_named

    return method_named(method)


def _cautions(result: Reconstruction, working_distance_um: float | None) -> list[str]:
    """Sentences that need the finished surface: so far, whether parallel projection was good enough."""
    optics, relief_um = result.series.optics, result.relief_um
    if working_distance_um is None or optics.inverse_working_distance > 0 or not math.isfinite(relief_um):
        return []
    noise_px = finite_median(result.points.residual_px)
    noise_px = noise_px if noise_px > 0 else TYPICAL_NOISE_PX
    warning = perspective_warning(optics, relief_um, working_distance_um, noise_px)
    return [] if warning is None else [warning]
