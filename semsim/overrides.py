"""Single settings of a scene changed by name: `detector.dose_e = 50`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Any

from semsim.errors import InputError
from semsim.scene import Scene, scene_from, tables

BACK_TO_DEFAULT = "default"
"""Instead of a value: take a key away, so that its default holds (and a table away, which switches it off)."""


def overridden(scene: Scene, settings: Mapping[str, Any]) -> Scene:
    """Return a scene with some settings changed.

    Parameters
    ----------
    settings
        Value by name as it stands in a scene's TOML, tables separated by dots: ``{"detector.dose_e": 50}``. Another
        ``specimen.name`` comes with the default options of that specimen.

    Raises
    ------
    InputError
        There is no such setting, or the value is of the wrong kind or out of range.

    Examples
    --------
    >>> from semsim.scenes import scene
    >>> overridden(scene("wedge"), {"detector.dose_e": 50}).detector.dose_e
    50.0
    """
    table = tables(scene)
    specimen_first = sorted(settings.items(), key=lambda item: item[0] not in ("specimen.name", "specimen.file"))
    for name, value in specimen_first:
        _set(table, name, value)
    try:
        return scene_from(table, scene.name)
    except InputError as error:
        raise InputError(f"{', '.join(f'{name}={value}' for name, value in settings.items())}: {error}") from error


def setting(scene: Scene, name: str) -> Any:
    """Return the present value of a setting; None where there is none."""
    value: Any = tables(scene)
    for key in name.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def assignment(text: str) -> tuple[str, str]:
    """Split `section.key=value` as it is typed; raises InputError for anything else."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise InputError(f"{text!r} is not a setting; write section.key=value, such as detector.dose_e=50")
    return name, value


def value_of(text: str) -> Any:
    """Read a value as TOML; what is no TOML is a word.

    >>> value_of("50"), value_of("[0.0, 5.0]"), value_of("view")
    (50, [0.0, 5.0], 'view')
    """
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _set(table: dict[str, Any], name: str, value: Any) -> None:
    """Change one entry in tables within tables, in place."""
    *sections, key = name.split(".")
    if name in ("specimen.name", "specimen.file") and table["specimen"].get(key) != value:
        table["specimen"] = {}
    for section in sections:
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            raise InputError(f"{name}: {section} is a single value, not a table with keys of its own")
    if value == BACK_TO_DEFAULT:
        table.pop(key, None)
    else:
        table[key] = value
