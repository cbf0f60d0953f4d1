"""Command line of the bench: `python -m benchmarks`."""

from __future__ import annotations

import sys

import typer

from benchmarks.commands.bars import bars
from benchmarks.commands.baselines import baselines
from benchmarks.commands.compare import compare
from benchmarks.commands.gallery import gallery
from benchmarks.commands.paper import paper
from benchmarks.commands.plan import plan
from benchmarks.commands.record import record
from benchmarks.commands.report import report
from benchmarks.commands.run import run
from benchmarks.commands.scene import scene
from benchmarks.commands.score import score
from benchmarks.commands.sweep import sweep

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def bench() -> None:
    """Put reconstructions from SEM tilt series against truth and against the physical limit."""


for command in (run, compare, scene, score, sweep, plan, report, record, gallery, paper, bars, baselines):
    app.command()(command)

if __name__ == "__main__":
    sys.exit(app())
