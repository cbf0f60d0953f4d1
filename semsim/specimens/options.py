"""Options of specimens: taken from a table, and held within what makes sense."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from semsim.errors import InputError


def require_positive(specimen: Any, *options: str) -> None:
    """Raise `InputError` unless each of these options of a specimen is a positive, finite number."""
    for option in options:
        value = getattr(specimen, option)
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{option} of specimen {specimen.name!r} must be a positive number; it is {value:g}")


def require_not_negative(specimen: Any, *options: str) -> None:
    """Raise `InputError` unless each of these options of a specimen is 0 or a positive, finite number."""
    for option in options:
        value = getattr(specimen, option)
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"{option} of specimen {specimen.name!r} must not be negative; it is {value:g}")


def require_within(specimen: Any, option: str, low: float, high: float) -> None:
    """Raise `InputError` unless an option of a specimen lies from `low` to `high`."""
    value = getattr(specimen, option)
    if not low <= value <= high:
        raise InputError(f"{option} of specimen {specimen.name!r} must lie from {low:g} to {high:g}; it is {value:g}")


def checked_options(kind: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as keyword arguments of a specimen.

    Parameters
    ----------
    kind
        The specimen's dataclass.
    options
        Values by option name; an option without a default is passed on as it is.

    Raises
    ------
    InputError
        If an option is unknown or its value is not of its default's kind.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for option in options:
        if option not in fields:
            raise InputError(f"specimen {kind.name!r} has no option {option!r}; its options are {', '.join(fields)}")
    return {
        option: value if fields[option].default is dataclasses.MISSING else _of_kind(kind, fields[option], value)
        for option, value in options.items()
    }


def _of_kind(kind: Any, field: dataclasses.Field[Any], value: Any) -> bool | int | float:
    """Return a value as a truth value, whole number or number, as the option's default is (None: a number)."""
    wanted: Any = float if field.default is None else type(field.default)
    accepted: Any = {bool: bool, int: int, float: (int, float)}[wanted]
    right = isinstance(value, accepted) and (wanted is bool or not isinstance(value, bool))
    if not right or not np.isfinite(value):
        called = {bool: "true or false", int: "a whole number", float: "a finite number"}[wanted]
        raise InputError(f"{field.name} of specimen {kind.name!r} must be {called}; it is {value!r}")
    return wanted(value)  # type: ignore[no-any-return]
