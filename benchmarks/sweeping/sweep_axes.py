"""What a sweep turns: one setting of a scene by name, with the values worth a look and how it changes the scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semrecon.errors import InputError
from semsim.imperfections import StageErrors, ViewErrors
from semsim.overrides import overridden, setting
from semsim.scene import Scene, scaled

Change = Callable[[Scene, float], Scene]


@dataclass(frozen=True)
class Axis:
    """One thing to be varied.

    Parameters
    ----------
    name
        As the command line has it.
    label
        For the axis of a plot, with its unit.
    values
        Where nothing else is said.
    change
        Makes the scene at a value.
    logarithmic
        Whether a plot spaces the values by their ratios.
    """

    name: str
    label: str
    values: tuple[float, ...]
    change: Change
    logarithmic: bool = False

    def at(self, scene: Scene, value: float) -> Scene:
        """Scene at a value, under its old name: the noise of a repetition is the same at all values.

        Raises
        ------
        InputError
            The scene cannot take this value.
        """
        from semsim.errors import InputError as SimError

        try:
            return self.change(scene, value)
        except SimError as error:
            raise InputError(f"sweep {self.name} at {value:g}: {error}") from error


def axis_named(name: str, values: Sequence[float] = ()) -> Axis:
    """Find a known axis, or make one of any numeric setting of a scene, such as ``signal.exponent``.

    Raises
    ------
    InputError
        There is no such axis; or it is a setting and comes without values.
    """
    known = {axis.name: axis for axis in AXES}
    if any(not math.isfinite(value) for value in values):
        raise InputError(f"the values of {name} must be finite numbers, not {list(values)}")
    if name in known:
        return replace(known[name], values=tuple(values) or known[name].values)
    if "." not in name:
        raise InputError(
            f"there is no sweep {name!r}; there are {', '.join(known)}, or a setting such as spot.sigma_px"
        )
    if not values:
        raise InputError(f"the setting {name} has no values of its own; give some, such as --values 1,2,4")
    return Axis(name, name, tuple(values), partial(_with_setting, name=name))


def _with_setting(scene: Scene, value: float, name: str) -> Scene:
    return overridden(scene, {name: value})


def _tilt(scene: Scene, value: float) -> Scene:
    """Scale the tilts about the reference view, so that the range from least to greatest is `value` degrees."""
    tilts = _tilts(scene, "tilt")
    middle = tilts[scene.schedule.reference]
    wanted = middle + (tilts - middle) * value / np.ptp(tilts)
    return replace(scene, schedule=replace(scene.schedule, tilts_deg=tuple(float(each) for each in wanted)))


def _views(scene: Scene, value: float) -> Scene:
    """Spread so many views evenly over the range of tilts."""
    if value != int(value) or value < 2:
        raise InputError(f"sweep views counts whole views, 2 or more, not {value:g}")
    tilts = _tilts(scene, "views")
    if scene.schedule.shifts_um:
        raise InputError(f"sweep views cannot choose the stage positions of {scene.name}; take a scene without shifts")
    spread = tuple(float(each) for each in np.linspace(tilts[0], tilts[-1], int(value)))
    return replace(scene, schedule=replace(scene.schedule, tilts_deg=spread))


def _tilt_error(scene: Scene, value: float) -> Scene:
    """Let the stage go wrong by `value` degrees where it is farthest from the reference, in proportion between."""
    errors = tuple(value * share for share in _shares(scene, "tilt-error"))
    return replace(scene, stage_errors=replace(StageErrors(), tilts_deg=errors))


def _magnification(scene: Scene, value: float) -> Scene:
    """Let the magnification be off by `value` parts in a thousand there, in proportion between."""
    errors = tuple(1e-3 * value * abs(share) for share in _shares(scene, "magnification"))
    return replace(scene, view_errors=replace(ViewErrors(), magnifications=errors))


def _rotation(scene: Scene, value: float) -> Scene:
    """Turn the picture by `value` degrees there, in proportion between."""
    errors = tuple(value * abs(share) for share in _shares(scene, "rotation"))
    return replace(scene, view_errors=replace(ViewErrors(), rotations_deg=errors))


def _pixel_size(scene: Scene, value: float) -> Scene:
    """Photograph the same field with larger or smaller pixels; the dose is that of a pixel, the spot in pixels."""
    return scaled(scene, scene.microscope.pixel_size_um / value) if value > 0 else _refused("pixel-size", value)


def _perspective(scene: Scene, value: float) -> Scene:
    """Bring the pivot of the scan to `value` mm."""
    if value <= 0:
        return _refused("perspective", value)
    return replace(scene, microscope=replace(scene.microscope, working_distance_um=1e3 * value))


def _texture(scene: Scene, value: float) -> Scene:
    """Set the contrast of the material, standard deviation over mean."""
    if setting(scene, "specimen.contrast") is None:
        raise InputError(f"sweep texture: the specimen of {scene.name} has no setting specimen.contrast")
    return overridden(scene, {"specimen.contrast": value})


def _refused(name: str, value: float) -> Scene:
    raise InputError(f"sweep {name} takes positive values, not {value:g}")


def _tilts(scene: Scene, name: str) -> np.ndarray:
    tilts = np.asarray(scene.schedule.tilts_deg)
    if np.ptp(tilts) == 0:
        raise InputError(f"sweep {name} needs a scene whose views differ in tilt; {scene.name} has none")
    return tilts


def _shares(scene: Scene, name: str) -> list[float]:
    """Tilt of each view from the reference over the largest of them, signed."""
    tilts = _tilts(scene, name)
    apart = tilts - tilts[scene.schedule.reference]
    return [float(each) for each in apart / np.abs(apart).max()]


AXES: tuple[Axis, ...] = (
    Axis("tilt", "range of tilts (deg)", (2.0, 4.0, 8.0, 16.0, 30.0), _tilt, logarithmic=True),
    Axis(
        "dose",
        "dose (electrons a pixel)",
        (25.0, 50.0, 100.0, 200.0, 400.0, 1600.0),
        partial(_with_setting, name="detector.dose_e"),
        logarithmic=True,
    ),
    Axis("tilt-error", "tilt error at the largest tilt (deg)", (-0.4, -0.2, 0.0, 0.1, 0.2, 0.4), _tilt_error),
    Axis("magnification", "magnification error (parts in a thousand)", (0.0, 0.5, 1.0, 2.0, 4.0), _magnification),
    Axis("rotation", "rotation in the image plane (deg)", (0.0, 0.1, 0.3, 1.0), _rotation),
    Axis(
        "drift",
        "wandering drift (px, 1 sigma)",
        (0.0, 0.1, 0.3, 1.0, 3.0),
        partial(_with_setting, name="scan.wander_px"),
    ),
    Axis("spot", "spot (px, 1 sigma)", (0.4, 0.7, 1.0, 1.5, 2.5), partial(_with_setting, name="spot.sigma_px")),
    Axis("texture", "material contrast (sigma / mean)", (0.01, 0.02, 0.05, 0.1, 0.2), _texture, logarithmic=True),
    Axis("perspective", "working distance (mm)", (1.0, 2.0, 5.0, 10.0, 30.0), _perspective, logarithmic=True),
    Axis("views", "views over the same range of tilts", (2.0, 3.0, 4.0, 6.0, 9.0), _views),
    Axis("pixel-size", "pixel size (um)", (0.15, 0.2, 0.3, 0.4), _pixel_size, logarithmic=True),
)
"""All axes with names of their own, in the order of lists."""
