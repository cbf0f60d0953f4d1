"""The physical limit: how well any matching of these pictures could know the depth (Cramer-Rao bound).

A patch of surface has a height z along the beam of the reference view and a texture T of which nothing is known
beforehand. View v shows it as ``lambda_v = r_v T`` electrons at a place that moves by ``d_v = d xy_v / dz`` px/um, and
counts m_v of them (Poisson) for a pixel of the reference view. With ``b_v = d_v . grad(ln lambda_v)`` the Fisher
information of (z, ln T) is ``[[sum m b^2, sum m b], [sum m b, sum m]]``. Eliminating the texture (Schur complement)
leaves for each pixel

    F = sum_v m_v (b_v - mean_m b)^2,

the spread of the views' responses about their mean, weighted by electrons: what moves alike in all views could as well
be texture. Two like views give the known bound of a shift between two noisy patches of N pixels,
``sigma_d >= sqrt(2) sigma_n / (g_rms sqrt(N))``, with ``sigma_n^2 = lambda``.

The ratios r_v count as known. They are not quite: shading changes with tilt, which makes the bound too low for a method
that has no model of it, while one that draws depth from shading itself can go below. At silhouettes the gradient is
partly that of another surface; medians hardly see it. Texture finer than a pixel is aliased and not understood here.
Poses count as known and the offset of all heights as gauge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, map_coordinates, spline_filter
from scipy.optimize import brentq
from scipy.special import erf

from semsim.capture import MAIN, Surfaces
from semsim.charging import charged
from semsim.detector import DetectorOptions, expected_electrons
from semsim.mesh import Array
from semsim.microscope import camera_from_world, pixel_rays, project
from semsim.spot import SpotOptions, blur_by_spot

DARKEST = 1e-3
"""Share of the mean signal below which a pixel is taken for the overshoot of an interpolation."""


@dataclass(frozen=True, eq=False)
class Parallax:
    """What one view says of the height under each pixel of the reference view.

    Parameters
    ----------
    electrons
        m, electrons counted for a reference pixel, as far as their noise is that of counting, (rows, columns); 0 where
        the view does not see the surface.
    response
        b, relative change of the signal with height, 1/um, (rows, columns); 0 where not seen.
    """

    electrons: Array
    response: Array


@dataclass(frozen=True)
class LimitOptions:
    """What an estimator may use.

    Parameters
    ----------
    window_px
        Standard deviation of the Gaussian window in which the height counts as one number; 0 is each pixel alone.
    texture_known
        Whether the noise-free texture is given: the limit of a match with a perfect template, below all others.
    """

    window_px: float = 3.0
    texture_known: bool = False


@dataclass(frozen=True)
class BoundSummary:
    """The limit of a scene over the pixels that all views see.

    Parameters
    ----------
    median_sigma_um
        Median over the pixels of the least standard deviation.
    median_abs_um, rms_um
        Median absolute and root mean square error of normal errors of that size: what the same figures of a method
        are compared with.
    share
        Part of the reference view's pixels that counts here.
    """

    median_sigma_um: float
    median_abs_um: float
    rms_um: float
    share: float

    def efficiency(self, median_abs_error_um: float) -> float:
        """Error over bound: 1 is as good as the light allows, more is worse."""
        return median_abs_error_um / self.median_abs_um


def bound_summary(
    surfaces: Surfaces, options: LimitOptions | None = None, views: Sequence[int] | None = None
) -> BoundSummary:
    """Sum up the limit of a scene over the pixels that all of `views` see."""
    return summary_of(parallaxes(surfaces, views), options or LimitOptions())


def summary_of(seen: Sequence[Parallax], options: LimitOptions) -> BoundSummary:
    """Sum up the limit of views whose parallax is known, over the pixels that all of them see."""
    sigma_um = common_sigma_um(seen, options)
    counted = sigma_um[np.isfinite(sigma_um)]
    if not counted.size:
        return BoundSummary(np.nan, np.nan, np.nan, 0.0)
    return BoundSummary(
        float(np.median(counted)),
        median_abs_of_normals(counted),
        float(np.sqrt(np.mean(counted**2))),
        counted.size / sigma_um.size,
    )


def common_sigma_um(seen: Sequence[Parallax], options: LimitOptions) -> Array:
    """Least standard deviation of height at the pixels that all views see, um, (rows, columns); NaN elsewhere."""
    sigma_um = windowed_sigma_um(depth_information(seen, options), options.window_px)
    common = np.logical_and.reduce([each.electrons > 0 for each in seen])
    return np.where(common, sigma_um, np.nan)


def median_abs_of_normals(sigmas: Array, share: float = 0.5) -> float:
    """Median absolute value (or another quantile) of normal numbers, each with a standard deviation of its own."""
    scale = np.sqrt(2) * np.asarray(sigmas, dtype=np.float64).ravel()
    return float(brentq(lambda t: erf(t / scale).mean() - share, 0.0, 10 * scale.max(), xtol=1e-9 * scale.max()))


def parallaxes(
    surfaces: Surfaces,
    views: Sequence[int] | None = None,
    detector: DetectorOptions | None = None,
    spot: SpotOptions | None = None,
) -> tuple[Parallax, ...]:
    """Work out what each view says: the reference view first, then the others of `views` (all by default).

    Parameters
    ----------
    detector, spot
        Instead of the scene's, as in `semsim.capture.expose`.
    """
    reference = surfaces.scene.schedule.reference
    wanted = range(len(surfaces.truth)) if views is None else views
    read_e = (detector or surfaces.scene.detector).summed_read_noise_e
    return tuple(
        _parallax(surfaces, reference, view, noise_free(surfaces, view, detector, spot), read_e)
        for view in (reference, *(each for each in wanted if each != reference))
    )


def noise_free(
    surfaces: Surfaces, view: int, detector: DetectorOptions | None = None, spot: SpotOptions | None = None
) -> Array:
    """Electrons that the secondary-electron image of a view has on average, (rows, columns)."""
    scene = surfaces.scene
    depth_um = surfaces.truth.buffers[view].depth_um
    rate = blur_by_spot(surfaces.rates[view][MAIN], depth_um, spot or scene.spot, scene.microscope)
    return expected_electrons(charged(rate, scene.charging), detector or scene.detector)


def depth_information(seen: Sequence[Parallax], options: LimitOptions) -> Array:
    """Fisher information of the height under each pixel, 1/um^2, (rows, columns): F of the head of this file."""
    weight, first, second = (
        np.sum([each.electrons * each.response**power for each in seen], axis=0) for power in range(3)
    )
    if options.texture_known:
        return np.asarray(second)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(weight > 0, np.maximum(second - first**2 / weight, 0.0), 0.0))


def windowed_sigma_um(information: Array, window_px: float) -> Array:
    """Least standard deviation of a height that is one number within a Gaussian window, um, (rows, columns).

    An estimate whose pixels count by the window w has the variance ``sum w^2 F / (sum w F)^2``, at best; for an even F
    that is ``1 / (4 pi window^2 F)``, a window of 4 pi window^2 pixels. NaN where there is no information.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if window_px == 0:
            variance = 1 / information
        else:
            squared = gaussian_filter(information, window_px / np.sqrt(2), mode="constant") / (4 * np.pi * window_px**2)
            variance = squared / gaussian_filter(information, window_px, mode="constant") ** 2
    return np.asarray(np.where(information > 0, np.sqrt(variance), np.nan))


