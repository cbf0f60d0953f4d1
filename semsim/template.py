"""A scene as a TOML file to edit: every key with its meaning, unit and default, read from the docstrings themselves."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import textwrap
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from semsim.scene import Scene

WIDTH = 116
"""Columns of a comment."""
UNITS = {
    "um": "um",
    "um2": "um^2",
    "nm": "nm",
    "mm": "mm",
    "px": "px",
    "deg": "degrees",
    "rad": "radians",
    "mrad": "mrad",
    "e": "electrons",
    "s": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "hz": "Hz",
    "kv": "kV",
    "pa": "pA",
    "na": "nA",
    "grey": "grey levels",
}
"""What the last part of a name says of its unit."""
_SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.MULTILINE)


def commented_toml(scene: Scene) -> str:
    """Write a scene as TOML from which `load_scene` makes the same scene, each key under a comment of its own.

    A table that is switched off is written as a comment with its default values: take the `#` away to switch it on.
    """
    head = f"# {scene.name}: a scene for `semsim render`. Keys that are left out take their defaults."
    return "\n".join([head, "", *_lines(type(scene), _values(scene), "")]).rstrip() + "\n"


def commented_table(kind: type, path: str) -> str:
    """Write one table, such as a specimen's, with its default values."""
    return "\n".join(_table(kind, _defaults(kind), path)).rstrip() + "\n"


def explanations(kind: type) -> dict[str, str]:
    """Return what a dataclass says of its fields: the `Parameters` of its NumPy docstring and of those it inherits."""
    answer: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        answer |= _parameters(inspect.cleandoc(vars(each).get("__doc__") or ""))
    return answer


def summary(kind: type) -> str:
    """Return the first line of a docstring."""
    return (kind.__doc__ or "").strip().splitlines()[0]


def options(kind: type) -> dict[str, Any]:
    """Return the options of a dataclass that have a default, with it."""
    return {name: value for name, value in _defaults(kind).items() if value is not dataclasses.MISSING}


def unit(name: str) -> str:
    """Return the unit that a name's suffix states; empty where it states none.

    >>> unit("pixel_size_um"), unit("gain_per_e"), unit("bits")
    ('um', 'per electron', '')
    """
    words = name.split("_")
    stated = UNITS.get(words[-1], "")
    return f"per {stated.removesuffix('s')}" if stated and words[-2:-1] == ["per"] else stated


def inline(value: Any) -> str:
    """Write a value as TOML on one line; None, which TOML cannot say, as none."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(inline, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {inline(item)}' for key, item in value.items())}}}"
    return repr(value)


def _parameters(docstring: str) -> dict[str, str]:
    """Parse the `Parameters` of a NumPy docstring: unindented names, indented text."""
    parts = _SECTION.split(docstring)
    body = dict(zip(parts[1::2], parts[2::2], strict=True)).get("Parameters", "")
    answer: dict[str, str] = {}
    names: list[str] = []
    for line in body.splitlines():
        if line and not line[0].isspace():
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
        elif line.strip():
            answer |= {name: f"{answer.get(name, '')} {line.strip()}".strip() for name in names}
    return answer


def _lines(kind: type, values: Mapping[str, Any], path: str) -> Iterator[str]:
    """Yield the keys of a table and then the tables within it, as TOML wants it."""
    told, kinds = explanations(kind), _tables_within(kind)
    inner = [field for field in dataclasses.fields(kind) if field.name in kinds or _holds_tables(values, field)]
    for field in dataclasses.fields(kind):
        if field not in inner:
            yield from _entry(field, values[field.name], told.get(field.name, ""))
    yield ""
    for field in inner:
        yield from _inner(values[field.name], kinds.get(field.name), f"{path}.{field.name}".lstrip("."))


def _inner(value: Any, kind: type | None, path: str) -> Iterator[str]:
    """Yield a table, each of several tables, or a commented one where there is none."""
    many = isinstance(value, tuple)
    present = [each for each in (value if many else (value,)) if dataclasses.is_dataclass(each)]
    for each in present:
        yield from _table(type(each), _values(each), path, many)
    if kind is not None and not present:
        yield "# Off. To switch it on, take the # away from the lines that have no space after it."
        off = _table(kind, _defaults(kind), path, many)
        yield from (line if line.startswith("#") or not line else f"#{line}" for line in off)


def _table(kind: type, values: Mapping[str, Any], path: str, many: bool = False) -> Iterator[str]:
    """Yield a table under its heading."""
    yield from _comment(summary(kind))
    yield f"[[{path}]]" if many else f"[{path}]"
    if path == "specimen" and "file" not in values:
        yield "# Which one: `semsim specimens` lists them; or instead of a name, file = a mesh or a height map."
        yield f"name = {inline(getattr(kind, 'name', ''))}"
    yield from _lines(kind, values, path)


def _entry(field: dataclasses.Field[Any], value: Any, told: str) -> Iterator[str]:
    """Yield the comment of a key, and the key; a value of None cannot be said in TOML and is left out."""
    default = _default(field)
    facts = [unit(field.name), "required" if default is dataclasses.MISSING else f"default {inline(default)}"]
    yield from _comment(f"{told} [{'; '.join(filter(None, facts))}]".strip())
    if value is None or value is dataclasses.MISSING:
        yield f"#{field.name} = "
    else:
        yield f"{field.name} = {inline(value)}"


def _comment(text: str) -> Iterator[str]:
    yield from (f"# {line}" for line in textwrap.wrap(text, WIDTH, break_on_hyphens=False, break_long_words=False))


def _values(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def _defaults(kind: type) -> dict[str, Any]:
    return {field.name: _default(field) for field in dataclasses.fields(kind)}


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _holds_tables(values: Mapping[str, Any], field: dataclasses.Field[Any]) -> bool:
    value = values[field.name]
    first = value[0] if isinstance(value, tuple) and value else value
    return dataclasses.is_dataclass(first) and not isinstance(first, type)


def _tables_within(kind: type) -> dict[str, type]:
    """Return which fields are declared to hold a dataclass of options, perhaps none or several, and which."""
    hints = typing.get_type_hints(kind, localns={"Specimen": Any})  # scene.py does not import it
    return {name: found for name, hint in hints.items() if (found := _dataclass_in(hint)) is not None}


def _dataclass_in(hint: Any) -> type | None:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return hint
    return next((found for part in typing.get_args(hint) if (found := _dataclass_in(part)) is not None), None)
