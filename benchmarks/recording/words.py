"""The document of a recording: what is seen, in which units and colours, of which code, at what cost in detail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.reporting.report_figures import said
from benchmarks.running.bench_ledger import Result
from benchmarks.running.manifest import Manifest, SceneRecord, commit

UNITS = (
    "Lengths are µm, angles degrees. The world is the specimen at zero tilt, z up toward the gun. The projection is "
    "parallel: a view is an image plane and an arrow along its beam, not a pyramid."
)
COLOURS = (
    "Blue is too low, white is right, red is too high, full at ±{limit:g} µm, the same for all methods; light grey is "
    "missing, dark grey is not judged, because not all views see it. What a method declares unobservable is removed "
    "before. The grey net is the true surface. Points are "
    "shown beside the surface where a method has few and the surface between them is filled."
)
VIEWS = (
    "Grey outlines and arrows are the true views, yellow is the one whose micrograph is shown, blue arrows are the "
    "views as a method found them."
)


def run_text(scene: SceneRecord, manifest: Manifest, table: Sequence[str], limit_um: float, thinned: int) -> str:
    """Write the document of a scene of a run."""
    lines = [
        f"## {scene.name}: what each method made of it, and where it is wrong",
        f"{scene.about} Methods stand in tabs, the smallest median error first: that of the first repetition, in µm. "
        "† is handed part of the truth.",
        f"**Colours.** {COLOURS.format(limit=limit_um)}",
        "\n".join(table),
        "**Timelines.** Choose below: `tilt` (seconds are degrees) goes through the micrographs, with the first "
        "answer of each method; `repetition` goes through the repetitions, with new noise in each.",
        f"**Views.** {VIEWS}",
        f"**Units.** {UNITS}",
        provenance(manifest, thinned),
    ]
    return "\n\n".join(lines) + "\n"


def results_table(results: Sequence[Result], labels: Mapping[str, str], metrics: Mapping[str, str]) -> list[str]:
    """Means over the repetitions that were answered, a line a method; below, why some were not."""
    lines = [f"| method | answered | {' | '.join(metrics.values())} |", "|---|---|" + "---|" * len(metrics)]
    for name, label in labels.items():
        mine = [each for each in results if each.method == name]
        right = [each for each in mine if not each.kind]
        numbers = [said(_mean(right, metric)) for metric in metrics]
        lines.append(f"| {label} | {len(right)}/{len(mine)} | {' | '.join(numbers)} |")
    reasons = dict.fromkeys(f"- {each.method}: {each.failure}" for each in results if each.kind)
    return [*lines, "", "Without an answer:", "", *reasons] if reasons else lines


def provenance(manifest: Manifest, thinned: int) -> str:
    """Say which code measured and which drew, and what was left out of the drawing."""
    code = manifest.code or "not known"
    shown = (
        f"at most every {thinned}th row and column, or point, is shown in space"
        if thinned > 1
        else "nothing is thinned"
    )
    return (
        f"**Record.** Measured {manifest.started} by commit {code}; drawn from the ledger by commit "
        f"{commit() or 'not known'} without calling a method. Numbers are those of the ledger, from all points; "
        f"{shown}."
    )


def _mean(results: Sequence[Result], metric: str) -> float:
    values = [each.seconds if metric == "seconds" else each.metrics.get(metric, np.nan) for each in results]
    return float(np.mean(values)) if values else float("nan")


def sweep_text(
    manifest: Manifest,
    about: str,
    labels: Mapping[str, str],
    middle: Mapping[str, float],
    reasons: Sequence[str],
    limit_um: float,
    thinned: int,
) -> str:
    """Write the document of a sweep.

    Parameters
    ----------
    labels, middle
        Label, with its unit, and middle value of each axis by the name of its timeline.
    reasons
        Of cases without an answer, a line each.
    """
    varied = " and ".join(labels.values())
    timelines = [f"`{name}`: {label}" for name, label in labels.items()]
    held = ", ".join(f"{name} at {value:g}" for name, value in middle.items())
    lines = [
        f"## What {varied} does to the depth error",
        f"Scene {manifest.settings.get('scene', '')}: {about} Curves are means over {manifest.repetitions} repetitions "
        "of the median absolute depth error; the bound and the predicted response stand beside them in grey.",
        f"**Timelines.** Choose below: {'; '.join(timelines)}; `repetition`: new noise. Where values are no whole "
        f"numbers, seconds stand for their unit. What is not varied on a timeline is in the middle: {held}.",
        f"**Colours.** {COLOURS.format(limit=limit_um)}",
        "**Views.** Grey outlines and arrows are the true views, yellow is the reference view with its micrograph.",
        f"**Units.** {UNITS}",
        "\n".join(["Without an answer:", "", *reasons]) if reasons else "Every case has an answer.",
        provenance(manifest, thinned),
    ]
    if manifest.command:
        lines.append(f"Made by `{manifest.command}`.")
    return "\n\n".join(lines) + "\n"
