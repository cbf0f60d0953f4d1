"""How many secondary electrons each beam position sends to the detector, before any noise.

Every effect is a function of its own and a factor of `electron_rate`, with an off value that makes it one everywhere.
Edge glow, charging and backscatter quadrants belong here as further factors; drift, vibration and line jitter do not:
they displace the array of `microscope.pixel_grid` before the rays are cast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world
from semsim.surface import SurfaceBuffer, interpolate


@dataclass(frozen=True)
class SignalOptions:
    """Contrast mechanisms of the secondary-electron signal.

    Parameters
    ----------
    yield_exponent
        n of the yield sec(phi)^n: about 0.8 for heavy and 1.2 for light elements; 0 switches it off.
    max_yield
        Upper bound of the yield, relative to normal incidence: the secant has none, a surface does.
    detector_azimuth_deg
        Direction towards the side detector in the image, counter-clockwise from right: 90 is up.
    asymmetry
        How much brighter a surface facing the detector is, from 0 (off) to 1.
    shadowing
        Share of the signal that a closed-in place loses, from 0 (off) to 1.
    shadow_reach_um
        How far around a place walls are looked for, um.
    background
        Rate where the beam misses the specimen.

    Raises
    ------
    InputError
        A value outside its range.
    """

    yield_exponent: float = 1.0
    max_yield: float = 2.5
    detector_azimuth_deg: float = 60.0
    asymmetry: float = 0.3
    shadowing: float = 0.8
    shadow_reach_um: float = 8.0
    background: float = 0.15

    def __post_init__(self) -> None:
        _require("yield_exponent", self.yield_exponent, 0.0, 10.0)
        _require("max_yield", self.max_yield, 1.0, 1e6)
        _require("detector_azimuth_deg", self.detector_azimuth_deg, -360.0, 360.0)
        _require("asymmetry", self.asymmetry, 0.0, 1.0)
        _require("shadowing", self.shadowing, 0.0, 1.0)
        _require("shadow_reach_um", self.shadow_reach_um, 0.0, 1e6)
        _require("background", self.background, 0.0, 1e6)


def electron_rate(
    buffer: SurfaceBuffer, pose: Pose, options: SignalOptions, mesh: Mesh, microscope: Microscope
) -> Array:
    """Work out the electrons detected per incident electron, relative to a flat sheet that faces the beam.

    Returns
    -------
    (rows, columns); `options.background` where the beam misses.
    """
    rate = secant_yield(cos_incidence(buffer, pose, microscope), options.yield_exponent, options.max_yield)
    rate *= side_detector_response(
        buffer.normal @ pose.view_from_world.T, np.deg2rad(options.detector_azimuth_deg), options.asymmetry
    )
    if mesh.vertex_yield is not None:
        rate *= interpolate(mesh, mesh.vertex_yield, buffer.face, buffer.position_um)
    if options.shadowing > 0:
        from semsim.shadowing import sky_visibility

        sky = sky_visibility(buffer, pose, microscope.pixel_size_um, options.shadow_reach_um)
        rate *= shadow_response(sky, options.shadowing)
    return np.where(buffer.miss, options.background, rate)


def cos_incidence(buffer: SurfaceBuffer, pose: Pose, microscope: Microscope) -> Array:
    """Cosine of the angle between the beam and the inward normal, (rows, columns), 0 where it would be negative."""
    beam = camera_from_world(pose, buffer.position_um) * microscope.inverse_working_distance
    beam[..., 2] += 1.0  # from the pivot at (0, 0, -1/k); straight down where k = 0
    beam /= np.linalg.norm(beam, axis=-1, keepdims=True)
    cosine = -np.einsum("...i,...i->...", beam, buffer.normal @ pose.rotation.T)
    return np.asarray(np.clip(cosine, 0.0, 1.0))


def secant_yield(cos_incidence: Array, exponent: float, max_yield: float) -> Array:
    """Bounded secant law ``min(cos(phi)^-n, max_yield)``; exponent 0 gives one everywhere.

    Parameters
    ----------
    cos_incidence
        (...,) cosine of the angle phi between beam and normal, 0 to 1.
    """
    floor = max_yield ** (-1.0 / exponent) if exponent > 0 else 1.0
    return np.asarray(np.maximum(cos_incidence, floor) ** -exponent)


def side_detector_response(normal: Array, azimuth_rad: float, asymmetry: float) -> Array:
    """Response of a detector at one side, ``1 + asymmetry * (normal . direction to it)``; asymmetry 0 gives one.

    Parameters
    ----------
    normal
        (..., 3) unit normals in the view frame (x right, y up, z to the gun): the detector does not tilt.
    azimuth_rad
        Direction towards the detector, counter-clockwise from image right.
    """
    return np.asarray(1.0 + asymmetry * (normal[..., 0] * np.cos(azimuth_rad) + normal[..., 1] * np.sin(azimuth_rad)))


def shadow_response(sky_visibility: Array, shadowing: float) -> Array:
    """Share of the electrons that leave a hollow: ``1 - shadowing * (1 - sky_visibility)``."""
    return np.asarray(1.0 - shadowing * (1.0 - sky_visibility))


def _require(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"signal option {name} must lie between {low:g} and {high:g}, not {value}")
