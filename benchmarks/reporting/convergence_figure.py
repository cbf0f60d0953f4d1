"""How the iterations of methods came to their end on a scene, from the histories that answers carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.reporting.report_figures import Figure, numbers, style_of

History = Mapping[str, Any]
"""As `semrecon.numerics.history.history` makes it."""
LEAST_PX = 1e-7
"""Smaller changes are drawn here: they are rounding, and would take all of a logarithmic axis."""


def convergence_plot(found: Mapping[str, Sequence[History]], places: Mapping[str, int]) -> Figure | None:
    """Draw by how much each step of an iteration changes the residual; None where no method keeps a history.

    The residual itself ends where noise and wrong surfaces leave it, and hardly falls on the way there: whether an
    iteration converges shows in its change.

    Parameters
    ----------
    found
        Histories by method, one a stage.
    places
        Number of each method, which gives its colour: the same in all figures.
    """
    data = [
        _curve(name, history, places[name], first=number == 0)
        for name, of_method in found.items()
        for number, history in enumerate(each for each in of_method if len(each["steps"]) > 1)
    ]
    if not data:
        return None
    x_axis = {"title": {"text": "step"}, "rangemode": "tozero"}
    y_axis = {"title": {"text": "change of the rms residual (px)"}, "type": "log", "exponentformat": "power"}
    return {"data": data, "layout": {"xaxis": x_axis, "yaxis": y_axis}}


def _curve(name: str, history: History, place: int, *, first: bool) -> dict[str, Any]:
    """Draw one stage; stages of a method share its colour, its entry in the legend, and the click that hides them."""
    colour, dash = style_of(place)
    residual, steps = (np.asarray(history[of], dtype=np.float64) for of in ("residual_px", "steps"))
    change = np.abs(np.diff(residual) / np.diff(steps))
    curve = {
        "x": list(history["steps"][1:]),
        "y": numbers(np.maximum(change, LEAST_PX)),
        "customdata": numbers(residual[1:]),
        "name": name,
        "legendgroup": name,
        "hovertemplate": f"{history['stage']}<br>step %{{x}}: residual %{{customdata}} px<extra>{name}</extra>",
        "mode": "lines+markers",
        "line": {"color": colour, "dash": dash, "width": 2},
        "marker": {"color": colour, "size": 5},
    }
    return curve if first else {**curve, "showlegend": False}
