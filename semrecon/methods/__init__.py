"""Methods of reconstruction: one file a method, all with the call of `base.Method`. To add one, add a line here."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from semrecon.errors import InputError
from semrecon.methods.base import Method
from semrecon.methods.disparity import Disparity, DisparityIcp
from semrecon.methods.known_rotation import KnownRotation

__all__ = ["METHODS", "Disparity", "DisparityIcp", "KnownRotation", "Method", "method_named"]

METHODS: tuple[Method, ...] = (KnownRotation(), Disparity(), DisparityIcp())
"""Every method with its default options."""


def method_named(name: str, **options: Any) -> Method:
    """Pick a method by its name (hyphens and underscores are alike) and set its options.

    Raises
    ------
    InputError
        There is no such method, or it has no such option.
    """
    found = next((method for method in METHODS if method.name == name.replace("-", "_")), None)
    if found is None:
        raise InputError(f"there is no method {name!r}; the methods are {', '.join(m.name for m in METHODS)}")
    allowed = [one.name for one in fields(found)]  # type: ignore[arg-type]  # a Method is a dataclass by agreement
    unknown = [option for option in options if option not in allowed]
    if unknown:
        raise InputError(f"method {found.name} has no option {unknown[0]!r}; its options are {', '.join(allowed)}")
    return replace(found, **options)  # type: ignore[type-var]
