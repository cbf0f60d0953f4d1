"""Light field of a sliding stage: heights from the slopes of epipolar-plane images."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from semrecon.data import Array, Estimate, HeightMap, Poses, TiltSeries
from semrecon.dense.epipolar_plane import SlopeOptions, Slopes, slopes
from semrecon.errors import MethodError
from semrecon.geometry import rotations_from_tilts
from semrecon.methods.base import Gauge, Need
from semrecon.surface.completion import points_from_heights

SAME_TILT_DEG = 0.05
LEAST_PATH_PX = 2.0
LEAST_SHARE = 0.005
"""Share of the pixels below which what is left is no surface."""


@dataclass(frozen=True)
class LightField:
    """Heights from a linear stage path at one tilt, by epipolar-plane images.

    After Ding et al. 2019: a positioner slides the specimen step by step, and the linear structures in the stack of
    views tell the depth. We deviate in this: steps are known stage positions of any length and direction, not many
    small equal ones, so the stack is sheared by them first; slopes are fitted to the grey values of all views in a
    window instead of to detected lines; and the positions of the stage are corrected from the images. A view in which
    something stands before a place is left out there, what views farther along the path do not find again is left
    open, and so is what would get its height from an edge beside it.

    A shift has parallax under perspective alone: the working distance must be stated, and the relief has to be a fair
    share of it. Heights are measured from the plane on which the pixel size holds, but an error of the stage that grows
    along the path moves all of them alike, so that the offset is declared unobservable.

    Parameters
    ----------
    slopes
        How slopes are found.
    least_contrast
        Least share of the grey values' variance in a window that the views must have in common.
    most_sigma_px
        Greatest standard deviation from noise, as motion of a point over the whole path.
    most_aside
        Farthest that the middle of what a height rests on may lie from its pixel, in parts of the window: beside a
        bright rim a dark gap would get the height of the rim.
    """

    slopes: SlopeOptions = field(default_factory=SlopeOptions)
    least_contrast: float = 0.3
    most_sigma_px: float = 0.3
    most_aside: float = 1.0

    name: ClassVar[str] = "light_field"
    citation: ClassVar[str] = (
        "Ding et al.: Automatic 3D reconstruction of SEM images based on nano-robotic manipulation and epipolar plane "
        "images, Ultramicroscopy 200 (2019) 149; Bolles, Baker, Marimont, IJCV 1 (1987) 7"
    )
    needs: ClassVar[tuple[Need, ...]] = ("perspective", "stage_path", "pixel_size")
    views: ClassVar[tuple[int, int | None]] = (3, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset",)

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:  # noqa: ARG002 - nothing is drawn
        """Fit slopes; raises `MethodError` with a sentence where a series has no path, perspective or texture."""
        found = slopes(series, _stage_um(series), self.slopes)
        return self._estimate(series, found)

    def _estimate(self, series: TiltSeries, found: Slopes) -> Estimate:
        optics, view = series.optics, series.reference
        path_px = float(np.linalg.norm(np.ptp(found.stage_px, axis=0)))
        motion = optics.inverse_working_distance * optics.pixel_size_um * path_px
        seen = (found.contrast >= self.least_contrast) & (found.noise * motion <= self.most_sigma_px)
        own = found.aside_px <= self.most_aside * self.slopes.window_px
        kept = seen & own & found.found_again & np.isfinite(found.heights + found.sigma)
        if kept.mean() < LEAST_SHARE:
            raise MethodError(
                f"the views agree on the height of {int(kept.sum())} pixels only: more contrast, less noise, a longer "
                "path or a shorter working distance would help, and the stage positions must be right"
            )
        z_um = np.where(kept, found.heights, np.nan) * optics.pixel_size_um
        middle = float(np.nanmedian(z_um))
        heights = HeightMap(
            z_um - middle, np.where(kept, found.sigma, np.nan) * optics.pixel_size_um, optics.pixel_size_um
        )
        rotation = rotations_from_tilts(series.tilts_deg, series.tilt_axis_deg)[view]
        # all is moved by `middle` along the beam; the stage steps grow with the distance, so that no image changes
        steps = found.stage_px * optics.pixel_size_um * (1 + optics.inverse_working_distance * middle)
        return Estimate(
            points=points_from_heights(heights, series, rotation, np.zeros(3)),
            heights=heights,
            poses=Poses(np.tile(rotation, (len(series), 1, 1)), np.pad(steps, ((0, 0), (0, 1)))),
            diagnostics={
                "path_px": path_px,
                "um_a_px": optics.pixel_size_um / motion,
                "stage_correction_px": found.stage_px - _relative_px(series),
                "median_height_um": middle,
                "pixels": int(kept.sum()),
                "not_found_again": int((seen & ~found.found_again).sum()),
                "not_their_own": int((seen & ~own).sum()),
                "median_sigma_um": float(np.nanmedian(heights.sigma_um)),
            },
        )


def _stage_um(series: TiltSeries) -> Array:
    """Stage positions (views, 2), once the series is one that this method can use."""
    if len(series) < 3:
        raise MethodError(f"light_field needs three views or more along a stage path, not {len(series)}")
    if not series.optics.inverse_working_distance > 0:
        raise MethodError(
            "the views count as parallel, and under parallel projection a pure shift has no parallax: light_field "
            "needs a low magnification and the working distance"
        )
    positions = [view.stage_um for view in series.views if view.stage_um is not None]
    if len(positions) < len(series):
        raise MethodError("light_field needs the stage position of every view (stage_um in series.toml)")
    if np.ptp(series.tilts_deg) > SAME_TILT_DEG:
        raise MethodError(
            f"the views are tilted by {series.tilts_deg.min():g} to {series.tilts_deg.max():g} degrees; light_field "
            "needs one tilt and a stage that slides"
        )
    stage = np.array(positions, dtype=np.float64)
    if np.linalg.norm(np.ptp(stage, axis=0)) < LEAST_PATH_PX * series.optics.pixel_size_um:
        raise MethodError("the stage does not move between the views; light_field needs a path of many pixels")
    return stage


def _relative_px(series: TiltSeries) -> Array:
    stage = _stage_um(series)
    return np.asarray((stage - stage[series.reference]) / series.optics.pixel_size_um)
