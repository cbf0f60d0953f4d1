"""How many electrons each beam position sends to the detectors, before any noise.

Every effect is a function of its own and a factor of `secondary_rate`, with an off value that makes it one everywhere;
docs/physics.md has the source and range of each. Drift, vibration and line jitter are none of them: they displace the
beam before the rays are cast. Charging is none either: it follows the beam, see `semsim.charging`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from semsim.backscatter import BackscatterOptions, backscatter_rates
from semsim.bands import in_bands
from semsim.edge import edge_glow, edge_response
from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world
from semsim.shadowing import sky_visibility
from semsim.surface import SurfaceBuffer, interpolate

Detector = Literal["everhart-thornley", "in-lens"]
DETECTORS: tuple[str, ...] = get_args(Detector)
IN_LENS_EDGE_GAIN = 1.5
"""An in-lens detector keeps what the beam itself sets free and drops what comes back from the chamber's walls."""


@dataclass(frozen=True)
class SignalOptions:
    """Contrast mechanisms of the secondary-electron signal, and the backscatter channels where there are any.

    Parameters
    ----------
    yield_exponent
        n of the yield sec(phi)^n: about 0.8 for heavy and 1.2 for light elements; 0 switches it off.
    max_yield
        Upper bound of the yield, relative to normal incidence: the secant has none, a surface does.
    edge_strength
        Gain where all of the material within the escape depth is missing, from 0 (off); an upright edge has half of it.
    escape_depth_um
        How far below the surface electrons that still get out are set free: the width of bright edges.
    detector
        "everhart-thornley": at one side, with some light in the shadows. "in-lens": round the beam, so no side is
        favoured; edges are stronger and closed-in places darker.
    detector_azimuth_deg
        Direction towards the side detector in the image, counter-clockwise from right: 90 is up.
    asymmetry
        How much brighter a surface facing the side detector is, from 0 (off) to 1.
    shadowing
        Share of the signal that a closed-in place loses, from 0 (off) to 1.
    shadow_reach_um
        How far around a place walls are looked for, um.
    background
        Rate where the beam misses the specimen.
    backscatter
        Channels of a backscatter detector at the same pose; none by default.

    Raises
    ------
    InputError
        A value outside its range.
    """

    yield_exponent: float = 1.0
    max_yield: float = 2.5
    edge_strength: float = 1.0
    escape_depth_um: float = 0.3
    detector: Detector = "everhart-thornley"
    detector_azimuth_deg: float = 60.0
    asymmetry: float = 0.3
    shadowing: float = 0.8
    shadow_reach_um: float = 8.0
    background: float = 0.15
    backscatter: BackscatterOptions | None = None

    def __post_init__(self) -> None:
        _require("yield_exponent", self.yield_exponent, 0.0, 10.0)
        _require("max_yield", self.max_yield, 1.0, 1e6)
        _require("edge_strength", self.edge_strength, 0.0, 100.0)
        _require("escape_depth_um", self.escape_depth_um, 0.0, 1e3)
        _require("detector_azimuth_deg", self.detector_azimuth_deg, -360.0, 360.0)
        _require("asymmetry", self.asymmetry, 0.0, 1.0)
        _require("shadowing", self.shadowing, 0.0, 1.0)
        _require("shadow_reach_um", self.shadow_reach_um, 0.0, 1e6)
        _require("background", self.background, 0.0, 1e6)
        if self.detector not in DETECTORS:
            raise InputError(f"signal option detector must be one of {', '.join(DETECTORS)}, not {self.detector!r}")


def electron_rates(
    buffer: SurfaceBuffer, pose: Pose, options: SignalOptions, mesh: Mesh, microscope: Microscope
) -> dict[str, Array]:
    """Work out the electrons detected per incident electron in every channel, relative to a level flat sheet.

    Returns
    -------
    (rows, columns) each. "se" comes first; then, where there is a backscatter detector, its segments and their sum
    "bse". `options.background` stands where the beam misses.
    """
    rates = {"se": secondary_rate(buffer, pose, options, mesh, microscope)}
    if options.backscatter is None:
        return rates
    ring = (mesh, microscope.pixel_size_um, options.background)
    return rates | backscatter_rates(buffer, pose, options.backscatter, *ring)


def secondary_rate(
    buffer: SurfaceBuffer, pose: Pose, options: SignalOptions, mesh: Mesh, microscope: Microscope
) -> Array:
    """Multiply the effects on secondary electrons, (rows, columns)."""
    options = as_seen(options)
    rate = np.empty(buffer.depth_um.shape)
    in_bands(
        len(rate), lambda start, stop: _local_effects(slice(start, stop), buffer, pose, options, mesh, microscope, rate)
    )
    if options.edge_strength > 0:
        glow = edge_glow(buffer, pose, microscope.pixel_size_um, options.escape_depth_um)
        rate *= edge_response(glow, options.edge_strength)
    if options.shadowing > 0:
        sky = sky_visibility(buffer, mesh, microscope.pixel_size_um, options.shadow_reach_um)
        rate *= shadow_response(sky, options.shadowing)
    rate[buffer.miss] = options.background
    return rate


def as_seen(options: SignalOptions) -> SignalOptions:
    """Turn an in-lens detector into the strengths of the effects that it shows; a side detector shows them as stated.

    No side is favoured, edges gain by `IN_LENS_EDGE_GAIN`, and of the light that is left in a closed-in place, which
    comes from the chamber's walls, only the square: ``1 - (1 - shadowing)^2`` is lost.
    """
    if options.detector == "everhart-thornley":
        return options
    return replace(
        options,
        asymmetry=0.0,
        edge_strength=IN_LENS_EDGE_GAIN * options.edge_strength,
        shadowing=1.0 - (1.0 - options.shadowing) ** 2,
    )


def _local_effects(
    rows: slice,
    buffer: SurfaceBuffer,
    pose: Pose,
    options: SignalOptions,
    mesh: Mesh,
    microscope: Microscope,
    rate: Array,
) -> None:
    """Fill rows of `rate` with the effects that need no neighbours, which bounds the memory in use."""
    part = SurfaceBuffer(
        depth_um=buffer.depth_um[rows],
        position_um=buffer.position_um[rows],
        normal=buffer.normal[rows],
        face=buffer.face[rows],
    )
    rate[rows] = secant_yield(cos_incidence(part, pose, microscope), options.yield_exponent, options.max_yield)
    if options.asymmetry > 0:
        azimuth = np.deg2rad(options.detector_azimuth_deg)
        rate[rows] *= side_detector_response(part.normal @ pose.view_from_world.T, azimuth, options.asymmetry)
    if mesh.vertex_yield is not None:
        rate[rows] *= interpolate(mesh, mesh.vertex_yield, part.face, part.position_um)


def cos_incidence(buffer: SurfaceBuffer, pose: Pose, microscope: Microscope) -> Array:
    """Cosine of the angle between the beam and the inward normal, (rows, columns), 0 where it would be negative."""
    if microscope.inverse_working_distance == 0:
        return np.asarray(np.clip(-(buffer.normal @ pose.rotation[2]), 0.0, 1.0))
    beam = camera_from_world(pose, buffer.position_um) * microscope.inverse_working_distance
    beam[..., 2] += 1.0  # from the pivot at (0, 0, -1/k)
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
