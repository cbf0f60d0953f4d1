"""The one seam between simulator and methods: what a method may know of a simulated series, and no more."""

from __future__ import annotations

import numpy as np

from semrecon.data import Optics, TiltSeries, View
from semsim.capture import Capture


def series_from_capture(capture: Capture, tilt_errors_deg: tuple[float, ...] = ()) -> TiltSeries:
    """Hand over images and nominal settings of a capture; truth stays behind.

    Parameters
    ----------
    capture
        What `semsim.simulate` returned.
    tilt_errors_deg
        Nominal minus true tilt of every view; empty is an exact stage.
    """
    microscope, schedule = capture.scene.microscope, capture.scene.schedule
    errors = np.zeros(len(capture.images)) if not tilt_errors_deg else np.asarray(tilt_errors_deg, dtype=np.float64)
    tilts = np.asarray(schedule.tilts_deg) + errors
    distance = microscope.working_distance_um
    optics = Optics(
        microscope.pixel_size_um,
        microscope.width_px,
        microscope.height_px,
        0.0 if distance is None else 1.0 / distance,
    )
    views = tuple(
        View(image, float(tilt), f"view_{i:02d}")
        for i, (image, tilt) in enumerate(zip(capture.images, tilts, strict=True))
    )
    return TiltSeries(views, optics, schedule.tilt_axis_deg)
