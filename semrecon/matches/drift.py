"""Where the stage went between two views: a coarse search over a wide band tells where the fine search has to look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semrecon.matches.epipolar import Epipolar, Window
from semrecon.matches.features import Features
from semrecon.matches.matching import MatchOptions, match_features
from semrecon.numerics.robust import OffsetFit, fit_offset


@dataclass(frozen=True)
class DriftOptions:
    """How the shift of the stage is found.

    Parameters
    ----------
    reach
        Greatest shift across the epipolar lines that is looked for, as a share of the image's longer side.
    features
        How many features of each view, the largest, take part in the coarse search.
    band_px
        Half width of the band of the fine search.
    along_margin
        The fine search covers the middle 90 % of the coarse offsets along the lines, and so many times their width more
        on either side. What lies deeper or higher than that is not found.
    """

    reach: float = 0.15
    features: int = 2500
    band_px: float = 3.0
    along_margin: float = 1.0


def find_window(
    first: Features,
    second: Features,
    epipolar: Epipolar,
    longest_px: int,
    options: DriftOptions,
    match_options: MatchOptions,
    rng: np.random.Generator,
) -> tuple[Window | None, int]:
    """Find the pair's shift by vote, and the window that it leaves for the fine search.

    Parameters
    ----------
    longest_px
        Longer side of the images.

    Returns
    -------
    The window, None where chance would agree as well; and how many matches agree.
    """
    reach = options.reach * longest_px
    few1, few2 = (largest_features(one, options.features) for one in (first, second))
    coarse = match_features(few1, few2, epipolar, Window(across=(-reach, reach)), match_options)
    if len(coarse) == 0:
        return None, 0
    offsets = epipolar.offsets_px(coarse.xy1_px, coarse.xy2_px)
    fit = fit_offset(offsets[:, 0], options.band_px, rng)
    agreeing = int(fit.inliers.sum())
    if not _beyond_chance(fit, options.band_px / reach):
        return None, agreeing
    low, high = np.percentile(offsets[fit.inliers, 1], (5, 95))
    margin = options.along_margin * (high - low) + 5 * options.band_px
    across = (fit.offset - options.band_px, fit.offset + options.band_px)
    return Window(across, (float(low - margin), float(high + margin))), agreeing


def largest_features(features: Features, most: int) -> Features:
    """Keep the largest features: they are few, stand out, and bear noise better."""
    chosen = np.sort(np.argsort(-features.scale_px, kind="stable")[:most])
    _, first, inverse = np.unique(features.place[chosen], return_index=True, return_inverse=True)
    return Features(features.xy_px[chosen], features.scale_px[chosen], features.descriptors[chosen], first[inverse])


def _beyond_chance(fit: OffsetFit, share: float) -> bool:
    """Tell whether more matches agree than wrong ones would, spread evenly over the wide band (by 5 sigma)."""
    by_chance = min(share, 1.0) * len(fit.inliers)
    return bool(fit.inliers.sum() > by_chance + 5 * np.sqrt(by_chance))
