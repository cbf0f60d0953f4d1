"""Scenes by name: one line each says what is photographed, at which scale and tilts."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semsim.errors import InputError
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene, scene_from
from semsim.signal import SignalOptions


@dataclass(frozen=True)
class NamedScene:
    """What makes a named scene.

    Parameters
    ----------
    about
        One sentence for lists and captions.
    microscope, schedule, signal
        As in `Scene`; all else has its default.
    specimen
        Options of the specimen where it is not simply the one that bears the scene's name.
    """

    about: str
    microscope: Microscope
    schedule: TiltSchedule
    signal: SignalOptions = field(default_factory=SignalOptions)
    specimen: Mapping[str, Any] = field(default_factory=dict)


PRINT = Microscope.from_data_bar(5, 34, 854, 640)
SMALL = Microscope(0.5, 256, 192)
SAND = Microscope(1.2, 854, 640, working_distance_um=10_000.0)
NEAR_SAND = Microscope(0.6, 854, 640, working_distance_um=5_000.0)
WIDE_PORES = SignalOptions(shadow_reach_um=80.0)
THREE = TiltSchedule((0.0, 5.0, 10.0))
SLIDE = TiltSchedule((0.0,) * 7, 0.0, tuple((50.0 * i, 0.0) for i in range(7)))

NAMED: dict[str, NamedScene] = {
    "pollen": NamedScene(
        "A reticulate pollen grain, with the geometry of the seed paper's Table 1.",
        PRINT,
        TiltSchedule((0.0, 3.0, 6.0, 9.0)),
    ),
    "diatom": NamedScene(
        "The pored valve of a diatom, with the geometry of the seed paper's Table 1.",
        Microscope.from_data_bar(5, 60, 2560, 1920),
        TiltSchedule((0.0, -15.0, -30.0)),
    ),
    "fracture": NamedScene("A fractured rock face, self-affine, with facets.", PRINT, THREE),
    "grains": NamedScene(
        "A bed of rounded sand grains at 124x, in perspective.", SAND, TiltSchedule((-7.0, 0.0, 7.0)), WIDE_PORES
    ),
    "spheres": NamedScene("Calibration balls of five radii on a carrier.", PRINT, TiltSchedule((-10.0, 0.0, 10.0))),
    "pyramid": NamedScene("A stepped calibration pyramid.", PRINT, TiltSchedule((-8.0, 0.0, 8.0))),
    "steps": NamedScene("A calibration staircase of known rise and pitch.", PRINT, TiltSchedule((0.0, 7.0, 14.0))),
    "wires": NamedScene("Crossing wires above a carrier.", PRINT, TiltSchedule((-10.0, -5.0, 0.0, 5.0, 10.0))),
    "translation": NamedScene(
        "Sand grains from near; the stage slides by 50 um a view and does not tilt: parallax by perspective alone.",
        NEAR_SAND,
        SLIDE,
        WIDE_PORES,
        {"name": "grains", "frame_width_um": 1200.0, "frame_height_um": 400.0},
    ),
    "plane": NamedScene("A speckled plane, inclined: truth is a formula.", SMALL, THREE),
    "step": NamedScene("A speckled step with an upright wall: truth is a formula.", SMALL, THREE),
    "sphere": NamedScene("A speckled sphere: truth is a formula.", SMALL, THREE),
    "wedge": NamedScene("A speckled roof: truth is a formula.", SMALL, THREE),
}
"""All named scenes, in the order of lists."""


def scene(name: str) -> Scene:
    """Make a named scene; raises InputError for a name that is not one."""
    from semsim.specimens import specimen_from

    if name not in NAMED:
        raise InputError(f"no scene is called {name!r}; there are {', '.join(NAMED)}")
    known = NAMED[name]
    return Scene(name, specimen_from(known.specimen or {"name": name}), known.microscope, known.schedule, known.signal)


def geometry(microscope: Microscope, schedule: TiltSchedule) -> str:
    """Say in a few words how large the pictures are and how the stage moves."""
    tilts = schedule.tilts_deg
    size = f"{microscope.width_px} x {microscope.height_px} px of {microscope.pixel_size_um:.4g} um"
    if len(set(tilts)) == 1 and schedule.shifts_um:
        return f"{size}, {len(tilts)} views, shifted, all at tilt {tilts[0]:g} degrees"
    said = ", ".join(f"{tilt:g}" for tilt in tilts)
    return (
        f"{size}, tilts {said if len(tilts) <= 8 else f'{tilts[0]:g} to {tilts[-1]:g} in {len(tilts)} views'} degrees"
    )


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
