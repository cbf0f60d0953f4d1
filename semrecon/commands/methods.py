"""`semrecon methods`: what there is to choose from."""

from __future__ import annotations

from dataclasses import fields

import typer


def methods() -> None:
    """List the methods, with what they need, their options and where they were published."""
    from semrecon.methods import all_methods

    for method in all_methods():
        least, most = method.views
        views = f"{least} or more" if most is None else str(least) if most == least else f"{least} to {most}"
        options = ", ".join(one.name for one in fields(method) if one.init)  # type: ignore[arg-type]  # a dataclass by agreement
        lines = [
            f"views: {views}",
            f"needs: {', '.join(method.needs) or 'nothing'}",
            f"cannot observe: {', '.join(method.gauge) or 'nothing'}",
            f"options: {options or 'none'}",
            method.citation,
        ]
        typer.echo("\n  ".join([method.name, *lines]))
