"""The recipe of a reconstruction: check the series, orient it, run the method, complete the surface, raise doubts."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from semrecon import DEFAULT_METHOD
from semrecon.cautions import cautions
from semrecon.data import TiltSeries
from semrecon.errors import InputError
from semrecon.methods.base import Method
from semrecon.pose.orientation import oriented
from semrecon.reconstruction import Reconstruction
from semrecon.surface.completion import complete

AXIS_STREAM = 1
"""Sets the random choices of the axis apart from those of the method."""
Progress = Callable[[str], None]


def reconstruct(
    series: TiltSeries,
    method: Method | str = DEFAULT_METHOD,
    *,
    seed: int = 0,
    working_distance_um: float | None = None,
    axis_stated: bool = True,
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
    axis_stated
        Whether anybody stated the tilt axis. If not, it is estimated from the images; if so, the images may object.
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
    check_series(series, method)
    clock = Clock(progress)
    objections: tuple[str, ...] = ()
    if "tilt_axis" in method.needs:
        with clock.stage("tilt axis"):
            series, objections = oriented(series, axis_stated, np.random.default_rng([seed, AXIS_STREAM]))
    with clock.stage(method.name):
        estimate = method(series, rng=np.random.default_rng(seed))
    with clock.stage("surface"):
        points, heights, mesh = complete(estimate, series)
        result = Reconstruction(
            series, method.name, options_of(method), estimate, points, heights, mesh, seed=seed, seconds=clock.seconds
        )
        warnings = (*objections, *estimate.warnings, *cautions(result, working_distance_um))
    return dataclasses.replace(result, warnings=warnings)


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


def check_series(series: TiltSeries, method: Method) -> None:
    """Refuse a series that the method is not made for; raises `InputError`."""
    for view in series.views:
        if view.image.size == 0 or view.image.min() == view.image.max():
            raise InputError(f"{view.name or 'a view'} is blank: all its pixels have one value; leave it out")
    if len(series) < 2 <= method.views[0]:
        only = series.views[0].name if series.views else "none"
        raise InputError(f"one image ({only}) cannot show depth to {method.name}; give two or more at different tilts")
    if "rotations" in method.needs and np.ptp(series.tilts_deg) == 0:
        raise InputError(
            f"all {len(series)} images have the tilt {series.tilts_deg[0]:g} degrees, so there is no parallax; "
            "check --tilts or the metadata"
        )
    check_views(series, method)


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
