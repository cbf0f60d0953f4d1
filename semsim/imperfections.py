"""What stage and column do beside what they say: the errors that stand in the truth and in no nominal setting.

Each error is stated for every view, or drawn from its standard deviation, or both (they add). All are 0 by default.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from semsim.errors import InputError
from semsim.mesh import Array


@dataclass(frozen=True)
class StageErrors:
    """Errors of the stage: true minus nominal.

    Parameters
    ----------
    tilts_deg
        Error of the tilt of each view, degrees; empty is none at all.
    tilt_sigma_deg
        Standard deviation of a further error of each tilt, degrees; a good stage has about 0.1.
    tilt_axis_deg
        Error of the direction of the tilt axis in the image plane, degrees, the same for all views.
    axis_point_um
        A point of the tilt axis, world frame (x, y, z), um. The origin is eucentric; with any other point the specimen
        swings about the axis, sideways and up and down, as it is tilted.
    shift_sigma_um
        Standard deviation of where the operator brings the specimen back to after a tilt, in x and y, um; the reference
        view (that nearest zero tilt) stays.

    Raises
    ------
    InputError
        A value is not finite, or a standard deviation negative.
    """

    tilts_deg: tuple[float, ...] = ()
    tilt_sigma_deg: float = 0.0
    tilt_axis_deg: float = 0.0
    axis_point_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_sigma_um: float = 0.0

    def __post_init__(self) -> None:
        _check("stage_errors", self)


@dataclass(frozen=True)
class ViewErrors:
    """Errors of the image scale and shape of each view, an affine map about the centre of the picture.

    Parameters
    ----------
    magnifications
        True over nominal magnification, minus 1, of each view; empty is none at all.
    rotations_deg
        How far the picture of each view is turned, degrees, counter-clockwise as it is seen.
    skews
        By how many columns the picture of each view leans to the right a row further down.
    magnification_sigma, rotation_sigma_deg, skew_sigma
        Standard deviation of a further error of each view.

    Raises
    ------
    InputError
        A value is not finite, a standard deviation negative, or a magnification vanishes.
    """

    magnifications: tuple[float, ...] = ()
    rotations_deg: tuple[float, ...] = ()
    skews: tuple[float, ...] = ()
    magnification_sigma: float = 0.0
    rotation_sigma_deg: float = 0.0
    skew_sigma: float = 0.0

    def __post_init__(self) -> None:
        _check("view_errors", self)
        if any(magnification <= -1 for magnification in self.magnifications):
            raise InputError("view_errors magnifications are true over nominal minus 1 and must be greater than -1")


@dataclass(frozen=True, eq=False)
class Drawn:
    """The errors of every view, stated and drawn together.

    Parameters
    ----------
    tilts_deg
        (views,).
    shifts_um
        (views, 2) along camera x and y, um.
    distortions
        (views, 2, 2) true picture from ideal picture, both about the centre.
    """

    tilts_deg: Array
    shifts_um: Array
    distortions: Array


def draw(stage: StageErrors, views: ViewErrors, number: int, rng: np.random.Generator) -> Drawn:
    """Settle the errors of `number` views; each view draws from a child of its own, stage and column apart.

    Raises
    ------
    InputError
        An error is stated for another number of views.
    """
    chance = [(each.normal(size=3), other.normal(size=3)) for each, other in (c.spawn(2) for c in rng.spawn(number))]
    of_stage, of_column = (np.stack(part) for part in zip(*chance, strict=True))
    scales = [views.magnification_sigma, views.rotation_sigma_deg, views.skew_sigma]
    stated = [
        _stated(f"view_errors {name}", getattr(views, name), number)
        for name in ("magnifications", "rotations_deg", "skews")
    ]
    column = np.stack(stated, axis=1) + of_column * scales
    return Drawn(
        _stated("stage_errors tilts_deg", stage.tilts_deg, number) + of_stage[:, 0] * stage.tilt_sigma_deg,
        of_stage[:, 1:] * stage.shift_sigma_um,
        np.stack([distortion(m, np.deg2rad(turn), skew) for m, turn, skew in column]),
    )


def distortion(magnification: float, rotation_rad: float, skew: float) -> Array:
    """Affine map (2, 2) of image offsets (columns, rows): lean, then turn counter-clockwise, then enlarge.

    Parameters
    ----------
    magnification
        Relative error; 0 is none.
    """
    c, s = np.cos(rotation_rad), np.sin(rotation_rad)
    # Rows count downwards, so what is counter-clockwise for the eye has its signs the other way round.
    return np.asarray((1 + magnification) * np.array([[c, s], [-s, c]]) @ np.array([[1.0, skew], [0.0, 1.0]]))


def _stated(name: str, values: tuple[float, ...], number: int) -> Array:
    if values and len(values) != number:
        raise InputError(f"{name} must hold one error for each of the {number} views, not {len(values)}")
    return np.array(values or (0.0,) * number)


def _check(section: str, errors: StageErrors | ViewErrors) -> None:
    for field in fields(errors):
        value = getattr(errors, field.name)
        if not np.isfinite(value).all():
            raise InputError(f"{section} {field.name} must be finite, not {value}")
        if "sigma" in field.name and value < 0:
            raise InputError(f"{section} {field.name} is a standard deviation and must not be negative: {value}")
