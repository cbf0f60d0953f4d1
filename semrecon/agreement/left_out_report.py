"""What predictions of views left out say of methods: one row a view and method, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semrecon.agreement.left_out import LeftOut
from semrecon.agreement.left_out_camera import Free
from semrecon.agreement.left_out_score import Score, commonly_known, score
from semrecon.folder import check_target, whole_folder
from semrecon.reconstruction import jsonable

SCHEMA = "semrecon.agreement.left_out/1"
FILE = "prediction.json"
HEAD = (
    "method",
    "NCC",
    "local",
    "rms",
    "median",
    "noise",
    "rms beyond",
    "NCC all",
    "local all",
    "rms all",
    "predicted",
)


@dataclass(frozen=True)
class Row:
    """One method on one view left out.

    Parameters
    ----------
    view, tilt_deg, method
        What was predicted, and by whom.
    failure
        Why there is no prediction; empty where there is one.
    common
        Score over the pixels that all methods predict; None where this one does not.
    own
        Score over all pixels that this method predicts.
    shift_px, magnification, rotation_deg
        What was fitted to the view in the plane.
    """

    view: str
    tilt_deg: float
    method: str
    failure: str = ""
    common: Score | None = None
    own: Score | None = None
    shift_px: tuple[float, float] | None = None
    magnification: float | None = None
    rotation_deg: float | None = None


def rows_of(view: str, tilt_deg: float, methods: Sequence[str], found: Sequence[LeftOut | str]) -> tuple[Row, ...]:
    """Score the methods' predictions of one view, on the pixels that all of them predict and on their own."""
    predictions = [one.prediction for one in found if isinstance(one, LeftOut)]
    among = commonly_known(predictions) if predictions else None
    rows = []
    for method, one in zip(methods, found, strict=True):
        if isinstance(one, str):
            rows.append(Row(view, tilt_deg, method, failure=one))
            continue
        x, y = (float(part) for part in one.in_plane.shift_px)
        common, own = score(one.prediction, among), score(one.prediction)
        plane = one.in_plane
        rows.append(Row(view, tilt_deg, method, "", common, own, (x, y), plane.magnification, plane.rotation_deg))
    return tuple(rows)


def table(rows: Sequence[Row]) -> str:
    """Say it in a table for each view; residuals are in grey levels of the view left out."""
    parts = []
    for view in dict.fromkeys(row.view for row in rows):
        of_view = [row for row in rows if row.view == view]
        shares = [row.common.share for row in of_view if row.common is not None]
        common = f"; all methods predict {shares[0]:.1%} of the picture" if shares else ""
        lines = [HEAD, *(_cells(row) for row in of_view if row.own is not None)]
        widths = [max(len(line[n]) for line in lines) for n in range(len(HEAD))]
        parts.append(f"{view} ({of_view[0].tilt_deg:g} degrees) left out{common}")
        if len(lines) > 1:
            parts += [
                "  " + "  ".join(f"{cell:<{w}}" for cell, w in zip(line, widths, strict=True)).rstrip()
                for line in lines
            ]
        parts += [f"  {row.method}: {row.failure}" for row in of_view if row.failure]
    return "\n".join(parts)


def _cells(row: Row) -> tuple[str, ...]:
    assert row.common is not None
    assert row.own is not None
    common, own = row.common, row.own
    grey = (common.rms_grey, common.median_grey, common.noise_grey, common.rms_beyond_grey)
    return (
        row.method,
        *(f"{value:.3f}" for value in (common.ncc, common.local_ncc)),
        *(f"{value:.2f}" for value in grey),
        *(f"{value:.3f}" for value in (own.ncc, own.local_ncc)),
        f"{own.rms_grey:.2f}",
        f"{own.share:.1%}",
    )


def report(rows: Sequence[Row], free: Free) -> dict[str, Any]:
    """Put all rows into strict JSON."""
    plain = jsonable({"schema": SCHEMA, "fitted": free, "rows": list(rows)})
    assert isinstance(plain, dict)
    return plain


def write_prediction(rows: Sequence[Row], free: Free, out: Path | str) -> Path:
    """Write `prediction.json` into a folder, whole or not at all.

    Raises
    ------
    InputError
        The folder holds something else than a former prediction.
    """
    out = Path(out)
    with whole_folder(out, is_prediction) as folder:
        text = json.dumps(report(rows, free), indent=2, allow_nan=False, ensure_ascii=False)
        (folder / FILE).write_text(text + "\n", encoding="utf-8")
    return out / FILE


def check_prediction_out(out: Path | str) -> None:
    """Refuse an output folder that holds something else, before any work is done; raises `InputError`."""
    check_target(Path(out), is_prediction)


def is_prediction(folder: Path) -> bool:
    """Whether a folder holds a former prediction and nothing beside it."""
    if {path.name for path in folder.iterdir()} != {FILE}:
        return False
    try:
        content = json.loads((folder / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == SCHEMA
