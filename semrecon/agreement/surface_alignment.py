"""Alignment of one surface to another within declared freedoms, robust against parts that differ or are missing.

All in the view frame of the first surface's reference view (x right, y up, z to the gun). A small motion ``d(p)`` of
the second surface changes its height at a fixed place by ``d_z - h_x d_x - h_y d_y`` (h_x, h_y: slopes), which makes
each compared place one linear equation: point to plane, along the beam. Gauss-Newton, damped, with Cauchy weights, the
scale of which follows the median residual.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from semrecon.data import Array, Mask
from semrecon.errors import InputError

SHIFTS = ("shift_x", "shift_y")
FREE: dict[str, tuple[str, ...]] = {
    "offset": ("offset",),
    "plane": ("offset", "slope_x", "slope_y"),
    "rigid": ("offset", *SHIFTS, "turn_x", "turn_y", "turn_z"),
    "similarity": ("offset", *SHIFTS, "turn_x", "turn_y", "turn_z", "scale"),
}
"""What each gauge leaves free; a gauge is the name of a row."""
CAUCHY, MAD = 2.385, 1.4826
"""Cauchy tuning constant (95 % efficient for Gaussian noise), and standard deviations a median deviation."""
LEAST_SCALE_UM = 1e-9
ROUNDS, LEAST = 40, 30
SETTLED_UM = 1e-8
SMOOTHING_PX = 1.0
"""Blur of the heights before their slopes are taken."""
COARSE = 128
"""Cells along the longer side of the maps on which a shift is searched."""


@dataclass(frozen=True)
class Alignment:
    """What was done to the second surface: ``p' = pivot + shift + scale R (p - pivot) + (0, 0, slope . (x, y))``.

    Parameters
    ----------
    gauge, free
        The freedoms asked for, and all that were used, by name.
    reason
        Why, in a sentence.
    pivot_um
        Middle of the compared part, (3,), view frame of the first surface, as all that follows.
    rotation
        R, (3, 3).
    shift_um
        (3,); its z is the offset of heights at the pivot.
    slope
        Height added a um to the right and upward, (2,): a shear, as a plane subtracted from a height map is.
    scale
        Of all lengths.
    """

    gauge: str
    free: tuple[str, ...]
    reason: str = ""
    pivot_um: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))
    shift_um: Array = field(default_factory=lambda: np.zeros(3))
    slope: Array = field(default_factory=lambda: np.zeros(2))
    scale: float = 1.0

    def apply(self, xyz_um: Array) -> Array:
        """Move points, (..., 3)."""
        arm = xyz_um - self.pivot_um
        moved = self.pivot_um + self.shift_um + self.scale * (arm @ self.rotation.T)
        moved[..., 2] += arm[..., :2] @ self.slope
        return np.asarray(moved)

    @property
    def lifts_only(self) -> bool:
        """Whether nothing but a constant height was added."""
        moved = self.shift_um[:2].any() or self.slope.any() or self.scale != 1.0
        return not (moved or (self.rotation != np.eye(3)).any())

    @property
    def offset_um(self) -> float:
        """Height added at the pivot."""
        return float(self.shift_um[2])

    @property
    def tilt_deg(self) -> float:
        """How far the surface was tipped, by the turn or by the slope."""
        normal = self.rotation[:, 2] - np.append(self.slope, 0.0)
        return float(np.rad2deg(np.arctan2(np.hypot(*normal[:2]), normal[2])))

    @property
    def turn_deg(self) -> float:
        """Rotation in the image plane, counter-clockwise as seen."""
        return float(np.rad2deg(np.arctan2(self.rotation[1, 0], self.rotation[0, 0])))

    def __str__(self) -> str:
        """Say the amounts of what was free."""
        said = [f"offset {self.offset_um:.4g} um"]
        if set(SHIFTS) <= set(self.free):
            said.append(f"shift {self.shift_um[0]:.4g} um right and {self.shift_um[1]:.4g} um up")
        if {"slope_x", "turn_x"} & set(self.free):
            said.append(f"tilt {self.tilt_deg:.3g} degrees")
        if "turn_z" in self.free:
            said.append(f"turn in the plane {self.turn_deg:.3g} degrees")
        if "scale" in self.free:
            said.append(f"scale {self.scale:.5g}")
        return ", ".join(said)


@dataclass(frozen=True)
class Target:
    """The first surface: heights on the grid of its view.

    Parameters
    ----------
    z_um
        (rows, columns), NaN where missing; the optical axis passes through the middle.
    pixel_size_um, inverse_working_distance
        Grid and projection.
    """

    z_um: Array
    pixel_size_um: float
    inverse_working_distance: float = 0.0

    def places(self, xyz_um: Array) -> Array:
        """Pixel (column, row) at which points of the view frame are seen, (n, 2)."""
        rows, columns = self.z_um.shape
        scale = self.pixel_size_um * (1 - self.inverse_working_distance * xyz_um[:, 2])
        return np.stack([(columns - 1) / 2 + xyz_um[:, 0] / scale, (rows - 1) / 2 - xyz_um[:, 1] / scale], axis=1)

    def missing_um(self, moved_um: Array) -> Array:
        """Height that must be added to points to lie on this surface, (n,); NaN beside it."""
        return np.asarray(_sampled(self.z_um, self.places(moved_um)) - moved_um[:, 2])


@dataclass(frozen=True)
class _State:
    """Heights to add (n,), slopes of the target (n, 2) and arms from the pivot (n, 3), where both surfaces are."""

    missing: Array
    slopes: Array
    arms: Array
    size_um: float
    scale: float

    def cost(self, scale: float) -> float:
        """Mean Cauchy loss."""
        return float(np.mean(np.log1p((self.missing / scale) ** 2)))


def align(points_um: Array, target: Target, start: Alignment) -> Alignment:
    """Fit the free numbers of an alignment.

    Parameters
    ----------
    points_um
        Points of the second surface, (n, 3) finite, in the view frame of the first.
    start
        Its `free` says what is fitted, the rest where from.

    Raises
    ------
    InputError
        Too few points fall on the first surface to fit what is free.
    """
    aligned = _lifted(points_um, target, start)
    if start.free == ("offset",):
        return aligned
    slopes = np.asarray(np.gradient(blurred(target.z_um, SMOOTHING_PX), target.pixel_size_um))
    best, damping = _state(points_um, target, slopes, aligned), 1e-6
    if best is None:
        raise InputError("the two surfaces overlap in too few places that have a slope; compare larger parts")
    for _ in range(ROUNDS):
        step = _step(best, aligned.free, damping)
        moved = _moved(aligned, step / _units(best, aligned.free))
        state = _state(points_um, target, slopes, moved)
        if state is not None and state.cost(best.scale) <= best.cost(best.scale):
            aligned, best, damping = moved, state, max(damping / 10, 1e-12)
        else:
            damping *= 30
        if np.abs(step).max() <= SETTLED_UM or damping > 1e6:
            break
    return aligned


def find_shift(points_um: Array, target: Target, start: Alignment, overlap: float = 0.3) -> Alignment:
    """Search the shift in the image plane by masked correlation of coarse maps (Padfield 2012).

    Parameters
    ----------
    overlap
        Least common part of the maps, as a share of the larger.
    """
    from skimage.registration import phase_cross_correlation

    cell = max(target.z_um.shape) / COARSE
    half = np.array([-(-columns // 2) for columns in target.z_um.shape[::-1]])
    rows, columns = np.nonzero(np.isfinite(target.z_um))
    fixed = _binned(np.stack([columns, rows], axis=1) + half, target.z_um[rows, columns], 4 * half / cell, cell)
    moved = start.apply(points_um)
    moving = _binned(target.places(moved) + half, moved[:, 2], 4 * half / cell, cell)
    if min(np.isfinite(fixed).sum(), np.isfinite(moving).sum()) < LEAST:
        return start
    down, right = phase_cross_correlation(
        np.nan_to_num(fixed),
        np.nan_to_num(moving),
        reference_mask=np.isfinite(fixed),
        moving_mask=np.isfinite(moving),
        overlap_ratio=overlap,
    )[0]
    shift = np.array([right, -down, 0.0]) * cell * target.pixel_size_um
    return replace(start, shift_um=start.shift_um + shift)


def blurred(z_um: Array, sigma_px: float) -> Array:
    """Gaussian blur of a map with holes, which neither grow nor pull."""
    known = np.isfinite(z_um)
    weight = gaussian_filter(known.astype(np.float64), sigma_px)
    value = gaussian_filter(np.where(known, z_um, 0.0), sigma_px)
    return np.where(known, value / np.maximum(weight, 1e-12), np.nan)


def _binned(at_px: Array, heights_um: Array, cells: Array, cell: float) -> Array:
    """Mean height in each cell of a grid (rows, columns), NaN where there is none; the median is taken away."""
    columns, rows = np.ceil(cells).astype(int)
    at = np.floor(at_px / cell).astype(np.int64)
    inside = ((at >= 0) & (at < [columns, rows])).all(axis=1)
    if not inside.any():
        return np.full((rows, columns), np.nan)
    flat = at[inside, 1] * columns + at[inside, 0]
    count = np.bincount(flat, minlength=rows * columns)
    total = np.bincount(flat, heights_um[inside], minlength=rows * columns)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return np.asarray((mean - np.nanmedian(mean)).reshape(rows, columns))


def _lifted(points_um: Array, target: Target, start: Alignment) -> Alignment:
    """Put the pivot into the middle of the points that fall on the target, and add the median difference of heights."""
    missing = target.missing_um(start.apply(points_um))
    known = np.isfinite(missing)
    if known.sum() < LEAST:
        raise InputError(
            f"the two surfaces do not overlap: of {len(points_um)} places of the second only {int(known.sum())} fall "
            "on the first; compare reconstructions of one specimen in one unit, um"
        )
    pivot = points_um[known].mean(axis=0)
    return replace(start, pivot_um=pivot, shift_um=start.shift_um + [0.0, 0.0, float(np.median(missing[known]))])


def _state(points_um: Array, target: Target, slopes: Array, alignment: Alignment) -> _State | None:
    """Evaluate an alignment; None where too few places are compared."""
    moved = alignment.apply(points_um)
    at = target.places(moved)
    missing, down, right = (_sampled(values, at) for values in (target.z_um, *slopes))
    known: Mask = np.isfinite(missing) & np.isfinite(down) & np.isfinite(right)
    if known.sum() < LEAST:
        return None
    missing = (missing - moved[:, 2])[known]
    arms = moved[known] - alignment.pivot_um - alignment.shift_um
    spread = MAD * float(np.median(np.abs(missing - np.median(missing))))
    size = max(float(np.sqrt(np.mean(arms[:, :2] ** 2))), LEAST_SCALE_UM)
    slope = np.stack([right, -down], axis=1)[known]
    return _State(missing, slope, arms, size, max(CAUCHY * spread, LEAST_SCALE_UM))


def _sampled(values: Array, at_px: Array) -> Array:
    """Interpolate a map linearly at (column, row); NaN outside and where one of the pixels that count is missing."""
    return np.asarray(map_coordinates(values, at_px[:, ::-1].T, order=1, mode="constant", cval=np.nan))


def _columns(state: _State, free: tuple[str, ...]) -> Array:
    """Height that a um of each free number adds, (n, free); turns, slopes and scale count at the distance `size_um`."""
    x, y, z = (state.arms / state.size_um).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    moves = {
        "offset": (zero, zero, one),
        "shift_x": (one, zero, zero),
        "shift_y": (zero, one, zero),
        "turn_x": (zero, -z, y),
        "turn_y": (z, zero, -x),
        "turn_z": (-y, x, zero),
        "scale": (x, y, z),
        "slope_x": (zero, zero, x),
        "slope_y": (zero, zero, y),
    }
    along_x, along_y = state.slopes.T
    return np.stack([up - along_x * dx - along_y * dy for dx, dy, up in (moves[name] for name in free)], axis=1)


def _units(state: _State, free: tuple[str, ...]) -> Array:
    """Tell by what the um of a step must be divided, (free,)."""
    return np.array([state.size_um if name.startswith(("turn", "slope", "scale")) else 1.0 for name in free])


def _step(state: _State, free: tuple[str, ...], damping: float) -> Array:
    """One damped step of all free numbers, um, (free,)."""
    design = _columns(state, free)
    weight = 1 / (1 + (state.missing / state.scale) ** 2)
    matrix = (design * weight[:, None]).T @ design
    size = np.maximum(np.diag(matrix), 1e-12 * np.diag(matrix).max())
    right = design.T @ (weight * state.missing)
    return np.asarray(np.linalg.solve(matrix + damping * np.diag(size), right))


def _moved(alignment: Alignment, step: Array) -> Alignment:
    by = dict(zip(alignment.free, step, strict=True))
    turn = Rotation.from_rotvec([by.get(name, 0.0) for name in ("turn_x", "turn_y", "turn_z")]).as_matrix()
    shift = np.array([by.get("shift_x", 0.0), by.get("shift_y", 0.0), by["offset"]])
    return replace(
        alignment,
        rotation=turn @ alignment.rotation,
        shift_um=alignment.shift_um + shift,
        slope=alignment.slope + [by.get("slope_x", 0.0), by.get("slope_y", 0.0)],
        scale=float(alignment.scale * np.exp(by.get("scale", 0.0))),
    )
