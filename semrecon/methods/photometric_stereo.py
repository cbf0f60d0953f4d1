"""Photometric stereo: three or more detectors look at one view, each from its side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from semrecon.data import Array, Estimate, HeightMap, Mask, TiltSeries, View
from semrecon.errors import InputError, MethodError
from semrecon.methods.base import Gauge, Need
from semrecon.photometry.bas_relief import integrable, three_factors, with_a_sign
from semrecon.photometry.integration import IntegrationOptions, integrate_slopes
from semrecon.photometry.photometric import fit_normals, slopes, usable, with_ambient
from semrecon.photometry.reflectance_map import ReflectanceMap, load

LEAST_SHARE = 0.01
"""Share of the pixels with a slope below which there is no answer."""


@dataclass(frozen=True)
class PhotometricStereo:
    """Normals from channels whose directions are known, then heights.

    Lambert's law with a yield that may differ from place to place (Woodham 1980) and a constant, Basri and Jacobs'
    harmonics of the first order. For detectors opposite each other and no constant this is the symmetric ratio that
    Slowko and Paluszynski use on backscattered electrons. With `calibration` no law is assumed: normals are looked up
    in what a body of known shape gave, as by Ikeuchi (1981). Shadows are met as in Barsky and Petrou (2003), steps as
    in Durou et al. (2009).

    Of Goldman et al. (2010) one thing is represented: each pixel has an albedo of its own, which cancels. Their blend
    of a few materials, each with a gloss of its own, is not: it has six unknowns a pixel beside the normal's two, and
    four detectors give four numbers.

    The scale of the heights rests on the mean elevation of the detectors, on the law of emission and on the black level
    of the amplifiers, none of which the pictures tell; so it is declared unobservable. The plane is observed, as long
    as the channels share one amplifier setting.

    Parameters
    ----------
    channels
        Names of the channels to use; empty is all whose direction is known.
    elevation_deg
        Taken for detectors whose elevation is not known: angle above the image plane.
    black_level
        Grey value of no electron, the same in all channels.
    ambient
        Constant in the signals, as a share of the rest of them at a level place: what an amplifier adds, and what comes
        from all sides. Nothing in the channels of detectors of one elevation tells it, as the yield itself grows with
        the tilt. On simulated development scenes 0.12 costs no scene more than 3 % over 0, which is Lambert's law
        alone, and gains up to 8 %; 0.3 is better by up to a fifth on fractures, balls and stairs, and worse by 7 and 14
        % on sand and smooth faces.
    calibration
        File of a measured reflectance map (`semrecon.photometry.reflectance_map`), recorded at the same settings; it
        takes the place of directions and constant. Empty is none.
    reject_sigmas
        Misfit, in robust standard deviations, from which a channel is left out at a pixel.
    integration
        How slopes become heights.
    """

    channels: tuple[str, ...] = ()
    elevation_deg: float = 45.0
    black_level: float = 0.0
    ambient: float = 0.12
    calibration: str = ""
    reject_sigmas: float = 5.0
    integration: IntegrationOptions = field(default_factory=IntegrationOptions)

    name: ClassVar[str] = "photometric_stereo"
    citation: ClassVar[str] = (
        "Ikeuchi 1981; Woodham 1980; Goldman et al. 2010; Basri and Jacobs 2003; Paluszynski and Slowko 2005"
    )
    needs: ClassVar[tuple[Need, ...]] = ("channels", "pixel_size")
    views: ClassVar[tuple[int, int | None]] = (1, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "scale")

    def __post_init__(self) -> None:
        if not 0 < self.elevation_deg < 90:
            raise InputError(f"option elevation_deg must lie between 0 and 90, not {self.elevation_deg:g}")
        if not 0 <= self.ambient < 1:
            raise InputError(f"option ambient must be at least 0 and less than 1, not {self.ambient:g}")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:  # noqa: ARG002 - nothing is drawn
        """Reconstruct from the reference view; raises `MethodError` with a sentence where it cannot."""
        view = series.views[series.reference]
        if self.calibration:
            return self._looked_up(series, view, load(Path(self.calibration)))
        names = self.channels or tuple(name for name in view.channels if name in series.channel_geometry)
        unknown = [name for name in names if name not in series.channel_geometry]
        if unknown:
            raise MethodError(f"nobody says where the detector of channel {unknown[0]} sits; state its azimuth")
        signals, trusted = _signals(view, names, self.black_level)
        fit = fit_normals(signals, self._directions(series, names), trusted, self.reject_sigmas)
        more = {"channels_left_out": float(np.mean(len(names) - fit.used))}
        return _estimate(series, slopes(with_ambient(fit.vector, self.ambient)), names, self.integration, more)

    def _looked_up(self, series: TiltSeries, view: View, known: ReflectanceMap) -> Estimate:
        """Take normals from the measured map; the channels are its own."""
        if self.channels and set(self.channels) != set(known.channels):
            raise InputError(
                f"option channels names {', '.join(self.channels)}, but {self.calibration} was measured with "
                f"{', '.join(known.channels)}; leave the option out"
            )
        signals, trusted = _signals(view, known.channels, self.black_level)
        slope_x, slope_y = known.look_up(signals, trusted)
        weight = np.nan_to_num(1 / (1 + slope_x**2 + slope_y**2))
        more = {"cells_of_the_map": len(known.slopes)}
        return _estimate(series, (slope_x, slope_y, weight), known.channels, self.integration, more)

    def _directions(self, series: TiltSeries, names: tuple[str, ...]) -> Array:
        """Make unit vectors towards the detectors, (channels, 3)."""
        answer = []
        for name in names:
            known = series.channel_geometry[name]
            azimuth = np.deg2rad(known.azimuth_deg)
            elevation = np.deg2rad(self.elevation_deg if known.elevation_deg is None else known.elevation_deg)
            level = np.cos(elevation)
            answer.append([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        return np.array(answer)


@dataclass(frozen=True)
class UncalibratedPhotometricStereo:
    """Normals from channels of which nothing is known, then heights.

    Three factors of the channels (Basri, Jacobs and Kemelmacher 2007, lighting of the first order), made to belong to
    one surface (Yuille and Snow 1997). What is left is the generalised bas-relief of Belhumeur, Kriegman and Yuille
    (1999): a plane, the scale of heights and their sign, all declared; the sign is such that the first channel's
    detector comes out on the right, or else above. We deviate from Basri in the ambient term, which needs a fourth
    picture and is left out.

    Parameters
    ----------
    channels
        Names of the channels to use; empty is those that have a direction where there are three of them, else all.
    black_level
        Grey value of no electron, the same in all channels.
    smooth_px
        Blur before derivatives are taken for the search, px; the slopes themselves stay as sharp as recorded.
    integration
        How slopes become heights.
    """

    channels: tuple[str, ...] = ()
    black_level: float = 0.0
    smooth_px: float = 2.0
    integration: IntegrationOptions = field(default_factory=IntegrationOptions)

    name: ClassVar[str] = "photometric_stereo_uncalibrated"
    citation: ClassVar[str] = "Basri, Jacobs and Kemelmacher 2007; Yuille and Snow 1997; Belhumeur et al. 1999"
    needs: ClassVar[tuple[Need, ...]] = ("channels", "pixel_size")
    views: ClassVar[tuple[int, int | None]] = (1, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "plane", "scale", "mirror")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:  # noqa: ARG002 - nothing is drawn
        """Reconstruct from the reference view; raises `MethodError` with a sentence where it cannot."""
        view = series.views[series.reference]
        segments = tuple(name for name in view.channels if name in series.channel_geometry)
        names = self.channels or (segments if len(segments) >= 3 else tuple(view.channels))
        signals, trusted = _signals(view, names, self.black_level)
        known: Mask = np.asarray(trusted.all(axis=0))
        factors, singular = three_factors(signals, known)
        vector, azimuths_deg = with_a_sign(integrable(factors, known, self.smooth_px), signals, known)
        fourth = float(singular[3]) if len(names) > 3 else 0.0
        seen = [round(float(angle), 1) for angle in azimuths_deg]
        more = {"third_factor": float(singular[2]), "fourth_factor": fourth, "azimuths_deg": seen}
        return _estimate(series, slopes(vector), names, self.integration, more)


def _signals(view: View, names: tuple[str, ...], black_level: float) -> tuple[Array, Mask]:
    """Grey values over the black level and where they can be used, (channels, rows, columns) each."""
    called = view.name or "the reference view"
    if missing := [name for name in names if name not in view.channels]:
        raise MethodError(f"{called} has no channel {missing[0]}; it has {', '.join(view.channels) or 'none'}")
    if len(names) < 3:
        raise MethodError(
            f"photometric stereo needs 3 detector channels or more of {called}, not {len(names)}; "
            "record the segments of the backscatter detector and state where they sit"
        )
    images = [view.channels[name] for name in names]
    for name, image in zip(names, images, strict=True):
        if not usable(image).any() or np.nanmin(image) == np.nanmax(image):
            raise MethodError(f"channel {name} of {called} is blank; leave it out or record it anew")
    trusted = np.stack([usable(image) for image in images])
    if view.mask is not None:
        trusted &= view.mask
    signals = np.stack([image.astype(np.float64) for image in images]) - black_level
    return np.where(trusted, signals, 0.0), trusted


def _estimate(
    series: TiltSeries,
    found_slopes: tuple[Array, Array, Array],
    names: tuple[str, ...],
    options: IntegrationOptions,
    more: Mapping[str, Any],
) -> Estimate:
    """Integrate slopes along x and y, with their weight, and report."""
    slope_x, slope_y, weight = found_slopes
    share = float(np.isfinite(slope_x).mean())
    if share < LEAST_SHARE:
        raise MethodError(
            f"only {share:.1%} of the pixels show a slope in three channels; check exposure and directions"
        )
    z_um = integrate_slopes(slope_x, slope_y, series.optics.pixel_size_um, weight, options)
    heights = HeightMap(z_um, np.full(z_um.shape, np.nan), series.optics.pixel_size_um)
    steep = np.hypot(slope_x, slope_y)
    found = {
        "channels": list(names),
        "pixels": int(np.isfinite(z_um).sum()),
        "median_slope": float(np.nanmedian(steep)),
    }
    return Estimate(heights=heights, diagnostics={**found, **more})
