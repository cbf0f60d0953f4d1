"""Bring a surface of unknown pose, and if asked of unknown size, onto the truth: a search, then a fit.

The search lays the mean plane of the surface on that of the truth, either side up, turns it in the plane step by step,
and correlates coarse height maps with their holes left out (Padfield 2012), which finds the shift. The best few are
fitted by `semrecon.agreement.surface_alignment`, and the one that lies nearest is kept. Nothing is drawn by chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.spatial.transform import Rotation

from semrecon.agreement.surface_alignment import FREE, Alignment, Target, align
from semrecon.data import Array, Mask
from semrecon.errors import InputError

TURNS = 60
"""Directions tried in the plane; 6 degrees apart."""
SIZES = tuple(float(each) for each in np.geomspace(0.65, 1 / 0.65, 7))
"""Scales tried, about the one that makes both surfaces equally wide."""
CELLS = (16, 32)
"""Fewest and most cells along the longer side of the maps that are correlated."""
OVERLAP = 0.4
"""Least common part, as a share of the largest there can be."""
FITTED = 6
"""Starts that are fitted to the end."""
MOST_SEARCHED = 6_000
"""Points whose heights are correlated."""
MOST_FITTED = 40_000
"""Points that take part in a fit, evenly among all; seven numbers need no more."""
FOUND_PX = 0.02
"""Median distance, in pixels, at which the search is over."""
LEAST = 30
TOP_PX = 4.0
"""Cell, in pixels, of whose points the lower ones may be the underside."""
OVERTURNED = np.diag([1.0, -1.0, -1.0])
"""From a camera frame (y down, z into the specimen) to the view frame."""


@dataclass(frozen=True)
class Motion:
    """What was done to a surface: ``p' = linear p + shift_um``, in the view frame of the reference view."""

    linear: Array = field(default_factory=lambda: np.eye(3))
    shift_um: Array = field(default_factory=lambda: np.zeros(3))

    def apply(self, xyz_um: Array) -> Array:
        """Move points, (..., 3)."""
        return np.asarray(xyz_um @ self.linear.T + self.shift_um)

    def then(self, other: Motion) -> Motion:
        """Put another one after it."""
        return Motion(other.linear @ self.linear, other.linear @ self.shift_um + other.shift_um)

    @property
    def mirrored(self) -> bool:
        """Whether left and right were exchanged."""
        return bool(np.linalg.det(self.linear) < 0)

    @property
    def scale(self) -> float:
        """Factor on all lengths."""
        return float(abs(np.linalg.det(self.linear)) ** (1 / 3))

    @property
    def turn(self) -> Array:
        """Rotation as a vector along its axis of the length of its angle, degrees, (3,); of the heights if mirrored."""
        proper = self.linear @ np.diag([1.0, 1.0, -1.0]) if self.mirrored else self.linear
        return np.asarray(Rotation.from_matrix(proper / self.scale).as_rotvec(degrees=True))

    @property
    def overturned(self) -> bool:
        """Whether what was up is down now, as it must be where z of the surface goes into the specimen."""
        return bool(self.linear[2, 2] < 0)


@dataclass(frozen=True)
class Wanted:
    """What may be done: a gauge of `FREE`, either side up or not, inside out or not.

    `closed` says that the surface may have an underside, as meshes have, of which the view sees nothing.
    """

    gauge: str = "rigid"
    either_side: bool = True
    mirror: bool = False
    closed: bool = False


@dataclass(frozen=True)
class _Map:
    """Mean heights on coarse cells, their plane taken away, and where they are known: both (rows, columns)."""

    heights: Array
    known: Array


def placed(points_um: Array, target: Target, wanted: Wanted) -> Motion:
    """Find the motion that brings points onto the truth.

    Parameters
    ----------
    points_um
        Evenly spread over the surface, (n, 3), finite, in the view frame as far as it is known.
    target
        True heights on the pixels of the reference view.

    Raises
    ------
    InputError
        No start of the search has the two overlap.
    """
    if wanted.gauge in ("offset", "plane"):
        found = fitted(_on_top(points_um, target, wanted), target, wanted.gauge)
        return found[1] if found is not None else _no_overlap(len(points_um))
    ends: list[tuple[float, Motion]] = []
    for start in _starts(points_um, target, wanted):
        end = fitted(_on_top(start.apply(points_um), target, wanted), target, wanted.gauge)
        if end is not None:
            ends.append((end[0], start.then(end[1])))
            if end[0] < FOUND_PX * target.pixel_size_um:
                break  # nothing else can lie as near
    return min(ends, key=lambda each: each[0])[1] if ends else _no_overlap(len(points_um))


