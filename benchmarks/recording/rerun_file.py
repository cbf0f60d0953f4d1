"""Writes recordings for the rerun viewer. The only file of `benchmarks` that imports rerun."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.layout import Box, Flat, Part, Space
from semrecon.data import Array
from semrecon.output.recording import vertex_normals

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "sem-bench"
LINE_POINTS = 0.6
"""Half the width of lines in space, points on the screen however near they are."""
Colour = tuple[int, int, int]
Colours = NDArray[np.uint8]
Times = Mapping[str, float | int]
"""A place on each of some timelines: whole numbers count, others are durations of so many seconds."""


@contextmanager
def rerun_file(path: Path, name: str, layout: Part, timeline: str) -> Iterator[RerunFile]:
    """Write a recording: it is there as a whole, under its name, or not at all.

    Parameters
    ----------
    name
        Of the recording, for the viewer.
    layout, timeline
        How the viewer opens.
    """
    import rerun as rr

    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    try:
        stream.save(partial, default_blueprint=_blueprint(layout, timeline))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        yield RerunFile(stream)
        stream.flush()
        stream.disconnect()
        partial.replace(path)
    finally:
        stream.disconnect()
        partial.unlink(missing_ok=True)


class RerunFile:
    """What can be written; each thing stands at the places last said by `at`, and always where none were."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._always = True

    def at(self, times: Times | None = None) -> None:
        """Say where on which timelines the next things stand; nowhere in particular by default."""
        self._stream.reset_time()
        self._always = not times
        for timeline, value in (times or {}).items():
            if isinstance(value, int):
                self._stream.set_time(timeline, sequence=value)
            else:
                self._stream.set_time(timeline, duration=float(value))

    def points(self, path: str, xyz_um: Array, colours: Colours | Colour, radius_um: float) -> None:
        """Write a cloud, (points, 3) um, with a colour a point or one for all."""
        import rerun as rr

        self._log(path, rr.Points3D(xyz_um.astype(np.float32), colors=colours, radii=radius_um))

    def surface(self, path: str, xyz_um: Array, faces: NDArray[np.int64], colours: Colours | Colour) -> None:
        """Write a mesh, vertices (n, 3) um and faces (m, 3), with a colour a vertex or one for all."""
        import rerun as rr

        one = isinstance(colours, tuple)
        mesh = rr.Mesh3D(
            vertex_positions=xyz_um.astype(np.float32),
            triangle_indices=faces.astype(np.uint32),
            vertex_normals=vertex_normals(xyz_um, faces).astype(np.float32),
            vertex_colors=None if one else colours,
            albedo_factor=[*colours, 255] if one else None,
        )
        self._log(path, mesh)

    def hung(self, path: str, corners_um: Array, grey: NDArray[np.uint8]) -> None:
        """Hang a picture into space by its four corners, from the upper left clockwise, (4, 3) um."""
        import rerun as rr

        mesh = rr.Mesh3D(
            vertex_positions=corners_um.astype(np.float32),
            triangle_indices=[[0, 1, 2], [0, 2, 3]],
            vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
            albedo_texture=np.repeat(grey[..., None], 3, axis=-1),
        )
        self._log(path, mesh)

    def lines(self, path: str, strips_um: Sequence[Array], colour: Colour, labels: Sequence[str] = ()) -> None:
        """Write broken lines, each (n, 3) um."""
        import rerun as rr

        strips = [strip.astype(np.float32) for strip in strips_um]
        thin = rr.Radius.ui_points(LINE_POINTS)
        self._log(path, rr.LineStrips3D(strips, colors=[colour], labels=labels or None, radii=thin))

    def arrows(
        self, path: str, origins_um: Array, vectors_um: Array, colour: Colour, labels: Sequence[str] = ()
    ) -> None:
        """Write arrows, origins and vectors (n, 3) um."""
        import rerun as rr

        self._log(path, rr.Arrows3D(origins=origins_um, vectors=vectors_um, colors=[colour], labels=labels or None))

    def picture(self, path: str, colours: NDArray[np.uint8]) -> None:
        """Write a picture, (rows, columns) grey or (rows, columns, 3), every pixel as it is.

        Not as JPEG or PNG: the viewer decodes those late, and a window that nothing moves in stays empty.
        """
        import rerun as rr

        self._log(path, rr.Image(colours))

    def marks(self, path: str, xy_px: Array, labels: Sequence[str], colour: Colour) -> None:
        """Write words at places of a picture, (n, 2) px."""
        import rerun as rr

        self._log(path, rr.Points2D(xy_px, labels=labels, colors=[colour], radii=0.5, show_labels=True))

    def series(self, path: str, name: str, colour: Colour, *, line: bool = True) -> None:
        """Say how the numbers of a path are drawn: joined or not, marked either way."""
        import rerun as rr

        if line:
            self._log(path, rr.SeriesLines(colors=colour, names=name, widths=2))
        self._log(path, rr.SeriesPoints(colors=colour, names=name, markers="circle", marker_sizes=4))

    def number(self, path: str, value: float) -> None:
        """Write one number of a series; what is no number is a gap."""
        import rerun as rr

        if np.isfinite(value):
            self._log(path, rr.Scalars(value))

    def text(self, path: str, markdown: str) -> None:
        """Write a document."""
        import rerun as rr

        self._log(path, rr.TextDocument(markdown, media_type="text/markdown"))

    def message(self, path: str, sentence: str) -> None:
        """Write a line of a log."""
        import rerun as rr

        self._log(path, rr.TextLog(sentence, level="WARN"))

    def clear(self, path: str) -> None:
        """Say that from here on there is nothing."""
        import rerun as rr

        self._log(path, rr.Clear(recursive=True))

    def _log(self, path: str, what: Any) -> None:
        self._stream.log(path, what, static=self._always)


def _blueprint(layout: Part, timeline: str) -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        _view(layout),
        rrb.TimePanel(timeline=timeline, state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _view(part: Part) -> Any:
    import rerun.blueprint as rrb

    if isinstance(part, Box):
        return _container(part)
    if isinstance(part, Space):
        x, y, z = part.centre_um
        eye = rrb.EyeControls3D(
            position=(x, y - 1.5 * part.width_um, z + 1.0 * part.width_um),
            look_target=(x, y, z + 0.18 * part.width_um),
            eye_up=(0, 0, 1),
        )
        contents = list(part.contents)
        return rrb.Spatial3DView(origin="world", contents=contents, name=part.name, eye_controls=eye, line_grid=False)
    return _flat(part)


def _flat(part: Flat) -> Any:
    import rerun.blueprint as rrb

    if part.kind == "series":
        return rrb.TimeSeriesView(origin=part.path, name=part.name, plot_legend=rrb.PlotLegend(corner="RightTop"))
    views = {
        "picture": rrb.Spatial2DView,
        "text": rrb.TextDocumentView,
        "log": rrb.TextLogView,
    }
    return views[part.kind](origin=part.path, name=part.name)


def _container(box: Box) -> Any:
    import rerun.blueprint as rrb

    parts, shares = [_view(each) for each in box.parts], list(box.shares) or None
    name = box.name or None
    if box.kind == "across":
        return rrb.Horizontal(*parts, column_shares=shares, name=name)
    if box.kind == "down":
        return rrb.Vertical(*parts, row_shares=shares, name=name)
    if box.kind == "grid":
        return rrb.Grid(*parts, name=name)
    return rrb.Tabs(*parts, active_tab=0, name=name)
