"""What all commands have in common: one sentence for what the user can put right, and a sign of life."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import typer

from semrecon.errors import InputError, MethodError

BAD_INPUT = 2
"""Exit status for what the user can put right."""


@contextlib.contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the user can put right into one sentence on stderr and exit status 2."""
    try:
        yield
    except (InputError, MethodError) as error:
        _fail(str(error))
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{error.filename}: {error.strerror}")


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Show the stage and the time it has taken on a terminal's stderr; elsewhere stay silent."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda stage: bar.update(task, description=stage)


def warn(sentence: str) -> None:
    """Print a warning on stderr."""
    typer.echo(f"warning: {sentence}", err=True)


def _fail(sentence: str) -> None:
    typer.echo(f"semrecon: {' '.join(sentence.split())}", err=True)
    raise typer.Exit(BAD_INPUT) from None
