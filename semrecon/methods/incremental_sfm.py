"""Incremental structure from motion as photographers use it, with the options that suit micrographs best."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from semrecon.data import Estimate, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.methods.base import Gauge, Need
from semrecon.perspective.colmap import MapperOptions, mapped
from semrecon.perspective.pinhole import focal_length_px
from semrecon.perspective.pinhole_estimate import estimate_of


@dataclass(frozen=True)
class IncrementalSfm:
    """COLMAP's incremental mapper (Schoenberger and Frahm 2016), as in Liu 2018 and what an outsider would pick.

    With its defaults it places no view of a series of small tilts. Its best chance, as given here: the focal length
    that the working distance means, or else a long one, held and free; least angles of beams far below its own;
    features and matches of ours and of its own; and of these set-ups the answer that places most views, then the one
    with the smallest reprojection error. One thread and a seed make it repeatable.

    Needs the optional package pycolmap (extra ``sfm``). What is said of parallel views in `EssentialSfm` holds here.

    Parameters
    ----------
    mapper
        Which set-ups are tried.
    focal_widths
        Focal length in image widths where no working distance is stated.
    """

    mapper: MapperOptions = field(default_factory=MapperOptions)
    focal_widths: float = 10.0

    name: ClassVar[str] = "incremental_sfm"
    citation: ClassVar[str] = (
        "Schoenberger, Frahm: Structure-from-motion revisited, CVPR 2016 (COLMAP); for micrographs Liu 2018, as the "
        "seed cites it"
    )
    needs: ClassVar[tuple[Need, ...]] = ("pixel_size",)
    views: ClassVar[tuple[int, int | None]] = (2, None)
    gauge: ClassVar[tuple[Gauge, ...]] = ("offset", "plane", "scale", "mirror")

    def __call__(self, series: TiltSeries, *, rng: np.random.Generator) -> Estimate:
        """Run the set-ups and take the best answer; raises `MethodError` with a sentence where there is none."""
        if len(series) < 2:
            raise MethodError(f"{self.name} needs two views or more, not {len(series)}")
        if not self.focal_widths > 0:
            raise InputError(f"focal_widths must be a positive number of image widths, not {self.focal_widths:g}")
        focal_px = focal_length_px(series.optics, self.focal_widths)
        answers = mapped(series, focal_px, int(rng.integers(2**31 - 1)), self.mapper)
        tried = [
            {
                "matches": one.source,
                "focal_refined": one.refined,
                "views": int(one.found.cameras.placed.sum()),
                "points": len(one.found.xyz),
                "focal_px": one.found.cameras.focal_px,
                "sigma_px": one.found.sigma_px,
            }
            for one in answers
        ]
        return estimate_of(series, answers[0].found, {"set_ups": tried, "given_focal_px": focal_px})
