"""What recordings of simulated scenes show beside answers: truth, views as planes and arrows, micrographs, colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.layout import Flat
from benchmarks.recording.rerun_file import Colour, RerunFile, Times
from benchmarks.recording.surfaces import MOST_VERTICES, error_colours, lifted, net, thinning
from benchmarks.reporting.report_figures import CURVES
from benchmarks.reporting.report_scenes import Truth
from semrecon.data import Array, Image, Poses, TiltSeries
from semrecon.output.glance import block_means, grey_range
from semrecon.output.recording import plane_corners
from semsim.truth import GroundTruth

GREY, YELLOW, BLUE, PALE = (150, 150, 150), (255, 200, 0), (0, 140, 255), (205, 205, 205)
IMAGE_PX, HUNG_PX = 640, 240
"""Most columns of a micrograph, and of one that hangs in space."""
ABOVE, ARROW = 0.55, 0.2
"""Where image planes hang over the specimen, and how long arrows are, over the width of the field of view."""
BAR_PX = (16, 320)
REFERENCE_TIMELINE, REPETITION = "tilt", "repetition"
SCALE = "scale"


def log_truth(file: RerunFile, truth: Truth, ground: GroundTruth, *, full: bool) -> None:
    """Write the surface that the reference view sees, and profiles of it as a net that hides nothing."""
    every = 1 if full else thinning(truth.z_um.size, 2 * MOST_VERTICES)
    file.surface("world/truth", *lifted(truth.z_um, truth, ground, every), PALE)
    file.lines("world/net", net(truth.z_um, truth, ground), GREY)


def log_cameras(file: RerunFile, series: TiltSeries, ground: GroundTruth) -> None:
    """Write the true views at once: image planes as outlines, and an arrow a view along its beam."""
    extent_um = width_um(series)
    poses = true_poses(ground)
    planes = [_outline(series, poses, view, extent_um) for view in range(len(series))]
    file.lines("world/views/planes", planes, GREY)
    log_beams(file, "world/views/beams", poses, extent_um, GREY, [f"{tilt:g}°" for tilt in series.tilts_deg])


def log_beams(
    file: RerunFile, path: str, poses: Poses, extent_um: float, colour: Colour, labels: list[str] | None = None
) -> None:
    """Write an arrow a view: all rays of a view are parallel to it, and come from the gun at its tail."""
    beams = poses.rotations[:, 2]
    file.arrows(path, -(ABOVE + 1.2 * ARROW) * extent_um * beams, ARROW * extent_um * beams, colour, labels or [])


def log_view(file: RerunFile, series: TiltSeries, view: int, ground: GroundTruth) -> None:
    """Write the micrograph of a view, and hang it where its image plane is."""
    image = series.views[view].image
    file.picture("micrograph", eight_bits(image, IMAGE_PX))
    outline = _outline(series, true_poses(ground), view, width_um(series))
    file.hung("world/view/picture", outline[:4], eight_bits(image, HUNG_PX))
    file.lines("world/view/plane", [outline], YELLOW)


def log_scale(file: RerunFile, limit_um: float) -> None:
    """Write a bar of the colours of errors, with what they stand for."""
    rows, columns = BAR_PX
    file.picture(SCALE, np.tile(error_colours(np.linspace(-limit_um, limit_um, columns), limit_um), (rows, 1, 1)))
    places = np.array([[0.02, 0.5], [0.5, 0.5], [0.98, 0.5]]) * [columns, rows]
    labels = [f"{-limit_um:g} µm: too low", "right", f"+{limit_um:g} µm: too high"]
    file.marks(f"{SCALE}/words", places, labels, (255, 255, 255))


def scale_view() -> Flat:
    """View of the bar."""
    return Flat("picture", "Colours: estimated minus true height", SCALE)


def true_poses(ground: GroundTruth) -> Poses:
    """Where the specimen really stood in each view."""
    rotations, translations = zip(*((pose.rotation, pose.translation_um) for pose in ground.poses), strict=True)
    return Poses(np.stack(rotations), np.stack(translations))


def width_um(series: TiltSeries) -> float:
    """Of the field of view."""
    return series.optics.width_px * series.optics.pixel_size_um


def at_tilt(tilt_deg: float) -> Times:
    """Place on the timeline of tilts: a duration whose seconds are degrees, as it may be negative or a fraction."""
    return {REFERENCE_TIMELINE: float(tilt_deg)}


def at_repetition(repetition: int) -> Times:
    """Place on the timeline of repetitions, which people count from 1."""
    return {REPETITION: repetition + 1}


def curve_colour(number: int) -> Colour:
    """Colour of a method: that of its curves in the report."""
    code = CURVES[number % len(CURVES)]
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


def eight_bits(image: Image, most_px: int) -> NDArray[np.uint8]:
    """Turn an image into what a screen shows, averaged to so many columns."""
    low, high = grey_range(image)
    grey = block_means(image.astype(np.float64), -(-image.shape[1] // most_px))
    return np.asarray(np.clip((grey - low) / (high - low), 0, 1) * 255).round().astype(np.uint8)


def _outline(series: TiltSeries, poses: Poses, view: int, extent_um: float) -> Array:
    """Corners of an image plane from the upper left clockwise, and the first again, (5, 3) um."""
    corners = plane_corners(poses.rotations[view], poses.translations_um[view], series.optics, ABOVE * extent_um)
    return np.vstack([corners, corners[:1]])
