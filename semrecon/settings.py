"""TOML into frozen dataclasses, strictly: what is misspelt, missing or of the wrong kind becomes one sentence."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import cattrs
from cattrs.errors import (
    AttributeValidationNote,
    ClassValidationError,
    ForbiddenExtraKeysError,
    IterableValidationError,
    IterableValidationNote,
)

from semrecon.errors import InputError

T = TypeVar("T")


def read_toml(file: Path, kind: type[T]) -> T:
    """Read a TOML file into a dataclass whose fields are the allowed keys.

    Raises
    ------
    InputError
        Names the file and the key: unknown (with those allowed), missing, or of the wrong kind.
    """
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{file} does not exist") from None
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{file} is not valid TOML: its brackets are nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{file} is not valid TOML: {error}") from None
    try:
        return strict_converter().structure(content, kind)
    except ClassValidationError as error:
        raise InputError(f"{file}: {_complaint(error)}") from None


def strict_converter() -> cattrs.Converter:
    """No unknown keys, no number in quotes, no text where a number belongs, no fraction where a count does."""
    converter = cattrs.Converter(forbid_extra_keys=True)
    converter.register_structure_hook(float, _strict_float)
    converter.register_structure_hook(str, _strict_str)
    converter.register_structure_hook_func(lambda kind: kind == tuple[float, float], _strict_pair)
    converter.register_structure_hook(int, _strict_int)
    converter.register_structure_hook(bool, _strict_bool)
    return converter


def _strict_float(value: Any, _: type) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"must be a number, not {value!r}")
    return float(value)


def _strict_pair(value: Any, kind: type) -> tuple[float, float]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise TypeError(f"must be two numbers, as [0.5, 2.0], not {value!r}")
    return _strict_float(value[0], kind), _strict_float(value[1], kind)


def _strict_int(value: Any, _: type) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"must be a whole number, not {value!r}")
    return value


def _strict_bool(value: Any, _: type) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"must be true or false, not {value!r}")
    return value


def _strict_str(value: Any, _: type) -> str:
    if not isinstance(value, str):
        raise TypeError(f"must be text in quotes, not {value!r}")
    return value


def _complaint(error: ClassValidationError) -> str:
    """Pick the most telling of all complaints: an unknown key explains a missing one, so it goes first."""
    leaves = list(_leaves(error, ""))
    leaf, where = next((pair for pair in leaves if isinstance(pair[0], ForbiddenExtraKeysError)), leaves[0])
    if isinstance(leaf, ForbiddenExtraKeysError):
        allowed = ", ".join(f.name for f in fields(leaf.cl))
        inside = f" in{where}" if where else ""
        return f"unknown key {', '.join(sorted(leaf.extra_fields))}{inside}; allowed are {allowed}"
    if isinstance(leaf, KeyError):
        return f"a key is missing: {where.strip()}"
    said = str(leaf) if "must be" in str(leaf) else "is not of the right kind"
    return f"{where.strip()} {said}"


def _leaves(error: BaseException, where: str) -> Iterator[tuple[BaseException, str]]:
    """Innermost errors of a nested cattrs error, each with the way to it in the file."""
    if not isinstance(error, ClassValidationError | IterableValidationError):
        yield error, where
        return
    for inner in error.exceptions:
        yield from _leaves(inner, where + _step(getattr(inner, "__notes__", ())))


def _step(notes: Any) -> str:
    """One step of the way: a key, or the number of an entry counted from 1."""
    for note in notes:
        if isinstance(note, AttributeValidationNote):
            return f" {note.name}"
        if isinstance(note, IterableValidationNote):
            return f" {note.index + 1 if isinstance(note.index, int) else note.index}"
    return ""
