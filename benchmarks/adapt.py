"""The one seam between simulator and methods: what a method may know of a simulated series, and no more."""

from __future__ import annotations

import numpy as np

from semrecon.data import ChannelGeometry, Optics, TiltSeries, View
from semsim.capture import Capture
from semsim.io import nominal_channel_geometry


def series_from_capture(capture: Capture, tilt_errors_deg: tuple[float, ...] = ()) -> TiltSeries:
    """Hand over images and nominal settings of a capture; truth stays behind.

    Parameters
    ----------
    capture
        What `semsim.simulate` returned. The errors of its stage, column and scan are in the images alone.
    tilt_errors_deg
        Added to the tilts that the stage stated; empty is none.
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
    others = capture.channels or ({},) * len(capture.images)
    positions = schedule.shifts_um or (None,) * len(capture.images)
    views = tuple(
        View(image, float(tilt), f"view_{i:02d}", channels=dict(channels), stage_um=position)
        for i, (image, tilt, channels, position) in enumerate(
            zip(capture.images, tilts, others, positions, strict=True)
        )
    )
    detectors = nominal_channel_geometry(capture.scene.signal.backscatter)
    geometry = {name: ChannelGeometry(**angles) for name, angles in detectors.items()}
    return TiltSeries(views, optics, schedule.tilt_axis_deg, geometry)
