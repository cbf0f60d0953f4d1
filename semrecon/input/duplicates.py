"""Views that are there twice: one file named twice, a copy under another name, two pictures at one tilt."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from semrecon.data import TiltSeries, View
from semrecon.errors import InputError

SAME_TILT_DEG = 0.01
"""Two tilts this close are one: no stage is set more finely."""


def check_named_once(paths: Sequence[Path]) -> None:
    """Refuse a list that names a file twice; raises `InputError`."""
    seen: dict[Path, Path] = {}
    for path in paths:
        try:
            file = path.resolve()
        except (OSError, RuntimeError, ValueError):  # no file has this name, which whoever opens it says better
            continue
        if file in seen:
            raise InputError(f"{path} is named twice; a view counts once, so name every image once")
        seen[file] = path


def check_no_copies(series: TiltSeries) -> None:
    """Refuse two views with the same pixels: noise never repeats, so one is a copy. Raises `InputError`.

    Blank images are left to those who say that they are blank.
    """
    seen: dict[bytes, View] = {}
    for view in series.views:
        if view.image.min() == view.image.max():
            continue
        first = seen.setdefault(hashlib.blake2b(view.image.tobytes()).digest(), view)
        if first is not view:
            raise InputError(
                f"{view.name} holds the same picture as {first.name} to the last pixel, so one of them is a copy; "
                f"{_angles(first, view)}, leave out the copy"
            )


def equal_tilts(series: TiltSeries) -> list[str]:
    """Write a sentence for views that share a tilt with one before, unless all do, which is no series at all."""
    said = []
    views = sorted(series.views, key=lambda view: view.tilt_deg)
    if not views or views[-1].tilt_deg - views[0].tilt_deg < SAME_TILT_DEG:
        return []
    for first, second in pairwise(views):
        if second.tilt_deg - first.tilt_deg < SAME_TILT_DEG:
            said.append(
                f"{first.name} and {second.name} have one tilt, {first.tilt_deg:g} degrees, and so no parallax "
                "against each other; check the tilts"
            )
    return said


def _angles(first: View, second: View) -> str:
    if abs(first.tilt_deg - second.tilt_deg) < SAME_TILT_DEG:
        return f"both at {first.tilt_deg:g} degrees"
    return f"though the tilts are {first.tilt_deg:g} and {second.tilt_deg:g} degrees"
