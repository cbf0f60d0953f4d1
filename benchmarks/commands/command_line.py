"""The command that was typed, as a page can repeat it."""

from __future__ import annotations

import shlex
from typing import Any

import typer


def command_line(context: typer.Context) -> str:
    """Say a command with every argument and option that was given, and none that was not."""
    words = ["python", "-m", "benchmarks", context.info_name or ""]
    for parameter in context.command.params:
        name = parameter.name or ""
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            words += _said(parameter, context.params[name])
    return shlex.join(words)


def _said(parameter: Any, value: object) -> list[str]:
    values = [str(each) for each in value] if isinstance(value, list | tuple) else [str(value)]
    if parameter.param_type_name == "argument":
        return values
    option = max(parameter.opts, key=len)
    if isinstance(value, bool):
        return [option] if value else []
    return [word for each in values for word in (option, each)]
