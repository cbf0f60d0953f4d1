"""What to mind about a finished surface: perspective left out, relief inside out."""

from __future__ import annotations

import math

from semrecon.input.calibration import perspective_warning
from semrecon.photometry.relief_sign import inside_out_warning
from semrecon.reconstruction import Reconstruction, finite_median

TYPICAL_NOISE_PX = 0.3
"""Matching noise assumed where the residuals say nothing, px."""


def cautions(result: Reconstruction, working_distance_um: float | None) -> tuple[str, ...]:
    """List sentences that need the finished surface.

    Parameters
    ----------
    working_distance_um
        As the microscope states it; None where it does not.
    """
    said = [
        _perspective(result, working_distance_um),
        inside_out_warning(result.series, result.heights),
    ]
    return tuple(sentence for sentence in said if sentence is not None)


def _perspective(result: Reconstruction, working_distance_um: float | None) -> str | None:
    """Say whether parallel projection was good enough."""
    optics, relief_um = result.series.optics, result.relief_um
    if working_distance_um is None or optics.inverse_working_distance > 0 or not math.isfinite(relief_um):
        return None
    noise_px = finite_median(result.fitted.residual_px)
    noise_px = noise_px if noise_px > 0 else TYPICAL_NOISE_PX
    return perspective_warning(optics, relief_um, working_distance_um, noise_px)
