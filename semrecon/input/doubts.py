"""What looks wrong with the files of a series, said before anybody reconstructs from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semrecon.data import Image
from semrecon.input.bottom import bottom_of
from semrecon.input.dead_lines import dead_lines_of, said_of
from semrecon.input.duplicates import SAME_TILT_DEG
from semrecon.input.intake import SAME_PIXEL_SIZE, Facts, agreed
from semrecon.input.series import SERIES_FILE


def doubts(facts: Facts, images: Sequence[Image]) -> tuple[str, ...]:
    """List what looks wrong with files before anybody reconstructs from them."""
    said = [sentence for one in facts.stated for sentence in one.warnings]
    tilts = [one.tilt_deg for one in facts.stated if one.tilt_deg is not None]
    if len(tilts) > 1 and max(tilts) - min(tilts) < SAME_TILT_DEG:
        said.append(
            f"all {len(tilts)} tilts are {tilts[0]:g} degrees, which leaves no parallax; "
            "if the stage did move, the metadata was copied: give --tilts"
        )
    for noun, option, values in (
        ("pixel size", "--pixel-size-um", [one.pixel_size_um for one in facts.stated]),
        ("tilt axis", "--tilt-axis-deg", [one.tilt_axis_deg for one in facts.stated]),
    ):
        known = [value for value in values if value is not None]
        if known and (len(known) < len(values) or agreed(known, SAME_PIXEL_SIZE) is None):
            told = ", ".join("none" if value is None else f"{value:.5g}" for value in values)
            said.append(f"the images do not agree on a {noun} ({told}); give {option}")
    if len({image.shape for image in images}) > 1:
        said.append("the images are not all of one size; a series needs one magnification and one format")
    elif images:
        bottom = bottom_of(images, facts.data_bar_px, keep=facts.source == SERIES_FILE)
        said += [sentence.replace("and cropped;", "and will be cropped;") for sentence in bottom.said]
        rows = len(images[0]) - bottom.crop_px
        names = [Path(entry.image).name for entry in facts.entries]
        found = [(name, dead_lines_of(image[:rows])) for name, image in zip(names, images, strict=True)]
        said += [sentence.replace(", left out", ", will be left out") for sentence in said_of(found)]
    return tuple(dict.fromkeys(said))
