"""Between tables of TOML and frozen dataclasses: strict one way, lossless the other."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

import cattrs
import cattrs.v
from cattrs.errors import ForbiddenExtraKeysError

from semsim.errors import InputError

T = TypeVar("T")


def structured(value: Any, kind: type[T], where: str) -> T:
    """Turn what TOML holds into a value of ours.

    Parameters
    ----------
    where
        What to call it in a message.

    Raises
    ------
    InputError
        One sentence that says which entry is unknown, missing or wrong.
    """
    converter = cattrs.Converter(forbid_extra_keys=True)
    for number in (int, float):
        converter.register_structure_hook(number, _number)
    try:
        return converter.structure(value, kind)
    except Exception as error:
        faults = cattrs.transform_error(error, path=where, format_exception=_fault)
        raise InputError(faults[0].replace(" @ ", " in ")) from error


def _number(value: Any, kind: type[float]) -> float:
    allowed = int if kind is int else (int, float)
    if isinstance(value, bool) or not isinstance(value, allowed):
        raise InputError(f"{value!r} is not {'a whole' if kind is int else 'a'} number")
    return kind(value)


def _fault(error: BaseException, kind: type | None) -> str:
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, ForbiddenExtraKeysError):
        known = ", ".join(f.name for f in dataclasses.fields(error.cl))
        return f"unknown key {', '.join(sorted(error.extra_fields))} (known are {known})"
    return str(cattrs.v.format_exception(error, kind))


def plain(value: Any) -> dict[str, Any]:
    """Fields of a dataclass as TOML can hold them; None is left out, which means the same."""
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return {key: _toml_value(item) for key, item in fields.items() if item is not None}


def _toml_value(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value.resolve())
    return plain(value) if dataclasses.is_dataclass(value) else value
