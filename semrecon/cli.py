"""The `semrecon` command. Everything slow is imported inside the command that needs it."""

from __future__ import annotations

import typer

from semrecon.commands.compare import compare
from semrecon.commands.info import info
from semrecon.commands.methods import methods
from semrecon.commands.predict import predict
from semrecon.commands.reconstruct import reconstruct

app = typer.Typer(
    name="semrecon",
    help="Reconstruct a surface from tilted SEM micrographs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (reconstruct, info, methods, compare, predict):
    app.command()(command)


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
