"""What the images of a tilt series do not say, whatever their number, in sentences."""

from __future__ import annotations

import numpy as np

from semrecon.adjustment.refinement_options import RefinementOptions
from semrecon.data import Array

SHOWN = 5.0
"""Standard deviations from which the images tell the sign of the relief."""
HARDLY = 0.9
"""Posterior over prior sigma above which it is the stage that speaks, not the images."""


def unobservable(
    tilts_rad: Array,
    tilt_covariance_deg2: Array,
    reference: int,
    options: RefinementOptions,
    *,
    perspective: bool = False,
    keystone: float = 0.0,
) -> tuple[str, ...]:
    """Say which freedoms the images leave open, and what holds each of them.

    Parameters
    ----------
    tilts_rad
        As the stage states them, (views,).
    tilt_covariance_deg2
        Posterior, (views, views).
    perspective
        Whether the projection has a working distance.
    keystone
        How many standard deviations lie between the images and those of the mirrored relief (`keystone_sigmas`).
    """
    prior = f"the stage's tilts (sigma {options.tilt_sigma_deg:g} degrees each)" if options.tilts else "the tilts given"
    said = [
        f"the place of the whole: shift 0 in view {reference}, median depth 0 along its beam",
        f"the overall magnification: the pixel size as stated, in view {reference}",
        f"the overall rotation in the plane: 0 in view {reference}",
        f"the mean tilt: {prior}",
    ]
    if keystone < SHOWN:
        said.append("the sign of the relief (Necker): the sign of the tilts as given")
    if perspective:
        meant = "taken for a change of its magnification" if options.magnifications else "not looked for"
        said.append(f"the shift of a view along the beam: t_z = 0, and what there is of it is {meant}")
    share = step_share(tilts_rad, tilt_covariance_deg2, options.tilt_sigma_deg)
    if options.tilts and share > HARDLY:
        said.append(f"the tilt steps, and with them the scale of depth: {prior}, as the images add next to nothing")
    return tuple(said)


def keystone_sigmas(xyz_um: Array, tilts_rad: Array, axis_rad: float, k: float, sigma_um: float) -> float:
    """Tell by how many standard deviations the images differ from those of the mirrored relief and tilts.

    Parallel projection cannot tell the two. Under perspective the edge that a tilt lowers is seen smaller, whatever the
    relief: a point at u across and v along the axis moves by ``k u v sin(tilt)`` along it, where depth shows nothing.

    Parameters
    ----------
    xyz_um
        Points, (points, 3); those that are not finite do not count.
    k
        Inverse working distance, 1/um.
    sigma_um
        Noise of a sighting.
    """
    known = xyz_um[np.isfinite(xyz_um).all(axis=1), :2]
    if not len(known):
        return 0.0
    along, across = known @ [np.sin(axis_rad), np.cos(axis_rad)], known @ [np.cos(axis_rad), -np.sin(axis_rad)]
    product = (along - along.mean()) * (across - across.mean())
    turns = np.sin(tilts_rad - tilts_rad.mean())
    return float(2 * k / sigma_um * np.linalg.norm(product - product.mean()) * np.linalg.norm(turns))


def step_share(tilts_rad: Array, tilt_covariance_deg2: Array, tilt_sigma_deg: float) -> float:
    """Posterior over prior sigma of the spread of the tilts: 1 where the images say nothing of the scale of depth."""
    direction = tilts_rad - tilts_rad.mean()
    direction = direction / max(float(np.linalg.norm(direction)), np.finfo(float).tiny)
    return float(np.sqrt(max(direction @ tilt_covariance_deg2 @ direction, 0.0)) / tilt_sigma_deg)
