"""`python -m benchmarks baselines`: commit to the accuracy of today."""

from __future__ import annotations

from pathlib import Path

import typer


def baselines() -> None:
    """Measure the committed accuracy baselines anew, after a change that was meant to move them."""
    import tempfile

    from benchmarks.regression import BASELINES, guarded_scenes, measured, write_baselines

    with tempfile.TemporaryDirectory() as cache:
        write_baselines({source.name: measured(source) for source in guarded_scenes(Path(cache))})
    typer.echo(f"Wrote {BASELINES}.")
