"""A scene: everything that decides what the micrographs look like, save the seed of their noise."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cattrs
import cattrs.v
from cattrs.errors import ForbiddenExtraKeysError

from semsim.detector import DetectorOptions
from semsim.errors import InputError
from semsim.microscope import PRINT_WIDTH_UM, UM_PER_INCH, Microscope, TiltSchedule
from semsim.signal import SignalOptions

if TYPE_CHECKING:
    from semsim.specimens import Specimen

T = TypeVar("T")


@dataclass(frozen=True)
class Scene:
    """A specimen in a microscope.

    Parameters
    ----------
    name
        What to call it.
    specimen
        Makes the mesh when called with a generator.
    microscope, schedule
        Pixel grid, projection and stage.
    signal, detector
        Contrast mechanisms, dose and electronics.
    specimen_seed
        Seed of the specimen's shape, apart from that of the noise: repetitions photograph the same grain.
    """

    name: str
    specimen: Specimen
    microscope: Microscope
    schedule: TiltSchedule
    signal: SignalOptions = field(default_factory=SignalOptions)
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    specimen_seed: int = 0


POLLEN = (Microscope.from_data_bar(5, 34, 854, 640), TiltSchedule((0.0, 3.0, 6.0, 9.0)))
DIATOM = (Microscope.from_data_bar(5, 60, 2560, 1920), TiltSchedule((0.0, -15.0, -30.0)))
SMALL = (Microscope(0.5, 256, 192), TiltSchedule((0.0, 5.0, 10.0)))
NAMED = {"pollen": POLLEN, "diatom": DIATOM, "plane": SMALL, "step": SMALL, "sphere": SMALL, "wedge": SMALL}
"""Scenes that carry their specimen's name. Pollen and diatom have the geometry of the seed paper's Table 1."""


def scene(name: str) -> Scene:
    """Make a named scene; raises InputError for a name that is not one."""
    from semsim.specimens import specimen_from

    if name not in NAMED:
        raise InputError(f"no scene is called {name!r}; there are {', '.join(NAMED)}")
    microscope, schedule = NAMED[name]
    return Scene(name, specimen_from({"name": name}), microscope, schedule)


def load_scene(name_or_path: str | Path) -> Scene:
    """Make a named scene, or read one from a TOML file.

    Raises
    ------
    InputError
        Neither; or a file that is not TOML, has an unknown or missing key, or a value out of range.
    """
    path = Path(name_or_path)
    if str(name_or_path) in NAMED:
        return scene(str(name_or_path))
    if not path.is_file():
        raise InputError(f"{path} is neither a TOML file nor a scene; the scenes are {', '.join(NAMED)}")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        return scene_from(table, path.stem, path.parent)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a TOML file: {error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def scene_from(table: Mapping[str, Any], name: str = "scene", base_dir: Path | None = None) -> Scene:
    """Make a scene from the tables of a TOML file.

    Parameters
    ----------
    table
        Holds `specimen`, `microscope` and `schedule`, and where wanted `name`, `signal`, `detector`, `specimen_seed`.
    name
        For a table that has none.
    base_dir
        Where the specimen's file is looked for.
    """
    from semsim.specimens import specimen_from

    sections = {f.name for f in dataclasses.fields(Scene)}
    if unknown := sorted(set(table) - sections):
        raise InputError(f"unknown key {', '.join(unknown)} (known are {', '.join(sorted(sections))})")
    for section in ("specimen", "microscope", "schedule"):
        if not isinstance(table.get(section), Mapping):
            raise InputError(f"a table [{section}] is missing")
    return Scene(
        name=str(table.get("name", name)),
        specimen=specimen_from(table["specimen"], base_dir),
        microscope=_microscope_from(table["microscope"]),
        schedule=_structure(table["schedule"], TiltSchedule, "[schedule]"),
        signal=_structure(table.get("signal", {}), SignalOptions, "[signal]"),
        detector=_structure(table.get("detector", {}), DetectorOptions, "[detector]"),
        specimen_seed=_structure(table.get("specimen_seed", 0), int, "specimen_seed"),
    )


def tables(scene: Scene) -> dict[str, Any]:
    """Tables of a TOML file from which `scene_from` makes the same scene."""
    specimen = _plain(scene.specimen)
    if "file" not in specimen:
        specimen = {"name": scene.specimen.name, **specimen}
    answer: dict[str, Any] = {"name": scene.name, "specimen_seed": scene.specimen_seed, "specimen": specimen}
    for section in ("microscope", "schedule", "signal", "detector"):
        answer[section] = _plain(getattr(scene, section))
    return answer


def scaled(scene: Scene, factor: float) -> Scene:
    """Photograph the same field with `factor` times the columns and rows; the spot keeps its size in pixels.

    Raises
    ------
    InputError
        The factor is not positive, or leaves less than 16 columns or rows.
    """
    old = scene.microscope
    if not 0 < factor < 100:
        raise InputError(f"a scale must be a positive factor, such as 0.5, not {factor}")
    width, height = round(old.width_px * factor), round(old.height_px * factor)
    if min(width, height) < 16:
        raise InputError(f"a scale of {factor} leaves {width} x {height} px of {scene.name}; keep at least 16")
    size_um = old.pixel_size_um * old.width_px / width
    return dataclasses.replace(
        scene, microscope=dataclasses.replace(old, pixel_size_um=size_um, width_px=width, height_px=height)
    )


def _microscope_from(table: Mapping[str, Any]) -> Microscope:
    """Read the microscope, whose pixel size may be stated in several ways (one at a time)."""
    ways = {"pixel_size_um", "bar_um", "bar_px", "bar_mm", "dpi", "magnification", "print_width_um"}
    said = {key: _structure(table[key], float, f"[microscope] {key}") for key in sorted(ways & set(table))}
    if any(not value > 0 for value in said.values()):
        raise InputError(f"[microscope] {' and '.join(said)} must be positive")
    rest = {key: value for key, value in table.items() if key not in ways}
    width = _structure(table.get("width_px", 1), int, "[microscope] width_px")
    return _structure(rest | {"pixel_size_um": _pixel_size_um(said, width)}, Microscope, "[microscope]")


def _pixel_size_um(said: dict[str, float], width_px: int) -> float:
    match said:
        case {"pixel_size_um": size_um, **others} if not others:
            return size_um
        case {"bar_um": bar_um, "bar_px": bar_px, **others} if not others:
            return bar_um / bar_px
        case {"bar_um": bar_um, "bar_mm": bar_mm, "dpi": dpi, **others} if not others:
            return bar_um / (bar_mm * 1e3) * UM_PER_INCH / dpi
        case {"magnification": magnification, "dpi": dpi, **others} if not others:
            return UM_PER_INCH / dpi / magnification
        case {"magnification": magnification, **others} if not others.keys() - {"print_width_um"}:
            return others.get("print_width_um", PRINT_WIDTH_UM) / magnification / width_px
    raise InputError(
        "[microscope] must state the pixel size in exactly one way: pixel_size_um; or bar_um and bar_px; or bar_um, "
        "bar_mm and dpi; or magnification, with dpi or print_width_um where known; "
        f"it has {', '.join(said) or 'none of them'}"
    )


def _structure(value: Any, kind: type[T], where: str) -> T:
    """Turn what TOML holds into a value of ours, or say in one sentence which entry is unknown, missing or wrong."""
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


def _plain(value: Any) -> dict[str, Any]:
    """Fields of a dataclass as TOML can hold them; None is left out, which means the same."""
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return {
        key: str(item.resolve()) if isinstance(item, Path) else item for key, item in fields.items() if item is not None
    }
