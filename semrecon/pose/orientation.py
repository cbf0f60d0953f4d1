"""Which tilt axis a series goes by: the one stated, unless nobody stated one; and what the images say to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semrecon.data import TiltSeries
from semrecon.errors import MethodError
from semrecon.pose.axis import axis_contradiction, estimate_axis


def oriented(series: TiltSeries, stated: bool, rng: np.random.Generator) -> tuple[TiltSeries, tuple[str, ...]]:
    """Give a series the axis that the images show where nobody stated one, and hear their objection where somebody did.

    Parameters
    ----------
    stated
        Whether the axis of `series` was stated by a file or a user.

    Returns
    -------
    The series to go on with, and sentences for the user.
    """
    try:
        estimate = estimate_axis(series, rng)
    except MethodError as error:
        if stated:  # what was stated stands; images that show no axis do not speak against it
            return series, ()
        return series, (f"nobody states the tilt axis, and it is taken to be image up (0 degrees), as {error}",)
    if stated:
        objection = axis_contradiction(series.tilt_axis_deg, estimate)
        return series, () if objection is None else (objection,)
    said = (
        f"nobody states the tilt axis: the images say {estimate.axis_deg:.2f} +- {estimate.sigma_deg:.2f} degrees, "
        "clockwise from image up; give --tilt-axis-deg to state another"
    )
    return replace(series, tilt_axis_deg=estimate.axis_deg), (said, *estimate.warnings)
