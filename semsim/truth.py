"""The exact answer to what a reconstruction is asked: where the surface is, and which view sees what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world, pixel_rays, project
from semsim.raycast import RayCaster
from semsim.surface import SurfaceBuffer

TOLERANCE_PX = 1e-3
"""How far along the beam a point may lie from what the beam meets first and still be that, in pixel sizes."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A mesh, the views of it, and the surface under each pixel.

    Parameters
    ----------
    mesh
        The specimen at zero tilt, world frame.
    microscope
        Pixel grid and projection.
    poses
        True pose of each view.
    buffers
        Surface under each pixel of each view.
    """

    mesh: Mesh
    microscope: Microscope
    poses: tuple[Pose, ...]
    buffers: tuple[SurfaceBuffer, ...]

    def __len__(self) -> int:
        return len(self.poses)

    def surface_at(self, view: int, xy_px: Array) -> Array:
        """World points (..., 3), um, that a view sees at image positions (..., 2), px; NaN for a miss."""
        return RayCaster(self.mesh).cast(*pixel_rays(self.microscope, self.poses[view], np.asarray(xy_px))).position_um

    def height_map(self, view: int) -> Array:
        """Elevation in the view frame, um, (rows, columns): up the beam, world z at zero tilt, NaN for a miss."""
        return np.asarray(self.buffers[view].position_um @ self.poses[view].view_from_world[2])

    def correspondence(self, i: int, j: int) -> Array:
        """Where view j sees the surface of each pixel of view i: (rows, columns, 2), px; NaN if it does not."""
        projected = project(self.microscope, self.poses[j], self.buffers[i].position_um)
        return np.where(self.visibility(i, j)[..., None], projected, np.nan)

    def visibility(self, i: int, j: int) -> NDArray[np.bool_]:
        """Whether view j sees, inside its frame, the surface of each pixel of view i: (rows, columns)."""
        if i == j:
            return ~self.buffers[i].miss
        return self.visible(j, self.buffers[i].position_um)

    def visible(self, view: int, xyz_um: Array) -> NDArray[np.bool_]:
        """Whether a view sees points of the surface: in its frame, and the first that the beam meets there.

        What is edge-on to the beam is not seen.

        Parameters
        ----------
        xyz_um
            (..., 3) world; NaN is not visible.
        """
        seen = self._in_frame(project(self.microscope, self.poses[view], xyz_um))
        points = xyz_um[seen]
        first = self.surface_at(view, project(self.microscope, self.poses[view], points))
        apart = (camera_from_world(self.poses[view], points) - camera_from_world(self.poses[view], first))[:, 2]
        seen[seen] = np.abs(apart) < TOLERANCE_PX * self.microscope.pixel_size_um  # false for a ray that slips past
        return seen

    def _in_frame(self, xy_px: Array) -> NDArray[np.bool_]:
        limit = np.array([self.microscope.width_px, self.microscope.height_px]) - 0.5
        return np.asarray(((xy_px >= -0.5) & (xy_px <= limit)).all(axis=-1))
