"""A scene: everything that decides what the micrographs look like, save the seed of their noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semsim.charging import ChargingOptions
from semsim.databar import DataBarOptions
from semsim.detector import DetectorOptions
from semsim.errors import InputError
from semsim.imperfections import StageErrors, ViewErrors
from semsim.microscope import PRINT_WIDTH_UM, UM_PER_INCH, Microscope, TiltSchedule
from semsim.scan import ScanOptions
from semsim.signal import SignalOptions
from semsim.spot import SpotOptions
from semsim.structure import plain, structured

if TYPE_CHECKING:
    from semsim.specimens import Specimen


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
        Pixel grid, projection and stage, as the instrument states them.
    signal, spot, charging, detector
        Contrast mechanisms, shape of the beam, streaks, dose and electronics.
    stage_errors, view_errors, scan
        Where stage, column and beam are beside what they state.
    data_bar
        Rows below the pictures in the files, with scale and settings; the truth has none.
    specimen_seed
        Seed of the specimen's shape, apart from that of the noise: repetitions photograph the same grain.
    instrument_seed
        Seed of the errors of stage, column and scan, apart from that of the noise: repetitions of the noise share them,
        so that surfaces are found once. Other errors are another scene.
    """

    name: str
    specimen: Specimen
    microscope: Microscope
    schedule: TiltSchedule
    signal: SignalOptions = field(default_factory=SignalOptions)
    spot: SpotOptions = field(default_factory=SpotOptions)
    charging: ChargingOptions = field(default_factory=ChargingOptions)
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    stage_errors: StageErrors = field(default_factory=StageErrors)
    view_errors: ViewErrors = field(default_factory=ViewErrors)
    scan: ScanOptions = field(default_factory=ScanOptions)
    data_bar: DataBarOptions = field(default_factory=DataBarOptions)
    specimen_seed: int = 0
    instrument_seed: int = 0

    def __post_init__(self) -> None:
        for name in ("specimen_seed", "instrument_seed"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} must not be negative: {getattr(self, name)}")


SECTIONS: dict[str, type] = {
    "schedule": TiltSchedule,
    "signal": SignalOptions,
    "spot": SpotOptions,
    "charging": ChargingOptions,
    "detector": DetectorOptions,
    "stage_errors": StageErrors,
    "view_errors": ViewErrors,
    "scan": ScanOptions,
    "data_bar": DataBarOptions,
}
"""Tables of a scene's file that hold the fields of a dataclass."""


def scene_from(table: Mapping[str, Any], name: str = "scene", base_dir: Path | None = None) -> Scene:
    """Make a scene from the tables of a TOML file.

    Parameters
    ----------
    table
        Holds `specimen`, `microscope` and `schedule`, and where wanted the other fields of a scene.
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
    rest: dict[str, Any] = {
        key: structured(table[key], kind, f"[{key}]") for key, kind in SECTIONS.items() if key in table
    }
    rest |= {key: structured(table[key], int, key) for key in ("specimen_seed", "instrument_seed") if key in table}
    return Scene(
        name=str(table.get("name", name)),
        specimen=specimen_from(table["specimen"], base_dir),
        microscope=_microscope_from(table["microscope"]),
        **rest,
    )


def tables(scene: Scene) -> dict[str, Any]:
    """Tables of a TOML file from which `scene_from` makes the same scene."""
    specimen = plain(scene.specimen)
    if "file" not in specimen:
        specimen = {"name": scene.specimen.name, **specimen}
    seeds = {"specimen_seed": scene.specimen_seed, "instrument_seed": scene.instrument_seed}
    answer: dict[str, Any] = {"name": scene.name, **seeds, "specimen": specimen}
    for section in ("microscope", *SECTIONS):
        if getattr(scene, section) is not None:
            answer[section] = plain(getattr(scene, section))
    return answer


def scaled(scene: Scene, factor: float) -> Scene:
    """Photograph the same field with `factor` times the columns and rows.

    The spot in focus and the scan errors keep their size in pixels, so that the picture stays as sharp and as steady
    as it looks; the blur out of focus, the errors of the stage and all else stated in um stay on the specimen.

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
    said = {key: structured(table[key], float, f"[microscope] {key}") for key in sorted(ways & set(table))}
    if any(not value > 0 for value in said.values()):
        raise InputError(f"[microscope] {' and '.join(said)} must be positive")
    rest = {key: value for key, value in table.items() if key not in ways}
    width = structured(table.get("width_px", 1), int, "[microscope] width_px")
    return structured(rest | {"pixel_size_um": _pixel_size_um(said, width)}, Microscope, "[microscope]")


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