def fitted(points_um: Array, target: Target, gauge: str) -> tuple[float, Motion] | None:
    """Fit what a gauge leaves free; the median distance along the beam, um, and the motion.

    A start that ends with hardly a point on the truth has not found it: None.
    """
    asked = points_um[:: -(-len(points_um) // MOST_FITTED)]
    try:
        done = align(asked, target, Alignment(gauge, FREE[gauge]))
    except (InputError, np.linalg.LinAlgError):
        return None
    missing = target.missing_um(done.apply(asked))
    known = np.isfinite(missing)
    if known.sum() < max(LEAST, 0.2 * min(len(asked), int(np.isfinite(target.z_um).sum()))):
        return None
    return float(np.median(np.abs(missing[known]))), _motion(done)


def _on_top(points_um: Array, target: Target, wanted: Wanted) -> Array:
    """Leave out the underside of a closed surface, as it lies."""
    if not wanted.closed or not len(points_um):
        return points_um
    return points_um[_tops(points_um, TOP_PX * target.pixel_size_um)]


def _tops(points_um: Array, cell_um: float) -> Mask:
    """Tell which points lie no farther below the highest point of their cell than two cells are wide."""
    at = np.floor(points_um[:, :2] / cell_um).astype(np.int64)
    at -= at.min(axis=0)
    cell = at[:, 1] * (int(at[:, 0].max()) + 1) + at[:, 0]
    _, index = np.unique(cell, return_inverse=True)
    highest = np.full(int(index.max()) + 1, -np.inf)
    np.maximum.at(highest, index, points_um[:, 2])
    return np.asarray(points_um[:, 2] > highest[index] - 2 * cell_um)


def _motion(done: Alignment) -> Motion:
    """Read off the affine map of an alignment, slopes included."""
    at = done.apply(np.vstack([np.zeros(3), np.eye(3)]))
    return Motion((at[1:] - at[0]).T, at[0])


def _no_overlap(count: int) -> Motion:
    raise InputError(
        f"no way was found to lay the {count} points of the surface on the scene; is its unit right (--unit-um), or "
        "its size unknown (--align similarity)?"
    )


def _starts(points_um: Array, target: Target, wanted: Wanted) -> Iterator[Motion]:
    """Yield starts: as it stands, then the most promising ones, best first."""
    yield Motion()
    fixed_points = _points_of(target)
    few = points_um[:: -(-len(points_um) // MOST_SEARCHED)]
    cells = int(np.clip(np.sqrt(len(few) / 2), *CELLS))
    width = float(np.ptp(fixed_points[:, :2], axis=0).max())
    cell = width / cells
    fixed = _binned(fixed_points, fixed_points[:, :2].mean(axis=0), cell)
    tried = []
    for turned in _turned(few, fixed_points, wanted):
        moved = turned.apply(few)
        if wanted.closed:
            moved = moved[_tops(moved, cell)]
        value, shift = _correlation(fixed, _binned(moved, moved[:, :2].mean(axis=0), cell), cell)
        across = fixed_points[:, :2].mean(axis=0) - moved[:, :2].mean(axis=0) + shift
        lift = float(np.median(fixed_points[:, 2]) - np.median(moved[:, 2]))
        tried.append((value, turned.then(Motion(shift_um=np.append(across, lift)))))
    best = sorted(tried, key=lambda each: -each[0])[:FITTED]
    yield from (motion for _, motion in best)


def _turned(points_um: Array, fixed_um: Array, wanted: Wanted) -> Iterator[Motion]:
    """Motions about the middle of the points: sides, turns in the plane and sizes."""
    middle = np.median(points_um, axis=0)
    flat, up = _normal(points_um), _normal(fixed_um)
    ratio = _width(fixed_um) / _width(points_um)
    sizes = tuple(ratio * each for each in SIZES) if wanted.gauge == "similarity" else (1.0,)
    for inward in [False, True] if wanted.mirror else [False]:
        reflection = np.diag([1.0, 1.0, -1.0]) if inward else np.eye(3)
        leaning = reflection @ flat
        leaning = leaning * np.sign(leaning[2] or 1.0)
        sides = [np.eye(3), _onto(leaning, up)]
        if wanted.either_side:
            sides += [OVERTURNED, _onto(-leaning, up)]
        for side in sides:
            for angle in np.arange(TURNS) * (2 * np.pi / TURNS):
                about = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
                for size in sizes:
                    linear = size * about @ side @ reflection
                    yield Motion(linear, middle - linear @ middle)


def _points_of(target: Target) -> Array:
    """List the pixels of the true surface as points of the view frame, (n, 3)."""
    rows, columns = np.nonzero(np.isfinite(target.z_um))
    z = target.z_um[rows, columns]
    scale = target.pixel_size_um * (1 - target.inverse_working_distance * z)
    height, width = target.z_um.shape
    return np.stack([(columns - (width - 1) / 2) * scale, ((height - 1) / 2 - rows) * scale, z], axis=1)


def _normal(points_um: Array) -> Array:
    """Find the unit normal of the plane of most points, (3,), up; a few far outliers do not count."""
    arms = points_um - np.median(points_um, axis=0)
    size = np.linalg.norm(arms, axis=1)
    near = arms[size <= 4 * np.median(size)]
    near = near - near.mean(axis=0)
    normal = np.linalg.eigh(near.T @ near)[1][:, 0]
    return np.asarray(normal * np.sign(normal[2] or 1.0))


def _width(points_um: Array) -> float:
    """Root of the mean squares along the two wide directions of most points."""
    arms = points_um - np.median(points_um, axis=0)
    size = np.linalg.norm(arms, axis=1)
    near = arms[size <= 4 * np.median(size)]
    return float(np.sqrt(np.linalg.eigvalsh(near.T @ near / len(near))[1:].sum()))


def _onto(one: Array, other: Array) -> Array:
    """Find the shortest rotation of one unit vector to another, (3, 3); about x where they are opposite."""
    if one @ other < -1 + 1e-9:
        return OVERTURNED
    return np.asarray(Rotation.align_vectors(other[None], one[None])[0].as_matrix())


def _binned(points_um: Array, centre_um: Array, cell_um: float) -> _Map:
    """Mean height in the cells about a centre, with the plane of the known ones taken away."""
    at = np.floor((points_um[:, :2] - centre_um) / cell_um).astype(np.int64)
    reach = int(np.clip(np.abs(at).max() + 1, 1, 2 * CELLS[1]))
    inside = (np.abs(at + 0.5) < reach).all(axis=1)
    flat = (at[inside, 1] + reach) * 2 * reach + at[inside, 0] + reach
    count = np.bincount(flat, minlength=4 * reach**2).astype(np.float64)
    total = np.bincount(flat, points_um[inside, 2], minlength=4 * reach**2)
    known = count > 0
    rows, columns = np.divmod(np.flatnonzero(known), 2 * reach)
    mean = total[known] / count[known]
    heights = np.zeros(4 * reach**2)
    shape = (2 * reach, 2 * reach)
    if not known.any():
        return _Map(heights.reshape(shape), heights.reshape(shape))
    design = np.stack([columns - columns.mean(), rows - rows.mean(), np.ones(len(rows))], axis=1)
    heights[known] = mean - design @ np.linalg.lstsq(design, mean, rcond=None)[0]
    return _Map(heights.reshape(shape), known.astype(np.float64).reshape(shape))


def _correlation(fixed: _Map, moving: _Map, cell_um: float) -> tuple[float, Array]:
    """Largest normalised correlation over all shifts, holes left out, and that shift of the moving map, (2,) um."""
    shape = tuple(
        next_fast_len(a + b - 1, real=True) for a, b in zip(fixed.known.shape, moving.known.shape, strict=True)
    )
    f, f1, ff = (rfft2(each, shape) for each in (fixed.heights, fixed.known, fixed.heights**2))
    m, m1, mm = (np.conj(rfft2(each, shape)) for each in (moving.heights, moving.known, moving.heights**2))
    count, both, sum_f, sum_m, square_f, square_m = (
        irfft2(each, shape) for each in (f1 * m1, f * m, f * m1, f1 * m, ff * m1, f1 * mm)
    )
    enough = count > OVERLAP * min(fixed.known.sum(), moving.known.sum())
    count = np.maximum(count, 1.0)
    spread = np.maximum(square_f - sum_f**2 / count, 0) * np.maximum(square_m - sum_m**2 / count, 0)
    floor = 1e-9 * float(spread.max())
    product = (both - sum_f * sum_m / count) / np.sqrt(np.maximum(spread, max(floor, 1e-300)))
    value = np.where(enough & (spread > floor), product, -1.0)
    best = np.unravel_index(int(np.argmax(value)), value.shape)
    lag = [index if index < fixed.known.shape[axis] else index - shape[axis] for axis, index in enumerate(best)]
    centres = (np.array(fixed.known.shape) - np.array(moving.known.shape)) / 2  # both maps are about their middle
    down, right = (np.array(lag) - centres) * cell_um
    return float(value[best]), np.array([right, down])


def named(motion: Motion) -> Sequence[str]:
    """Say the amounts of a motion."""
    angle = float(np.linalg.norm(motion.turn))
    axis = motion.turn / angle if angle > 1e-9 else np.array([0.0, 0.0, 1.0])
    about = " ".join(f"{each + 0.0:.3f}" for each in np.round(axis, 3))
    shift = " ".join(f"{each + 0.0:.4g}" for each in np.round(motion.shift_um, 6))
    said = [f"moved by ({shift}) um along x, y, z", f"turned by {angle:.4g} degrees about ({about})"]
    return [
        *said,
        f"scaled by {motion.scale:.6g}",
        *(["turned inside out (z changed its sign)"] if motion.mirrored else []),
    ]
