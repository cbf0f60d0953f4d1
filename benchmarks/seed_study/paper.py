"""The seed's study from end to end: the recipe of `python -m benchmarks paper`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

from benchmarks.running.ledger import Ledger, Row
from benchmarks.running.runner import run_jobs
from benchmarks.scenes import Progress, SimulatedSource, Source
from benchmarks.seed_study.figures import contenders_of, draw_depth_error, draw_means, draw_reconstruction, draw_runs
from benchmarks.seed_study.record import record_study
from benchmarks.seed_study.study import jobs
from benchmarks.seed_study.summary import PROPOSED, summary
from benchmarks.seed_study.tables import write_csv
from semrecon.data import SurfaceMesh
from semrecon.errors import InputError
from semrecon.surface.meshing import mesh_from_points, statistical_outliers

LEDGER = "ledger.sqlite"
Report = Callable[[str, int, int], None]
"""Called with the stage, steps done now (not in all) and the number of steps of the stage."""


def run_paper(
    sources: Sequence[Source], out: Path, repetitions: int, executor: Executor, notes: Sequence[str], report: Report
) -> str:
    """Measure what the ledger in `out` lacks, then write tables, figures, recordings and the summary.

    Returns
    -------
    The text of `summary.md`.

    Raises
    ------
    InputError
        If `out` holds something else than the results of a study.
    """
    check_results_folder(out)
    started = time.monotonic()
    rows = measure_all(sources, Ledger(out / LEDGER), repetitions, executor, report)
    seconds = time.monotonic() - started
    show(sources, rows, out, report)
    text = summary(rows, notes, seconds)
    (out / "summary.md").write_text(text, encoding="utf-8")
    return text


def measure_all(
    sources: Sequence[Source], ledger: Ledger, repetitions: int, executor: Executor, report: Report
) -> dict[str, list[Row]]:
    """Run all repetitions of all sources; rows by source, in the order of repetition."""
    for source in sources:
        if isinstance(source, SimulatedSource):
            source.prepare(_named(report, source.name))
    wanted = {source.name: jobs(source, repetitions) for source in sources}
    total = repetitions * len(sources)
    run_jobs([job for each in wanted.values() for job in each], executor, ledger, lambda n: report("runs", n, total))
    return {name: ledger.rows([key for job in each for key in job.keys]) for name, each in wanted.items()}


def _named(report: Report, name: str) -> Progress:
    return lambda _step, _done, total: report(f"preparing {name}", 1, total)


def show(sources: Sequence[Source], rows: Mapping[str, Sequence[Row]], out: Path, report: Report) -> None:
    """Draw all that can be drawn from the rows."""
    write_csv(out / "runs.csv", rows)
    for number, source in enumerate(sources):
        _show_source(source, rows[source.name], out, number, len(sources))
        report("figures and recordings", 1, len(sources))
    first = 7 + 2 * len(sources)
    draw_means(out / f"fig{first:02d}_mean_rmse.png", rows, "rmse_um", "mean RMSE (um)")
    draw_means(out / f"fig{first + 1:02d}_mean_rre.png", rows, "rre_deg", "mean RRE (degrees)")
    if any("depth_median_um" in row.metrics for each in rows.values() for row in each):
        draw_means(out / "mean_depth_error.png", rows, "depth_median_um", "median depth error against truth (um)")


def _show_source(source: Source, rows: Sequence[Row], out: Path, number: int, sources: int) -> None:
    series, truth, name = source.series(0), source.truth(), source.name
    answered = [row for row in rows if not row.failure]
    if not answered:
        return
    first = {row.contender: row for row in reversed(answered)}
    draw_runs(out / f"fig{7 + sources + number:02d}_{name}_runs.png", answered, f"{name}: RMSE and RRE of every run")
    if PROPOSED in first:
        points = first[PROPOSED].arrays["merged"].astype(float) @ first[PROPOSED].arrays["frame_0"]
        title = f"{name}: proposed method, first run"
        picture = out / f"fig{7 + number:02d}_{name}_reconstruction.png"
        mesh = mesh_from_points(points[~statistical_outliers(points)])
        draw_reconstruction(picture, series.views[0].image, points, mesh, title)
    surface = None
    if truth is not None:
        surface = SurfaceMesh(truth.mesh.vertices_um, truth.mesh.faces.astype("int64"))
        judged = [name for name in contenders_of(answered) if "error_0" in first[name].arrays]
        clouds = {name: (first[name].arrays["xy_0"], first[name].arrays["error_0"]) for name in judged}
        draw_depth_error(
            out / f"{name}_depth_error.png", series.views[0].image, clouds, f"{name}: first pair, first run"
        )
    record_study(out / f"{name}.rrd", name, series, answered, surface)


def check_results_folder(out: Path) -> None:
    """Refuse a folder that holds something else than the results of a study."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file; name a folder for the results")
    if out.is_dir() and any(out.iterdir()) and not (out / LEDGER).is_file():
        raise InputError(f"--out {out} holds something else than the results of a study; name a new or empty folder")
