"""The exact answer to what a reconstruction is asked: where the surface is, and which view sees what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world, pixel_rays, project
from semsim.raycast import RayCaster
from semsim.recorded import offset_at, recorded_at
from semsim.surface import SurfaceBuffer

TOLERANCE_PX = 1e-3
"""How far along the beam a point may lie from what the beam meets first and still be that, in pixel sizes."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A mesh, the views of it, and the surface under each pixel.

    Image positions, given or returned, are those of the recorded picture: errors of column and scan are part of them.

    Parameters
    ----------
    mesh
        The specimen at zero tilt, world frame.
    microscope
        Pixel grid and projection.
    poses
        True pose and distortion of each view.
    buffers
        Surface under each pixel of each view.
    scan_offsets_px
        Displacement of the beam from each pixel, (rows, columns, 2) a view; empty for a perfect scan.
    """

    mesh: Mesh
    microscope: Microscope
    poses: tuple[Pose, ...]
    buffers: tuple[SurfaceBuffer, ...]
    scan_offsets_px: tuple[Array, ...] = ()

    def __len__(self) -> int:
        return len(self.poses)

    def surface_at(self, view: int, xy_px: Array) -> Array:
        """World points (..., 3), um, that a view sees at image positions (..., 2), px; NaN for a miss."""
        xy = np.asarray(xy_px, dtype=np.float64)
        beam = xy + offset_at(self.scan_offsets_px[view], xy) if self.scan_offsets_px else xy
        return self._under_beam(view, beam)

    def image_of(self, view: int, xyz_um: Array) -> Array:
        """Image positions (..., 2), px, at which a view records world points (..., 3), seen or not; NaN if nowhere."""
        beam = project(self.microscope, self.poses[view], xyz_um)
        return recorded_at(self.scan_offsets_px[view], beam) if self.scan_offsets_px else beam

    def normals(self, view: int) -> Array:
        """Turn normals into the view frame (x right, y up, z to the gun): (rows, columns, 3), unit; NaN for a miss."""
        return np.asarray(self.buffers[view].normal @ self.poses[view].view_from_world.T)

    def height_map(self, view: int) -> Array:
        """Elevation in the view frame, um, (rows, columns): up the beam, world z at zero tilt, NaN for a miss."""
        return np.asarray(self.buffers[view].position_um @ self.poses[view].view_from_world[2])

    def correspondence(self, i: int, j: int) -> Array:
        """Where view j sees the surface of each pixel of view i: (rows, columns, 2), px; NaN if it does not."""
        points = self.buffers[i].position_um
        there = self.image_of(j, points)
        seen = ~self.buffers[i].miss if i == j else self._seen(j, points, there)
        return np.where(seen[..., None], there, np.nan)

    def visibility(self, i: int, j: int) -> NDArray[np.bool_]:
        """Whether view j sees, inside its frame, the surface of each pixel of view i: (rows, columns)."""
        if i == j:
            return ~self.buffers[i].miss
        return self.visible(j, self.buffers[i].position_um)

    def covisibility(self) -> Array:
        """Share of the surface seen by view i (row) that view j (column) sees too, (views, views).

        The share is of pixels; the diagonal is 1, and a view that sees nothing has a row of NaN.
        """
        views = range(len(self))
        seen = np.array([[self.visibility(i, j).sum() for j in views] for i in views], dtype=np.float64)
        with np.errstate(invalid="ignore"):
            return np.asarray(seen / np.diag(seen)[:, None])

    def visible(self, view: int, xyz_um: Array) -> NDArray[np.bool_]:
        """Whether a view sees points of the surface: in its frame, and the first that the beam meets there.

        What is edge-on to the beam is not seen.

        Parameters
        ----------
        xyz_um
            (..., 3) world; NaN is not visible.
        """
        return self._seen(view, xyz_um, self.image_of(view, xyz_um))

    def _seen(self, view: int, xyz_um: Array, there_px: Array) -> NDArray[np.bool_]:
        seen = self._in_frame(there_px)
        points = xyz_um[seen]
        first = self._under_beam(view, project(self.microscope, self.poses[view], points))
        apart = (camera_from_world(self.poses[view], points) - camera_from_world(self.poses[view], first))[:, 2]
        seen[seen] = np.abs(apart) < TOLERANCE_PX * self.microscope.pixel_size_um  # false for a ray that slips past
        return seen

    def _under_beam(self, view: int, beam_px: Array) -> Array:
        return RayCaster(self.mesh).cast(*pixel_rays(self.microscope, self.poses[view], beam_px)).position_um

    def _in_frame(self, xy_px: Array) -> NDArray[np.bool_]:
        limit = np.array([self.microscope.width_px, self.microscope.height_px]) - 0.5
        return np.asarray(((xy_px >= -0.5) & (xy_px <= limit)).all(axis=-1))
