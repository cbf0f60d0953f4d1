"""A scored submission in words, as a table, and as files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.judging.judge import TOLERANCES_PX
from benchmarks.judging.submission import Subject
from benchmarks.judging.submitted import Scored
from semrecon.folder import whole_folder
from semrecon.output.export import write_map
from semrecon.reconstruction import jsonable

FILES = ("score.json", "score.md", "error.tif")
SCORES = {
    "median_um": "median absolute depth error (um)",
    "rms_um": "rms depth error (um)",
    "p95_um": "95 % of the errors below (um)",
    "penalised_median_um": "median, missing as infinitely wrong (um)",
    "completeness": "completeness",
    "normal_deg": "median error of the normals (deg)",
    **{f"fscore_{at:g}px": f"F-score at {at:g} px" for at in TOLERANCES_PX},
    **{f"own_precision_{at:g}px": f"of its own surface within {at:g} px" for at in TOLERANCES_PX},
    "split_offset_um": "split: offset (um)",
    "split_scale": "split: scale of the heights",
    "split_tilt_x_deg": "split: tilt along x (deg)",
    "split_tilt_y_deg": "split: tilt along y (deg)",
    "split_remainder_rms_um": "split: rms of the rest (um)",
}


def words(scored: Scored, subject: Subject) -> list[str]:
    """Say what was judged against what, and which alignment was made and why."""
    view = subject.series.views[subject.view]
    return [
        f"{scored.name}: {scored.what}.",
        f"Scene {subject.name}: {subject.judged.shape[1]} x {subject.judged.shape[0]} px of {subject.pixel_um:.5g} um; "
        f"the reference view is {view.name}, at {view.tilt_deg:g} degrees; {subject.judged.mean():.1%} of it is seen "
        "by all views and judged.",
        f"Alignment: {scored.reason}",
        f"Removed: {'; '.join(scored.removed)}.",
    ]


def rows(scored: Scored) -> list[list[str]]:
    """Cells of the table, headings first: as submitted, with nothing removed, and aligned."""
    answer = [["score", "as submitted", "aligned"]]
    for name, title in SCORES.items():
        if name in scored.after or name in scored.before:
            both = (scored.before.get(name, np.nan), scored.after.get(name, np.nan))
            answer.append([title, *(_said(value) for value in both)])
    return answer


def _said(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"


def write_scored(out: Path, scored: Scored, subject: Subject, ours: Callable[[Path], bool]) -> None:
    """Write numbers, words and the map of the error into a folder, whole or not at all."""
    content = {
        "scene": subject.name,
        "submission": scored.name,
        "what": scored.what,
        "alignment": scored.reason,
        "removed": scored.removed,
        "gauge": scored.gauge,
        "linear": None if scored.motion is None else scored.motion.linear,
        "shift_um": None if scored.motion is None else scored.motion.shift_um,
        "as_submitted": scored.before,
        "aligned": scored.after,
        "notes": scored.notes,
    }
    with whole_folder(out, ours) as folder:
        text = json.dumps(jsonable(content), indent=2, allow_nan=False, ensure_ascii=False)
        (folder / FILES[0]).write_text(text + "\n", encoding="utf-8")
        (folder / FILES[1]).write_text(_markdown(scored, subject), encoding="utf-8")
        write_map(folder / FILES[2], scored.error_um, subject.pixel_um)


def _markdown(scored: Scored, subject: Subject) -> str:
    head, *rest = rows(scored)
    table = "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rest])
    said = [*words(scored, subject), *(f"Note: {note}" for note in scored.notes)]
    return "\n\n".join([f"# {scored.name} against the truth of {subject.name}", *said, table]) + "\n"
