"""What the numbers of a study say of the seed's claims, in words chosen by the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.running.ledger import Row
from benchmarks.seed_study.figures import contenders_of, series_of
from benchmarks.seed_study.tables import PUBLISHED, Reduction, reduction, reductions_table, table2

PROPOSED, CONTROL, CORRECTED = "proposed", "disparity_printed", "disparity_boyde"
SAME_PERCENT = 2.0
"""Means closer than this are called the same."""
NO_SPREAD = 1e-9
"""A standard deviation below this, in um and degrees, is rounding."""


def summary(rows_by_scene: Mapping[str, Sequence[Row]], notes: Sequence[str], seconds: float) -> str:
    """Write the summary of a study in Markdown."""
    parts = ["# The seed's study", *notes]
    for scene, rows in rows_by_scene.items():
        parts += [f"## {scene}", "Means over the runs ± standard deviation (the seed's Table 2):", table2(rows)]
        parts += ["Reductions of the means, with 95 % intervals over paired runs:", reductions_table(rows, scene)]
        if _has_truth(rows):
            parts.append(
                "Depth errors are those at the contender's own points; the map is judged wherever both views see."
            )
        parts += ["What this says:", "\n".join(f"- {sentence}" for sentence in verdicts(rows, scene)), _failures(rows)]
    parts.append(f"Measured in {seconds / 60:.1f} minutes, less what an earlier run had on record.")
    return "\n\n".join(part for part in parts if part) + "\n"


def verdicts(rows: Sequence[Row], scene: str) -> list[str]:
    """Sentences on one scene: the published gains, what is left of them, stability, and what truth says."""
    sentences = []
    for metric, label in (("rmse_um", "RMSE"), ("rre_deg", "RRE")):
        sentences.append(_claim(rows, scene, metric, label))
        sentences.append(_geometry(rows, metric, label))
    sentences.append(_stability(rows))
    sentences.append(_truth(rows) if _has_truth(rows) else _no_truth())
    return [sentence for sentence in sentences if sentence]


def _claim(rows: Sequence[Row], scene: str, metric: str, label: str) -> str:
    found = reduction(rows, PROPOSED, CONTROL, metric)
    if np.isnan(found.percent):
        return ""
    said = f"Against the disparity formula as printed, the proposed method's mean {label} is {_direction(found)}"
    if (scene, metric) not in PUBLISHED:
        return f"{said}."
    published = PUBLISHED[scene, metric]
    if found.percent < -SAME_PERCENT:
        outcome = "the sign is the opposite here"
    elif found.percent <= SAME_PERCENT:
        outcome = "no such gain appears here"
    else:
        outcome = "the direction is the same here"
    return f"{said}; the seed reports {published} % lower: {outcome}."


def _geometry(rows: Sequence[Row], metric: str, label: str) -> str:
    found = reduction(rows, PROPOSED, CORRECTED, metric)
    if np.isnan(found.percent):
        return ""
    if abs(found.percent) <= SAME_PERCENT or found.low * found.high <= 0:
        end = "what separates the methods is the printed formula, not the way the points are computed"
    else:
        end = "so the formula does not explain all of the difference"
    return f"Against the same disparities with the right formula (Boyde's), {label} is {_direction(found)}: {end}."


def _stability(rows: Sequence[Row]) -> str:
    spread = {}
    for name in (PROPOSED, CONTROL):
        for metric in ("rmse_um", "rre_deg"):
            values = series_of(rows, name, metric)[1]
            spread[name, metric] = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    if any(np.isnan(value) for value in spread.values()):
        return ""
    if max(spread.values()) < NO_SPREAD:
        return (
            "The runs do not differ: the images are the same, and whatever the random choices of the robust estimate, "
            "it ends with the same matches. The spread that the seed reports for its control is not in the data."
        )
    return (
        f"Standard deviation over the runs: RMSE {spread[PROPOSED, 'rmse_um']:.2g} um against "
        f"{spread[CONTROL, 'rmse_um']:.2g} um for the printed control, RRE {spread[PROPOSED, 'rre_deg']:.2g} against "
        f"{spread[CONTROL, 'rre_deg']:.2g} degrees (the seed reports several orders of magnitude between them)."
    )


def _truth(rows: Sequence[Row]) -> str:
    depth = {name: _mean(rows, name, "depth_median_um") for name in contenders_of(rows, "depth_median_um")}
    rmse = {name: _mean(rows, name, "rmse_um") for name in contenders_of(rows, "rmse_um")}
    if not depth or not rmse:
        return ""
    best_depth, best_rmse = _first(depth), _first(rmse)
    errors = ", ".join(f"{name} {value:.3f}" for name, value in depth.items())
    wrong = [name for name in best_rmse if name not in best_depth and name in depth]
    said = f"Median absolute depth error against truth, um: {errors}. Truth ranks {_listed(best_depth)} first"
    if not wrong:
        return f"{said}, and so does RMSE."
    ratio = max(depth[name] for name in wrong) / min(depth.values())
    return (
        f"{said}; RMSE ranks {_listed(best_rmse)} first, with {ratio:.1f} times the least depth error: "
        "agreement of clouds with each other is not truth."
    )


def _first(means: Mapping[str, float]) -> list[str]:
    """Contenders that nobody beats, within what counts as the same."""
    return [name for name, value in means.items() if value <= min(means.values()) * (1 + SAME_PERCENT / 100)]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} (alike)"


def _no_truth() -> str:
    return "There is no truth for real micrographs: RMSE and RRE say how well the clouds agree, not which one is right."


def _failures(rows: Sequence[Row]) -> str:
    failed = [f"- {row.contender}, run {row.repetition + 1}: {row.failure}" for row in rows if row.failure]
    return "\n".join(["Failures:", *failed]) if failed else ""


def _direction(found: Reduction) -> str:
    if abs(found.percent) <= SAME_PERCENT:
        return f"the same within {SAME_PERCENT:g} % ({-found.percent:+.2f} %)"
    interval = "" if np.isnan(found.low) else f" (95 % interval {_signed(found)})"
    said = f"{abs(found.percent):.1f} % {'lower' if found.percent > 0 else 'higher'}{interval}"
    return f"{said}, which these runs cannot tell from no difference" if found.low * found.high <= 0 else said


def _signed(found: Reduction) -> str:
    low, high = sorted((abs(found.low), abs(found.high)))
    return f"{low:.1f} to {high:.1f}" if found.low * found.high > 0 else f"{-found.high:.1f} to {-found.low:+.1f}"


def _has_truth(rows: Sequence[Row]) -> bool:
    return any("depth_median_um" in row.metrics for row in rows)


def _mean(rows: Sequence[Row], contender: str, metric: str) -> float:
    values = series_of(rows, contender, metric)[1]
    return float(values.mean()) if len(values) else float("nan")
