"""Scale: what a data bar says of the pixel size, and when parallel projection is right."""

from __future__ import annotations

import numpy as np

from semrecon.data import Optics
from semrecon.errors import InputError

UM_PER_INCH = 25_400.0


def _positive(value: float, what: str) -> float:
    """Pass a positive finite number on; raise `InputError` that names it otherwise."""
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{what} must be a positive number, not {value}")
    return float(value)


def pixel_size_from_bar(bar_um: float, bar_px: float) -> float:
    """Pixel size from the data bar: its length on the specimen over its length in the image, um.

    Table 1 of the seed: 5 um = 34 px (pollen) and 5 um = 60 px (diatom), its "Scale (um/pixel)".
    """
    return _positive(bar_um, "data bar length in um") / _positive(bar_px, "data bar length in px")


def magnification_at_dpi(pixel_size_um: float, dpi: float) -> float:
    """Magnification of a print with one image pixel a print pixel: (25400 / dpi) / pixel size.

    This is `a` of the seed's Eq. 1 and Table 1: (25400/512)/(5/34) = 337.3438 and (25400/512)/(5/60) = 595.3125. It has
    no unit; it is not a number of px/um (those scales are 6.8 and 12), and it depends on the print, not the microscope.
    """
    return UM_PER_INCH / _positive(dpi, "dpi") / _positive(pixel_size_um, "pixel size in um")


def perspective_shift_px(width_px: int, relief_um: float, working_distance_um: float) -> float:
    """Shift at the image edge that parallel projection leaves out: (width / 2) * relief / working distance, px.

    To first order in relief / working distance a point raised by `relief_um` stands further from the centre by this
    fraction of its distance from it.
    """
    edge_px = _positive(width_px, "image width in px") / 2
    return edge_px * abs(relief_um) / _positive(working_distance_um, "working distance in um")


def perspective_bowl_um(half_width_um: float, working_distance_um: float) -> float:
    """Depth error at the image edge, across the tilt axis, of taking perspective for parallel projection, um.

    With k = 1 / working distance the second view of a point at x, z stands ``k sin(tilt) (z^2 - x^2)`` further than
    parallel projection says, to first order in k and the tilt. Divided by sin(tilt), as every stereo formula does,
    a plane becomes a bowl of depth x^2 / working distance, at any tilt; the larger part of `perspective_shift_px` is
    the same in all views and moves points sideways only.
    """
    return _positive(half_width_um, "half width in um") ** 2 / _positive(working_distance_um, "working distance in um")


def perspective_warning(optics: Optics, relief_um: float, working_distance_um: float, noise_px: float) -> str | None:
    """Say so where parallel projection costs more than matching does.

    A fixed limit such as 1000x knows neither the relief nor the working distance nor how well the images can be
    matched; the shift against the noise does.

    Returns
    -------
    A sentence, or None where the edge shift stays below `noise_px`.
    """
    edge_px = max(optics.width_px, optics.height_px)
    shift = perspective_shift_px(edge_px, relief_um, working_distance_um)
    if shift <= noise_px:
        return None
    bowl_um = perspective_bowl_um(edge_px / 2 * optics.pixel_size_um, working_distance_um)
    return (
        f"perspective, which is left out, moves points at the image edge by up to {shift:.1f} px (relief "
        f"{relief_um:.3g} um, working distance {working_distance_um / 1000:.3g} mm), more than the matching noise of "
        f"{noise_px:.2f} px, and bends the heights there by about {bowl_um:.2g} um; --working-distance-mm "
        f"{working_distance_um / 1000:.3g} takes it into account"
    )
