"""A plan in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.sweeping.planner import Checked, Planned


def verdict(planned: Planned) -> str:
    """Say in one or two sentences what to do."""
    if planned.reached:
        best = min(planned.reached, key=lambda each: each.candidate.total_e)
        return (
            f"Take {_how(best)}: simulation gives {best.simulated_um:.3g} um, {best.completeness:.0%} complete, for a "
            f"target of {planned.target_um:g} um."
        )
    simulated = [each for each in planned.checked if np.isfinite(each.simulated_um)]
    if not simulated:
        reasons = "; ".join(sorted({each.failure for each in planned.checked if each.failure}))
        return f"The method answers at none of the candidates: {reasons or 'nothing was judgeable'}."
    best = min(simulated, key=lambda each: each.simulated_um)
    text = f"Nothing that was simulated reaches {planned.target_um:g} um; nearest is {_how(best)} with "
    text += f"{best.simulated_um:.3g} um."
    if planned.model.floor_um > planned.target_um:
        text += f" The floor of {planned.method}, {planned.model.floor_um:.3g} um, lies above: no dose or tilt will do."
    return text


def plan_rows(planned: Planned) -> tuple[Sequence[str], list[list[str]]]:
    """Head and rows of the table of what was simulated."""
    head = ("views", "tilts (deg)", "e/px and view", "e/px in all", "bound", "model", "simulated", "complete")
    rows = []
    for each in planned.checked:
        way = each.candidate
        tilts = ", ".join(f"{tilt:g}" for tilt in way.tilts_deg)
        cells = [str(way.views), tilts, f"{way.dose_e:g}", f"{way.total_e:g}", f"{way.bound_um:.3g}"]
        rows.append([*cells, f"{way.expected_um:.3g}", _simulated(each), f"{each.completeness:.0%}"])
    return head, rows


def failures(planned: Planned) -> list[str]:
    """Say why the method has no answer where the table says that it failed."""
    return [f"{_how(each)}: {each.failure}" for each in planned.checked if each.failure]


def plan_markdown(planned: Planned, scene: str, figure: str) -> str:
    """Say what was asked, what is to be done, and what that rests on."""
    head, rows = plan_rows(planned)
    fitted = [
        f"- {_how(each)}: bound {each.candidate.bound_um:.3g} um, simulated {_simulated(each)} um, by the model "
        f"{planned.model.expected_um(each.candidate):.3g} um."
        for each in planned.fitted
    ]
    lines = [
        f"# Plan: {planned.target_um:g} um on {scene} by {planned.method}",
        "",
        verdict(planned),
        "",
        f"![Expected error]({figure})",
        "",
        "Median absolute depth errors in um, over what all views see, after removal of what the method declares "
        "unobservable. By electrons in all, the fewest first:",
        "",
        f"| {' | '.join(head)} |",
        "|" + "---:|" * len(head),
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        *(f"- {said}" for said in failures(planned)),
        *([""] if failures(planned) else []),
        "## The model",
        "",
        f"error^2 = ({planned.model.efficiency:.3g} x bound)^2 + ({planned.model.matching_px:.3g} x response)^2 + "
        f"({planned.model.floor_um:.3g} um)^2, where the response is that to 1 px of matching noise in every view; "
        "fitted to simulations of a development specimen of the same kind, other than the one of the table above:",
        "",
        *fitted,
        "",
    ]
    return "\n".join(lines)


def _how(each: Checked) -> str:
    way = each.candidate
    return f"{way.views} views over {way.range_deg:g} degrees at {way.dose_e:g} e a pixel"


def _simulated(each: Checked) -> str:
    if not np.isfinite(each.simulated_um):
        return "failed" if each.failure else "-"
    if not np.isfinite(each.low_um):
        return f"{each.simulated_um:.3g}"
    return f"{each.simulated_um:.3g} [{each.low_um:.3g}, {each.high_um:.3g}]"
