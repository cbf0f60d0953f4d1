"""`python -m benchmarks paper`: the seed's study."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.console import one_sentence, progress

if TYPE_CHECKING:
    from benchmarks.scenes import Source
    from semrecon.data import TiltSeries

IMAGES = {".tif", ".tiff", ".png", ".jpg", ".jpeg"}


def paper(
    out: Annotated[Path, typer.Option(help="Results folder; a run that was stopped goes on there.")] = Path(
        "results/paper"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Smaller images and 3 runs.")] = False,
    runs: Annotated[int | None, typer.Option(min=1, help="Repetitions; 20 as in the seed, 3 with --quick.")] = None,
    series: Annotated[
        Path | None, typer.Option(help="Real series instead: a series folder, or one with images.")
    ] = None,
    true_tilt_step: Annotated[
        float | None, typer.Option(help="Tilt between neighbouring images of --series, deg.")
    ] = None,
    pixel_size_um: Annotated[float | None, typer.Option(help="Of --series, where its files do not say.")] = None,
    tilt_axis_deg: Annotated[float | None, typer.Option(help="Of --series: 0 is up in the image, 90 right.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = os.cpu_count() or 1,
) -> None:
    """Repeat the seed paper's study (Table 2, Figs. 7 to 12) against exact truth, or on real micrographs."""
    with one_sentence():
        from benchmarks.scenes import RealSource, paper_scenes
        from benchmarks.seed_study.paper import check_results_folder, run_paper
        from semsim.workers import process_pool

        check_results_folder(out)
        sources: list[Source] = list(paper_scenes(out / "cache", quick=quick))
        notes = [
            "Simulated micrographs of known meshes; the noise is new in every run, and the same for all contenders."
        ]
        if series is not None:
            real = _real_series(series, true_tilt_step, pixel_size_um, tilt_axis_deg)
            sources, notes = [RealSource(series.resolve().name, real)], _real_notes(real)
        with progress() as report, process_pool(workers) as executor:
            text = run_paper(sources, out, runs or (3 if quick else 20), executor, notes, report)
    typer.echo(text)
    typer.echo(f"Results are in {out}.")


def _real_series(
    folder: Path, step_deg: float | None, pixel_size_um: float | None, axis_deg: float | None
) -> TiltSeries:
    """Read a series folder, or all images of a folder in the order of their names."""
    from benchmarks.scenes import with_tilt_step
    from semrecon.errors import InputError
    from semrecon.input.intake import Stated, take_in

    if not folder.is_dir():
        raise InputError(f"--series {folder} is not a folder; name a series folder or a folder of images")
    images = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES)
    inputs = [folder] if (folder / "series.toml").is_file() else images
    if not inputs:
        raise InputError(f"--series {folder} holds neither a series.toml nor images")
    tilts = None if step_deg is None else tuple(i * step_deg for i in range(len(images)))
    read = take_in(inputs, Stated(None if inputs == [folder] else tilts, pixel_size_um, axis_deg)).series
    return read if step_deg is None else with_tilt_step(read, step_deg)


def _real_notes(series: TiltSeries) -> list[str]:
    tilts = ", ".join(f"{tilt + 0.0:g}" for tilt in series.tilts_deg)
    return [
        f"Real micrographs, taken to be tilted by {tilts} degrees, with {series.optics.pixel_size_um:.5g} um a pixel.",
        "Truth is absent: there is no depth error below. The images are the same in all runs; only the random choices "
        "of the robust estimate could make them differ.",
    ]
