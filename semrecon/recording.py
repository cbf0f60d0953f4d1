"""A reconstruction as a rerun recording: images by tilt, the surface in space, and where the beam came from.

The only file of `semrecon` that knows rerun.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semrecon.data import Array, Optics
from semrecon.geometry import nominal_poses
from semrecon.reconstruction import Reconstruction

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "semrecon"
TIMELINE = "tilt"
"""A duration whose seconds are degrees: the one kind of timeline that holds fractions and signs."""
RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)
"""Dark violet to yellow, even in lightness."""
GREY = (150, 150, 150)


def write_recording(result: Reconstruction, path: Path) -> None:
    """Write a recording that opens with the surface beside the images."""
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION, recording_id=None)
    stream.save(path, default_blueprint=blueprint())
    try:
        _log_views(stream, result)
        _log_surface(stream, result)
        _log_words(stream, result)
    finally:
        stream.flush()
        stream.disconnect()


def blueprint() -> rrb.Blueprint:
    """How the viewer opens: space on the left; image, heights and words on the right."""
    import rerun.blueprint as rrb

    side = rrb.Vertical(
        rrb.Spatial2DView(origin="image", name="Image at this tilt"),
        rrb.Spatial2DView(origin="heights", name="Height above the lowest point, um"),
        rrb.TextDocumentView(origin="about", name="About"),
        row_shares=[3, 3, 2],
    )
    space = rrb.Spatial3DView(origin="world", name="Surface")
    return rrb.Blueprint(
        rrb.Horizontal(space, side, column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def height_colours(z_um: Array) -> NDArray[np.uint8]:
    """Colours of heights between their 1st and 99th percentile, (n, 3); grey where a height is missing."""
    finite = np.isfinite(z_um)
    colours = np.full((len(z_um), 3), GREY, dtype=np.uint8)
    if finite.any():
        low, high = np.percentile(z_um[finite], [1, 99])
        place = np.clip((z_um[finite] - low) / max(high - low, 1e-12), 0, 1) * (len(RAMP) - 1)
        channels = [np.interp(place, np.arange(len(RAMP)), RAMP[:, c]) for c in range(3)]
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
        picture = rr.Image(view.image, color_model="L")
        stream.log("image", picture.compress(jpeg_quality=95) if view.image.dtype == np.uint8 else picture)
        corners = plane_corners(poses.rotations[i], poses.translations_um[i], result.series.optics, 0.6 * extent_um)
        centre, beam = corners.mean(axis=0), poses.rotations[i][2] * 0.2 * extent_um
        outline = [np.vstack([corners, corners[:1]])]
        stream.log("world/view/plane", rr.LineStrips3D(outline, colors=[255, 200, 0], labels=[view.name]))
        stream.log("world/view/beam", rr.Arrows3D(origins=[centre], vectors=[beam], colors=[255, 200, 0]))
        stream.log(f"world/all_views/{i:02d}", rr.LineStrips3D(outline, colors=[GREY]), static=True)
    stream.reset_time()


def plane_corners(rotation: Array, translation_um: Array, optics: Optics, above_um: float) -> Array:
    """Corners of the image plane of a parallel view, `above_um` before the specimen: (4, 3) in the world frame, um."""
    x, y = np.array([optics.width_px, optics.height_px]) * optics.pixel_size_um / 2
    cam = np.array([[-x, -y, -above_um], [x, -y, -above_um], [x, y, -above_um], [-x, y, -above_um]])
    return np.asarray((cam - translation_um) @ rotation)


def _log_surface(stream: rr.RecordingStream, result: Reconstruction) -> None:
    import rerun as rr

    points, mesh = result.points, result.mesh
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    radius_um = 0.75 * result.series.optics.pixel_size_um
    colours = height_colours(points.xyz_um[:, 2])
    stream.log("world/points", rr.Points3D(points.xyz_um, colors=colours, radii=radius_um), static=True)
    vertex_colours = height_colours(mesh.vertices_um[:, 2])
    surface = rr.Mesh3D(
        vertex_positions=mesh.vertices_um,
        triangle_indices=mesh.faces,
        vertex_normals=vertex_normals(mesh.vertices_um, mesh.faces),
        vertex_colors=vertex_colours,
    )
    stream.log("world/mesh", surface, static=True)
    stream.log("heights", rr.DepthImage(_above_lowest(result.heights.z_um), meter=1.0, colormap="viridis"), static=True)


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
        f"The timeline `{TIMELINE}` counts degrees as seconds.\n\nWarnings:{warnings}\n"
    )
    stream.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
