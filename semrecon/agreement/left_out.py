"""A surface judged without truth: the picture of a view that the method was not given, predicted from the surface.

A method reconstructs from all views but one. The pictures of the views used are painted on its surface, and what the
view left out should see of the paint is compared with what it does see. A wrong height lands beside the right spot.

Nobody can predict how the stage and the beam shifted for the view left out, nor its gain and offset of grey values:
these are fitted to it, for every method alike. Its tilt is as stated: fitted, it would hide a wrong scale of heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from semrecon.agreement.left_out_camera import (
    Free,
    InPlane,
    Paint,
    Sight,
    centre_of,
    fit_in_plane,
    sight_of,
    target_of,
    visible,
)
from semrecon.agreement.left_out_score import Prediction, slow_window_px
from semrecon.agreement.left_out_windows import noise_left, smoothed
from semrecon.data import Array, Mask, Poses, TiltSeries, View
from semrecon.dense.pictures import NoiseModel, filled, noise_model, shrunk
from semrecon.errors import InputError, MethodError
from semrecon.geometry import nominal_poses
from semrecon.matches.features import usable_pixels
from semrecon.methods.base import Method
from semrecon.pipeline import Progress, reconstruct
from semrecon.pose.orientation import oriented
from semrecon.reconstruction import Reconstruction

AXIS_STREAM = 1
"""Sets the random choices of the axis apart from those of the method."""


@dataclass(frozen=True)
class LeftOut:
    """Prediction of one view from the surface of one method.

    Parameters
    ----------
    method
        Its name.
    view
        Name of the view left out.
    tilt_deg
        As stated.
    prediction
        Both pictures.
    in_plane
        What was fitted to the view left out.
    """

    method: str
    view: str
    tilt_deg: float
    prediction: Prediction
    in_plane: InPlane


@dataclass(frozen=True)
class Photo:
    """A view made ready for sampling."""

    picture: Array
    valid: Mask
    readable: Mask
    coefficients: Array
    noise: NoiseModel

    @property
    def whole(self) -> Paint:
        """Grey values and where they may be used."""
        return Paint(self.picture, self.valid)


def without(series: TiltSeries, view: int) -> TiltSeries:
    """Take one view out of a series; raises `InputError` where fewer than two would stay."""
    if len(series) < 3:
        raise InputError(f"to leave a view out takes three views or more, not {len(series)}")
    return series.select(*(other for other in range(len(series)) if other != view))


def leave_out(
    series: TiltSeries,
    view: int,
    methods: Sequence[Method],
    *,
    free: Free = "shift",
    seed: int = 0,
    axis_stated: bool = True,
    progress: Progress | None = None,
) -> tuple[LeftOut | str, ...]:
    """Predict one view by each of several methods from the others.

    Parameters
    ----------
    view
        Index of the view left out.
    free
        What is fitted in the image plane of the view left out: its shift, or magnification and rotation as well. Both
        are alike for all methods; the latter can hide part of a tilted plane.
    seed
        Of the methods' random choices.
    axis_stated
        Whether anybody stated the tilt axis; if not, it is found from the views used, once for all methods.

    Returns
    -------
    A prediction of each method, or the sentence with which it failed.

    Raises
    ------
    InputError
        The series has too few views.
    """
    used = without(series, view)
    if not axis_stated:
        used, _ = oriented(used, False, np.random.default_rng([seed, AXIS_STREAM]))
    found: list[LeftOut | str] = []
    for method in methods:
        tell = None if progress is None else _under(progress, f"{series.views[view].name}: {method.name}")
        try:
            result = reconstruct(used, method, seed=seed, progress=tell)
            found.append(predict(result, series.views[view], free=free, tilt_axis_deg=used.tilt_axis_deg))
        except (InputError, MethodError) as error:
            found.append(str(error))
    return tuple(found)


def predict(
    result: Reconstruction, left_out: View, *, free: Free = "shift", tilt_axis_deg: float | None = None
) -> LeftOut:
    """Predict a picture that a reconstruction was not given.

    Parameters
    ----------
    result
        Made from other views.
    left_out
        The view to predict; its picture serves to fit `free`, gain and offset, and to compare.
    tilt_axis_deg
        About which the view was tilted; that of the reconstructed series by default.

    Raises
    ------
    InputError
        The view left out is blank.
    MethodError
        The surface has no height where the views used have a picture.
    """
    photo = photo_of(left_out)
    if not photo.valid.any():
        raise InputError(f"{left_out.name or 'the view left out'} has no pixel to predict: it is blank or masked")
    series = result.series
    if tilt_axis_deg is not None:
        series = replace(series, tilt_axis_deg=tilt_axis_deg)
    z_um = result.heights.z_um
    paint, noise = _painted(z_um, series, result.estimate.poses or nominal_poses(series))
    reference = nominal_poses(series.select(series.reference)).rotations[0]
    own = nominal_poses(replace(series, views=(left_out,))).rotations[0]
    sight = sight_of(z_um, own @ reference.T, series.optics)
    in_plane = fit_in_plane(target_of(Paint(np.nan_to_num(paint), np.isfinite(paint))), photo.whole, sight, free)
    true, noise_true = _seen(photo, sight, in_plane)
    return LeftOut(
        result.method, left_out.name, left_out.tilt_deg, Prediction(paint, true, noise, noise_true), in_plane
    )


def photo_of(view: View) -> Photo:
    """Make a view ready for sampling by cubic B-spline; gaps are filled from around them and marked."""
    valid = usable_pixels(view)
    picture = filled(np.asarray(view.image, dtype=np.float64), valid) if valid.any() else np.zeros(valid.shape)
    coefficients = ndimage.spline_filter(picture, order=3, mode="mirror")
    noise = noise_model(picture, valid) if valid.any() else NoiseModel(0.0, 0.0, 0.0)
    return Photo(picture, valid, shrunk(valid), coefficients, noise)


def _painted(z_um: Array, series: TiltSeries, poses: Poses) -> tuple[Array, Array]:
    """Mean picture of the surface by all views that see it, and the variance of its noise; NaN where none does.

    Each view is brought to the slow brightness and contrast of the reference view first. Its rotation is the method's
    own where it answers one, and its motion in the plane is fitted.
    """
    reference = series.reference
    first = photo_of(series.views[reference])
    have = np.isfinite(z_um) & first.valid
    total, count = np.where(have, first.picture, 0.0), have.astype(np.float64)
    noise = np.where(have, _variance(first.noise, first.picture), 0.0)
    target = target_of(Paint(first.picture, have))
    for view in range(len(series)):
        if view == reference:
            continue
        photo = photo_of(series.views[view])
        relative = poses.rotations[view] @ poses.rotations[reference].T
        sight = sight_of(z_um, relative, series.optics)
        in_plane = fit_in_plane(target, photo.whole, sight, "similarity")
        grey, variance = _seen(photo, sight, in_plane)
        grey, gain = _matched(grey, first.picture, have)
        seen = np.isfinite(grey)
        total[seen] += grey[seen]
        noise[seen] += gain[seen] ** 2 * variance[seen]
        count += seen
    known = count > 0
    many = np.where(known, count, np.nan)
    return np.where(known, total / many, np.nan), noise / many**2


def _seen(photo: Photo, sight: Sight, in_plane: InPlane) -> tuple[Array, Array]:
    """Grey values of a view at the places where it sees the surface, and the variance of their noise; else NaN."""
    xy = in_plane.apply(sight.xy_px, centre_of(photo.picture))
    seen = visible(xy, sight.elevation_px)
    x, y = np.rint(np.where(seen[..., None], xy, 0.0)).astype(np.int64).reshape(-1, 2).T
    seen &= photo.readable[y, x].reshape(seen.shape)
    grey, noise = np.full(seen.shape, np.nan), np.full(seen.shape, np.nan)
    grey[seen] = ndimage.map_coordinates(photo.coefficients, xy[seen].T[::-1], order=3, mode="mirror", prefilter=False)
    noise[seen] = _variance(photo.noise, grey[seen]) * noise_left(xy[seen])
    return grey, noise


def _matched(grey: Array, first: Array, have: Mask) -> tuple[Array, Array]:
    """Bring slow brightness and contrast of a sampled view to those of the reference view; also tells the gain."""
    both = have & np.isfinite(grey)
    window = slow_window_px(grey.shape)
    values = np.where(both, grey, 0.0)
    mean, mean_first = smoothed(values, both, window), smoothed(first, both, window)
    spread, spread_first = (
        np.sqrt(smoothed((one - middle) ** 2, both, window)) for one, middle in ((values, mean), (first, mean_first))
    )
    gain = np.where(spread > 0, spread_first / np.maximum(spread, 1e-9), 1.0)
    return mean_first + gain * (grey - mean), gain


def _variance(noise: NoiseModel, grey: Array) -> Array:
    return np.asarray(noise.gain * np.maximum(grey - noise.dark, 0.0) + noise.floor)


def _under(progress: Progress, title: str) -> Progress:
    return lambda stage: progress(f"{title}: {stage}")
