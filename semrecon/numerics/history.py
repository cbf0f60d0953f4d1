"""How an iteration came to its end: what was left after each step, as plain numbers that a report can keep and draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

CONVERGENCE = "convergence"
"""Name of the histories among the diagnostics of an estimate."""
MOST = 200
"""Of a longer history, so many numbers evenly between first and last are kept."""


def history(stage: str, residual_px: Sequence[float]) -> dict[str, Any]:
    """Name the history of an iteration.

    Parameters
    ----------
    stage
        What was iterated, in words.
    residual_px
        Root-mean-square residual before the first step and after each of them, pixels of the image.

    Returns
    -------
    `stage`, `steps` (which of them are kept, 0 being the start) and `residual_px`, as JSON can hold them.
    """
    count = len(residual_px)
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int)) if count else np.empty(0, int)
    return {"stage": stage, "steps": kept.tolist(), "residual_px": [float(residual_px[i]) for i in kept]}


def histories(diagnostics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Collect the histories among diagnostics, those of stages that have diagnostics of their own included."""
    own = list(diagnostics.get(CONVERGENCE, ()))
    nested = [each for each in diagnostics.values() if isinstance(each, Mapping)]
    return own + [found for each in nested for found in each.get(CONVERGENCE, ())]