def gradient(image: Array) -> Array:
    """Slope of the cubic spline through an image, at its pixels, (rows, columns, 2) along (columns, rows)."""
    coefficients = spline_filter(image, order=3, mode="mirror")
    value, slope = np.array([1.0, 4.0, 1.0]) / 6, np.array([0.5, 0.0, -0.5])
    along = [
        convolve1d(convolve1d(coefficients, slope, axis=axis, mode="mirror"), value, axis=1 - axis, mode="mirror")
        for axis in (1, 0)
    ]
    return np.stack(along, axis=-1)


def _parallax(surfaces: Surfaces, reference: int, view: int, expected_e: Array, read_e: float) -> Parallax:
    """Signal and its response to height, of one view, on the grid of the reference view."""
    truth = surfaces.truth
    there = truth.correspondence(reference, view)
    seen = np.isfinite(there[..., 0])
    at = there[seen][:, ::-1].T
    points = truth.buffers[reference].position_um[seen]
    signal = np.maximum(_sampled(expected_e, at), DARKEST * expected_e.mean())
    moved = motion_px_per_um(surfaces, reference, view)[seen]
    slopes = gradient(expected_e)
    change = sum(moved[:, axis] * _sampled(slopes[..., axis], at) for axis in (0, 1))
    size = _pixels_per_reference_pixel(surfaces, reference, view, points, truth.buffers[reference].normal[seen])
    electrons, response = np.zeros(seen.shape), np.zeros(seen.shape)
    electrons[seen] = size * signal**2 / (signal + read_e**2)
    response[seen] = change / signal
    return Parallax(electrons, response)


def motion_px_per_um(surfaces: Surfaces, reference: int, view: int) -> Array:
    """How far a view sees the surface of each reference pixel move if it rises along the reference beam, px/um."""
    microscope, poses = surfaces.truth.microscope, surfaces.truth.poses
    points = surfaces.truth.buffers[reference].position_um
    here = project(microscope, poses[reference], points)
    up = -pixel_rays(microscope, poses[reference], here)[1]
    step = microscope.pixel_size_um
    higher, lower = (project(microscope, poses[view], points + sign * step * up) for sign in (1, -1))
    return np.asarray((higher - lower) / (2 * step))


def _pixels_per_reference_pixel(surfaces: Surfaces, reference: int, view: int, points: Array, normals: Array) -> Array:
    """How many pixels of a view show the surface that one pixel of the reference view shows, (points,).

    An element of surface covers ``|n . r| |det D| / (pixel (1 + k z))^2`` pixels, r the beam that passes 1 um of depth.
    """
    covered = []
    for each in (view, reference):
        microscope, pose = surfaces.truth.microscope, surfaces.truth.poses[each]
        beam = pixel_rays(microscope, pose, project(microscope, pose, points))[1]
        enlarged = 1 + microscope.inverse_working_distance * camera_from_world(pose, points)[:, 2]
        facing = np.maximum(-np.sum(normals * beam, axis=1), 1e-3)  # shading normals may look away from the beam
        covered.append(facing * abs(np.linalg.det(pose.distortion)) / enlarged**2)
    return np.asarray(covered[0] / covered[1])


def _sampled(image: Array, rows_columns: Array) -> Array:
    return np.asarray(map_coordinates(image, rows_columns, order=3, mode="mirror"))
