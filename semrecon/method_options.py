"""Options of a method from the text of a command line, as refine=true or refinement.tilt_sigma_deg=0.5."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

from cattrs.errors import BaseValidationError

from semrecon.errors import InputError
from semrecon.methods.base import Method
from semrecon.settings import strict_converter


def parsed_settings(texts: Sequence[str]) -> dict[str, str]:
    """Split NAME=VALUE; raises `InputError` for what has no name or no equals sign."""
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name.strip()):
            raise InputError(f"--set takes NAME=VALUE, as refine=true, not {text!r}")
        found[name.strip().replace("-", "_")] = value.strip()
    return found


def with_settings(method: Method, settings: Mapping[str, str]) -> Method:
    """Change options of a method.

    Parameters
    ----------
    settings
        Values by name; dots lead into an option that has options of its own. A value is written as in TOML, and bare
        words are text.

    Raises
    ------
    InputError
        There is no such option (the sentence lists those that exist), or the value is of the wrong kind.
    """
    for name, text in settings.items():
        method = _changed(method, name.split("."), text, method.name)
    return method


def has_option(method: Method, name: str) -> bool:
    """Tell whether a method has an option; dots lead into options of options."""
    part: Any = method
    for step in name.split("."):
        if not is_dataclass(part) or step not in _names(part):
            return False
        part = getattr(part, step)
    return True


def _changed(part: Any, way: Sequence[str], text: str, owner: str) -> Any:
    name, *rest = way
    if name not in _names(part):
        raise InputError(f"{owner} has no option {name!r}; its options are {', '.join(_names(part)) or 'none'}")
    current = getattr(part, name)
    if rest:
        if not is_dataclass(current):
            raise InputError(f"option {name} of {owner} has no options of its own")
        return replace(part, **{name: _changed(current, rest, text, f"{owner}.{name}")})
    if is_dataclass(current):
        raise InputError(f"option {name} of {owner} is a group: set {name}.{_names(current)[0]} or another of it")
    return replace(part, **{name: _value(text, get_type_hints(type(part))[name], f"{owner}: {name}")})


def _value(text: str, kind: Any, what: str) -> Any:
    """Read a value as TOML does, or as bare text, and hold it against the type of the option."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    if get_origin(kind) is Literal and value not in get_args(kind):
        raise InputError(f"{what} must be {_described(kind)}, not {text!r}")
    try:
        return strict_converter().structure(value, kind)
    except (BaseValidationError, TypeError, ValueError) as error:
        said = str(error) if "must be" in str(error) else f"must be {_described(kind)}, not {text!r}"
        raise InputError(f"{what} {said}") from None


def _described(kind: Any) -> str:
    choices = get_args(kind)
    words = [
        repr(choice) if isinstance(choice, str) else getattr(choice, "__name__", str(choice)) for choice in choices
    ]
    return " or ".join(words) if words else f"a {getattr(kind, '__name__', kind)}"


def _names(part: Any) -> list[str]:
    return [one.name for one in fields(part) if one.init]
