"""Methods that other packages bring, through the entry point group `semrecon.methods` (docs/adding-a-method.md)."""

from __future__ import annotations

from dataclasses import is_dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from semrecon.errors import InputError
from semrecon.methods.base import Method

GROUP = "semrecon.methods"
"""Entry point group in which a package names its methods."""
PARTS = ("name", "citation", "needs", "views", "gauge")
"""What a method states of itself."""


@cache
def outside_methods() -> tuple[Method, ...]:
    """Load the methods of all installed packages, in the order of their names.

    Raises
    ------
    InputError
        A package names something that cannot be loaded or is no method.
    """
    return tuple(loaded(point) for point in sorted(entry_points(group=GROUP), key=lambda point: point.name))


def loaded(point: EntryPoint) -> Method:
    """Load one entry point: a frozen value of options, or the class of it, which then takes its defaults."""
    where = f"entry point {point.name} = {point.value}"
    try:
        found: Any = point.load()
        method: Any = found() if isinstance(found, type) else found
    except Exception as error:
        raise InputError(f"{where} cannot be loaded ({error}); repair or remove that package") from error
    missing = [part for part in PARTS if not hasattr(method, part)]
    if missing or not is_dataclass(type(method)) or not callable(method):
        why = f"states no {missing[0]}" if missing else "must be a frozen dataclass that can be called"
        raise InputError(f"{where} is no method: it {why}")
    if method.name != point.name:
        raise InputError(f"{where} calls itself {method.name}; the two names must agree")
    return method  # type: ignore[no-any-return]  # checked above, as far as can be
