"""A reconstruction as a rerun recording: images by tilt, the surface in space, and where the beam came from.

The only file of `semrecon` that knows rerun.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Image, Optics
from semrecon.geometry import nominal_poses
from semrecon.output.glance import block_means, grey_range, view_tilts
from semrecon.reconstruction import Reconstruction

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "semrecon"
TIMELINE = "tilt"
"""A duration whose seconds are degrees: the one kind of timeline that holds fractions and signs."""
RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)
"""Dark violet to yellow, even in lightness."""
HEAT = np.array([[0, 0, 4], [81, 18, 124], [183, 55, 121], [252, 137, 97], [252, 253, 191]], dtype=np.float64)
"""Black to pale yellow, even in lightness: of doubts, as sigma and residuals."""
GREY, YELLOW, BLUE = (150, 150, 150), (255, 200, 0), (0, 114, 178)
MOST_PX, MOST_POINTS = 1024, 200_000
"""A recording is looked at, not measured: images and maps are averaged, and the points of a dense method thinned,
to this much."""


def write_recording(result: Reconstruction, path: Path) -> None:
    """Write a recording that opens with the surface beside the images."""
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION, recording_id=None)
    stream.save(path, default_blueprint=blueprint())
    try:
        _log_views(stream, result)
        _log_beams(stream, result)
        _log_surface(stream, result)
        _log_points(stream, result)
        _log_words(stream, result)
    finally:
        stream.flush()
        stream.disconnect()


def blueprint() -> rrb.Blueprint:
    """How the viewer opens: space on the left; image, heights and words on the right."""
    import rerun.blueprint as rrb

    side = rrb.Vertical(
        rrb.Spatial2DView(origin="image", name="Image at this tilt"),
        rrb.Tabs(
            rrb.Spatial2DView(origin="heights", name="Height above the lowest point, um"),
            rrb.Spatial2DView(origin="sigma", name="Sigma, brightest at its 99th percentile"),
        ),
        rrb.TextDocumentView(origin="about", name="About"),
        row_shares=[3, 3, 2],
    )
    doubts = ["world/residuals", "world/sigma"]
    surface = [*(f"- /{path}/**" for path in doubts), "+ /world/**"]
    space = rrb.Tabs(
        rrb.Spatial3DView(origin="world", contents=surface, name="Surface"),
        rrb.Spatial3DView(origin="world", contents="/world/residuals/**", name="Points by residual"),
        rrb.Spatial3DView(origin="world", contents="/world/sigma/**", name="Points by sigma"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(space, side, column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def ramp_colours(values: Array, ramp: Array = RAMP) -> NDArray[np.uint8]:
    """Colours of values between their 1st and 99th percentile, (..., 3); grey where a value is missing."""
    finite = np.isfinite(values)
    colours = np.full((*values.shape, 3), GREY, dtype=np.uint8)
    if finite.any():
        low, high = np.percentile(values[finite], [1, 99])
        place = np.clip((values[finite] - low) / max(high - low, 1e-12), 0, 1) * (len(ramp) - 1)
        channels = [np.interp(place, np.arange(len(ramp)), ramp[:, c]) for c in range(3)]
        colours[finite] = np.stack(channels, axis=1).round().astype(np.uint8)
    return colours


def _log_views(stream: rr.RecordingStream, result: Reconstruction) -> None:
    """Image, image plane and beam of every view, at its tilt."""
    import rerun as rr

    poses = result.estimate.poses or nominal_poses(result.series)
    extent_um = result.series.optics.pixel_size_um * max(result.series.optics.shape)
    for i, view in enumerate(result.series.views):
        stream.set_time(TIMELINE, duration=float(view.tilt_deg))
        stream.set_time("view", sequence=i)
        stream.log("image", rr.Image(eight_bits(view.image), color_model="L"))
        corners = plane_corners(poses.rotations[i], poses.translations_um[i], result.series.optics, 0.6 * extent_um)
        centre, beam = corners.mean(axis=0), poses.rotations[i][2] * 0.2 * extent_um
        outline = [np.vstack([corners, corners[:1]])]
        stream.log("world/view/plane", rr.LineStrips3D(outline, colors=[YELLOW], labels=[view.name]))
        stream.log("world/view/beam", rr.Arrows3D(origins=[centre], vectors=[beam], colors=[YELLOW]))
        stream.log(f"world/all_views/{i:02d}", rr.LineStrips3D(outline, colors=[GREY]), static=True)
    stream.reset_time()


def eight_bits(image: Image) -> NDArray[np.uint8]:
    """Turn an image into what a screen shows: averaged, without the outermost half percent of grey values."""
    low, high = grey_range(image)
    grey = block_means(image.astype(np.float64), panel_factor(image.shape))
    return np.asarray(np.clip((grey - low) / (high - low), 0, 1) * 255).round().astype(np.uint8)


def panel_factor(shape: tuple[int, ...]) -> int:
    """Pixels to average along each edge."""
    return max(math.ceil(max(shape) / MOST_PX), 1)


def _log_beams(stream: rr.RecordingStream, result: Reconstruction) -> None:
    """Beams of all views at once, as stated and as found: the gun stands at their tails."""
    import rerun as rr

    extent_um = result.series.optics.pixel_size_um * max(result.series.optics.shape)
    tilts = view_tilts(result)
    both = {"stated": (nominal_poses(result.series), tilts.stated_deg, GREY)}
    if result.estimate.poses is not None and np.isfinite(result.estimate.poses.rotations).all():
        both["found"] = (result.estimate.poses, tilts.best_deg, BLUE)
    for name, (poses, degrees, colour) in both.items():
        beams = poses.rotations[:, 2]
        labels = [f"{tilt:.2f}°" for tilt in degrees] if len(degrees) == len(beams) else None
        arrows = rr.Arrows3D(
            origins=-0.9 * extent_um * beams,
            vectors=0.25 * extent_um * beams,
            colors=[colour],
            labels=labels,
            show_labels=False,
        )
        stream.log(f"world/beams/{name}", arrows, static=True)


def plane_corners(rotation: Array, translation_um: Array, optics: Optics, above_um: float) -> Array:
    """Corners of the image plane of a parallel view, `above_um` before the specimen: (4, 3) in the world frame, um."""
    x, y = np.array([optics.width_px, optics.height_px]) * optics.pixel_size_um / 2
    cam = np.array([[-x, -y, -above_um], [x, -y, -above_um], [x, y, -above_um], [-x, y, -above_um]])
    return np.asarray((cam - translation_um) @ rotation)


def _log_surface(stream: rr.RecordingStream, result: Reconstruction) -> None:
    import rerun as rr

    mesh, heights = result.mesh, result.heights
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    surface = rr.Mesh3D(
        vertex_positions=mesh.vertices_um,
        triangle_indices=mesh.faces,
        vertex_normals=vertex_normals(mesh.vertices_um, mesh.faces),
        vertex_colors=ramp_colours(mesh.vertices_um[:, 2]),
    )
    stream.log("world/mesh", surface, static=True)
    z_um, sigma_um = (block_means(v, panel_factor(v.shape)) for v in (heights.z_um, heights.sigma_um))
    stream.log("heights", rr.DepthImage(_above_lowest(z_um), meter=1.0, colormap="viridis"), static=True)
    stream.log("sigma", rr.Image(ramp_colours(sigma_um, HEAT)), static=True)


def _log_points(stream: rr.RecordingStream, result: Reconstruction) -> None:
    """Log the points three times: by height, by residual and by sigma, each where it is known."""
    import rerun as rr

    every = max(1, math.ceil(len(result.points) / MOST_POINTS))
    points = result.points.keep(np.arange(0, len(result.points), every))
    radius_um = 0.75 * result.series.optics.pixel_size_um
    for path, values, ramp in (
        ("world/points", points.xyz_um[:, 2], RAMP),
        ("world/residuals", points.residual_px, HEAT),
        ("world/sigma", points.sigma_um, HEAT),
    ):
        known = np.isfinite(values)
        if known.any():
            shown = rr.Points3D(points.xyz_um[known], colors=ramp_colours(values[known], ramp), radii=radius_um)
            stream.log(path, shown, static=True)


def vertex_normals(vertices_um: Array, faces: NDArray[np.int64]) -> Array:
    """Mean normal of the faces around each vertex, weighted by their area, (vertices, 3)."""
    a, b, c = (vertices_um[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    total = np.zeros_like(vertices_um)
    for k in range(3):
        np.add.at(total, faces[:, k], face_normals)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def _above_lowest(z_um: Array) -> NDArray[np.float32]:
    """Heights as a depth image wants them: positive, 0 where missing."""
    finite = np.isfinite(z_um)
    low = np.percentile(z_um[finite], 0.1) if finite.any() else 0.0
    return np.where(finite, np.maximum(z_um - low, 1e-6), 0.0).astype(np.float32)


def _log_words(stream: rr.RecordingStream, result: Reconstruction) -> None:
    import rerun as rr

    warnings = "".join(f"\n- {sentence}" for sentence in result.warnings) or " none"
    text = (
        f"# {result.method}\n\n{len(result.series)} views, {len(result.points)} points, median sigma "
        f"{result.median_sigma_um:.3g} um, relief {result.relief_um:.3g} um.\n\n"
        f"The timeline `{TIMELINE}` counts degrees as seconds. Beams: grey as stated, blue as found. Residuals and "
        f"sigma run from black to pale yellow, their 99th percentile.\n\nWarnings:{warnings}\n"
    )
    stream.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
