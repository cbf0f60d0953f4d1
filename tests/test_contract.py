"""The contract of a method, claimed for every one of `METHODS`; a method without a line in `DECLARED` fails.

The same seed gives the same bits; the input is left alone; what a method does not declare to need, it does not get;
what cannot be answered is refused with one sentence; and on a plane, a step and a sphere of known shape, photographed
by the simulator, units, frames and signs are right. `contract` runs all of it on any method, as docs/adding-a-method.md
does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from types import MappingProxyType

import numpy as np
import pytest

from benchmarks.adapt import series_from_capture
from semrecon.data import Array, Estimate, Image, TiltSeries
from semrecon.errors import InputError, MethodError
from semrecon.judging.gauge import gauge_residual
from semrecon.methods import METHODS, Disparity, DisparityIcp, KnownRotation, Method
from semrecon.surface.completion import complete
from semsim.backscatter import BackscatterOptions
from semsim.capture import simulate
from semsim.microscope import TiltSchedule
from semsim.scenes import scene
from semsim.truth import GroundTruth

SHAPES = ("plane", "step", "sphere")
TILTS = TiltSchedule((0.0, 7.0, 14.0))
SLIDE = TiltSchedule((0.0,) * 7, 0.0, tuple((4.0 * i - 12.0, 0.0) for i in range(7)))
NEAR_UM = 400.0
"""Working distance of the slide: near enough for some pixels of parallax."""
TESTED = 3
"""Seed of speckle and noise on which all is claimed here; none of those that tolerances are from."""
DEVELOPMENT = range(101, 109)
"""Seeds of speckle and noise that tolerances are from."""
MARGIN = 1.5
"""A tolerance is so many times the worst error of the development seeds, rounded up to two digits."""
HALVED = "the printed formula halves the depth"
FLAT = "a plane has no parallax beyond an affine map, so that the cameras stay open"
NO_SHADING = "what it sees is texture: there is no shading to tell the shape by"
NO_PERSPECTIVE = "parallel images do not determine what it takes for perspective, as the seed says"


@dataclass(frozen=True)
class Declared:
    """What a method claims of itself here.

    Parameters
    ----------
    tolerance_um
        Greatest median error of height on plane, step and sphere after its gauge is removed, um (a pixel is 0.5 um), or
        a sentence why it cannot.
    series
        "tilted": three tilts, with backscatter channels. "slide": seven stage positions at one tilt, in perspective.
    package
        What must be installed beside this project.
    """

    plane: float | str
    step: float | str
    sphere: float | str
    series: str = "tilted"
    package: str = "numpy"


DECLARED: dict[str, Declared] = {
    "known_rotation": Declared(0.33, 0.32, 0.43),
    "disparity": Declared(HALVED, HALVED, HALVED),
    "disparity_icp": Declared(HALVED, HALVED, HALVED),
    "dense_multiview": Declared(0.084, 0.12, 0.18),
    "affine_factorization": Declared(FLAT, 0.32, 0.38),
    "multiview_sfm": Declared(FLAT, 0.32, 0.46),
    "photometric_stereo": Declared(0.033, 0.12, 0.53),
    "photometric_stereo_uncalibrated": Declared("a plane is its gauge", 2.9, 1.1),
    "shape_from_shading": Declared(NO_SHADING, NO_SHADING, 2.8),
    "essential_sfm": Declared(NO_PERSPECTIVE, NO_PERSPECTIVE, NO_PERSPECTIVE),
    "incremental_sfm": Declared(NO_PERSPECTIVE, NO_PERSPECTIVE, NO_PERSPECTIVE, package="pycolmap"),
    "light_field": Declared(0.31, 0.36, 0.59, series="slide"),
}
"""One line a method: `MARGIN` times the worst of the `DEVELOPMENT` seeds, whatever the seed `TESTED` would say."""

VARIANTS: dict[str, tuple[Method, Declared]] = {
    "known_rotation-icp": (KnownRotation(merge="icp"), Declared(0.53, 0.52, 0.83)),
    "known_rotation-refine": (KnownRotation(refine=True), Declared(0.33, 0.32, 0.48)),
    "disparity-boyde": (Disparity("boyde"), Declared(0.56, 0.56, 0.67)),
    "disparity-dense": (Disparity("boyde", "dense"), Declared(0.17, 0.18, 0.26)),
    "disparity_icp-symmetric-dense": (DisparityIcp("symmetric", "dense"), Declared(0.18, 0.19, 0.49)),
}
"""Methods with other options; their names here are only for the reports of tests."""


def contenders() -> Iterator[tuple[str, Method, Declared]]:
    for method in METHODS:
        if method.name in DECLARED:
            yield method.name, method, DECLARED[method.name]
    for name, (method, declared) in VARIANTS.items():
        yield name, method, declared


CONTENDERS = {name: (method, declared) for name, method, declared in contenders()}
EVERY = pytest.mark.parametrize("name", CONTENDERS)


# --- what is photographed ---------------------------------------------------------------------------------------


@lru_cache
def photographed(shape: str, kind: str = "tilted", seed: int = TESTED) -> tuple[TiltSeries, GroundTruth]:
    """Photograph a shape that is a formula, 256 x 192, well exposed; nothing in the pictures can be written.

    The seed is that of the speckle and of the noise.
    """
    made = scene(shape)
    signal = replace(made.signal, backscatter=BackscatterOptions() if kind == "tilted" else None)
    microscope = made.microscope if kind == "tilted" else replace(made.microscope, working_distance_um=NEAR_UM)
    schedule = TILTS if kind == "tilted" else SLIDE
    specimen = replace(made.specimen, contrast=0.25)
    made = replace(
        made,
        specimen=specimen,
        signal=signal,
        microscope=microscope,
        schedule=schedule,
        detector=replace(made.detector, dose_e=2000.0),
        specimen_seed=seed,
    )
    capture = simulate(made, seed=seed)
    return frozen(series_from_capture(capture)), capture.truth


def frozen(series: TiltSeries) -> TiltSeries:
    """Make the same series of arrays that cannot be written."""
    return with_pictures(series, lambda image, _: image.copy())


@lru_cache
def cropped(kind: str) -> TiltSeries:
    """Return the middle of the sphere, 160 x 128: enough for all claims but that of accuracy."""
    return with_pictures(photographed("sphere", kind)[0], lambda image, _: image[32:160, 48:208].copy())


def with_pictures(series: TiltSeries, change: Callable[[Image, int], Image]) -> TiltSeries:
    """Change every picture by its view's number, those of the other detectors too."""

    def read_only(image: Image, number: int) -> Image:
        changed = change(image, number)
        changed.flags.writeable = False
        return changed

    views = []
    for i, view in enumerate(series.views):
        channels = {name: read_only(image, i) for name, image in view.channels.items()}
        views.append(replace(view, image=read_only(view.image, i), channels=MappingProxyType(channels)))
    shape = views[0].image.shape
    optics = replace(series.optics, width_px=shape[1], height_px=shape[0])
    return replace(series, views=tuple(views), optics=optics)


def answer(method: Method, series: TiltSeries, seed: int = 5) -> Estimate:
    return method(series, rng=np.random.default_rng(seed))


@lru_cache
def usual_answer(name: str, shape: str = "") -> Estimate | str:
    """Answer of a contender on a shape, or on the cropped sphere without one; or its sentence."""
    method, declared = CONTENDERS[name]
    try:
        return answer(method, photographed(shape, declared.series)[0] if shape else cropped(declared.series))
    except MethodError as error:
        return str(error)


def assert_same(first: Estimate, second: Estimate) -> None:
    """Claim equal bits in all that is measured."""
    assert (first.heights is None) == (second.heights is None)
    if first.heights is not None and second.heights is not None:
        np.testing.assert_array_equal(first.heights.z_um, second.heights.z_um)
        np.testing.assert_array_equal(first.heights.sigma_um, second.heights.sigma_um)
    if first.points is not None and second.points is not None:
        np.testing.assert_array_equal(first.points.xyz_um, second.points.xyz_um)


# --- the claims, for any method ---------------------------------------------------------------------------------


def is_deterministic_and_leaves_its_input_alone(method: Method, series: TiltSeries) -> None:
    """The same seed gives the same bits, and a series that cannot be written is enough."""
    before = [view.image.copy() for view in series.views]
    first, second = answer(method, series), answer(method, series)
    assert_same(first, second)
    for view, image in zip(series.views, before, strict=True):
        np.testing.assert_array_equal(view.image, image)


def gets_nothing_undeclared(method: Method, series: TiltSeries, usual: Estimate) -> None:
    """Change all that the method does not declare to need: the answer must keep every bit.

    The choice of the reference view and the world's axes are everyone's, so the reference view keeps its tilt.
    """
    needs: tuple[str, ...] = method.needs
    slides = bool(np.ptp(series.tilts_deg) == 0)
    if "rotations" not in needs and not slides:  # the one tilt of a slide does no more than turn the world's axes
        tilts = [0.0 if i == series.reference else 3.0 + 17.0 * i for i in range(len(series))]
        views = tuple(replace(view, tilt_deg=tilt) for view, tilt in zip(series.views, tilts, strict=True))
        series = replace(series, views=views)
    if "tilt_axis" not in needs:
        series = replace(series, tilt_axis_deg=37.0)
    if "channels" not in needs:
        views = tuple(replace(view, channels={}) for view in series.views)
        series = replace(series, views=views, channel_geometry={})
    if "stage_path" not in needs:
        series = replace(series, views=tuple(replace(view, stage_um=None) for view in series.views))
    assert_same(usual, answer(method, series))


def scales_with_the_pixel_size(method: Method, series: TiltSeries, usual: Estimate) -> None:
    """In a world three times as large all heights are three times as large: nothing is secretly in micrometres."""
    optics = series.optics
    larger = replace(
        series,
        optics=replace(
            optics,
            pixel_size_um=3 * optics.pixel_size_um,
            inverse_working_distance=optics.inverse_working_distance / 3,
        ),
        views=tuple(
            replace(v, stage_um=None if v.stage_um is None else (3 * v.stage_um[0], 3 * v.stage_um[1]))
            for v in series.views
        ),
    )
    _, first, _ = complete(usual, series)
    _, second, _ = complete(answer(method, larger), larger)
    known = np.isfinite(first.z_um) & np.isfinite(second.z_um)
    assert known.sum() > 0.95 * np.isfinite(first.z_um).sum()
    gap = np.abs(second.z_um - 3 * first.z_um)[known]
    assert np.median(gap) < 1e-3 * np.ptp(first.z_um[known])


def black(series: TiltSeries) -> TiltSeries:
    return with_pictures(series, lambda image, i: np.zeros_like(image) if i == series.reference else image.copy())


def saturated(series: TiltSeries) -> TiltSeries:
    def white(image: Image, i: int) -> Image:
        top = np.iinfo(image.dtype).max if image.dtype.kind == "u" else image.max()
        return np.full_like(image, top) if i == series.reference else image.copy()

    return with_pictures(series, white)


def missing_row(series: TiltSeries) -> TiltSeries:
    def torn(image: Image, i: int) -> Image:
        image = image.astype(np.float32)
        if i == series.reference:
            image[len(image) // 2] = np.nan
        return image

    return with_pictures(series, torn)


def identical(series: TiltSeries) -> TiltSeries:
    views = list(series.views)
    views[1] = replace(views[1], image=views[0].image, channels=views[0].channels)
    return replace(series, views=tuple(views))


def tiny(series: TiltSeries) -> TiltSeries:
    rows, columns = (np.s_[(size - 64) // 2 : (size + 64) // 2] for size in series.optics.shape)
    return with_pictures(series, lambda image, _: image[rows, columns].copy())


HOSTILE = {one.__name__: one for one in (black, saturated, missing_row, identical, tiny)}


def is_one_sentence(said: str) -> None:
    assert len(said.split()) > 4
    assert "\n" not in said


def survives(method: Method, series: TiltSeries) -> None:
    """Answer something, or say in one sentence why not; what is missing is NaN, and its sigma with it."""
    try:
        estimate = answer(method, series)
    except (MethodError, InputError) as error:
        is_one_sentence(str(error))
        return
    assert estimate.points is not None or estimate.heights is not None
    if estimate.points is not None:
        assert np.isfinite(estimate.points.xyz_um).all()
    if estimate.heights is not None:
        assert estimate.heights.z_um.shape == series.optics.shape
        assert not np.isinf(estimate.heights.z_um).any()
        assert not np.isfinite(estimate.heights.sigma_um[np.isnan(estimate.heights.z_um)]).any()


def depth_errors_um(method: Method, estimate: Estimate, series: TiltSeries, truth: GroundTruth) -> dict[str, float]:
    """Median error of the points and of the height map, by what there is, once the method's gauge is removed."""
    found: dict[str, float] = {}
    reference = series.reference
    if estimate.points is not None:
        xyz = estimate.points.xyz_um
        seen = estimate.points.xy_px
        place = np.where(
            np.isfinite(seen), seen, series.optics.centre_px + xyz[:, :2] * [1, -1] / series.optics.pixel_size_um
        )
        found["points"] = _median(xyz[:, 2], truth.surface_at(reference, place)[:, 2], method, xyz[:, :2])
    _, heights, _ = complete(estimate, series)
    found["heights"] = _median(heights.z_um, truth.height_map(reference), method, None)
    return found


def _median(estimated: Array, true: Array, method: Method, xy_um: Array | None) -> float:
    return float(np.nanmedian(np.abs(gauge_residual(estimated, true, method.gauge, xy_um, "absolute"))))


def contract(method: Method, kind: str = "tilted") -> None:
    """Run every claim that needs no declared accuracy; raises AssertionError with the first that does not hold."""
    series = cropped(kind)
    usual = answer(method, series)
    is_deterministic_and_leaves_its_input_alone(method, series)
    gets_nothing_undeclared(method, series, usual)
    scales_with_the_pixel_size(method, series, usual)
    for spoil in HOSTILE.values():
        survives(method, spoil(series))


# --- and for ours -----------------------------------------------------------------------------------------------


def test_every_method_has_its_line() -> None:
    assert {method.name for method in METHODS} <= set(DECLARED)


def answered(name: str) -> tuple[Method, TiltSeries, Estimate]:
    method, declared = CONTENDERS[name]
    usual = usual_answer(name)
    if isinstance(usual, str):
        assert len(usual.split()) > 4
        assert find_spec(declared.package) is None or isinstance(declared.sphere, str), usual
        pytest.skip(usual)
    return method, cropped(declared.series), usual


@EVERY
def test_the_same_seed_gives_the_same_bits_and_the_input_is_left_alone(name: str) -> None:
    method, series, usual = answered(name)
    before = [view.image.copy() for view in series.views]
    assert_same(usual, answer(method, series))
    for view, image in zip(series.views, before, strict=True):
        np.testing.assert_array_equal(view.image, image)


@EVERY
def test_a_method_gets_nothing_that_it_did_not_declare(name: str) -> None:
    method, series, usual = answered(name)
    gets_nothing_undeclared(method, series, usual)


@EVERY
def test_heights_scale_with_the_pixel_size(name: str) -> None:
    method, series, usual = answered(name)
    scales_with_the_pixel_size(method, series, usual)


@EVERY
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_series_get_an_answer_or_a_sentence(name: str, case: str) -> None:
    method, declared = CONTENDERS[name]
    survives(method, HOSTILE[case](cropped(declared.series)))


@EVERY
@pytest.mark.parametrize("shape", SHAPES)
def test_units_and_frames_are_right_on_a_known_shape(name: str, shape: str) -> None:
    method, declared = CONTENDERS[name]
    tolerance: float | str = getattr(declared, shape)
    usual = usual_answer(name, shape)
    if isinstance(tolerance, str):
        pytest.skip(tolerance)
    if find_spec(declared.package) is None:
        pytest.skip(f"{declared.package} is not installed")
    assert isinstance(usual, Estimate), usual
    series, truth = photographed(shape, declared.series)
    errors = depth_errors_um(method, usual, series, truth)
    assert max(errors.values()) < tolerance, errors


def tolerance_um(name: str, shape: str) -> float:
    """Work out the tolerance of a line by the rule: what to write into `DECLARED` when a method has changed."""
    method, declared = CONTENDERS[name]
    worst = 0.0
    for seed in DEVELOPMENT:
        series, truth = photographed.__wrapped__(shape, declared.series, seed)
        worst = max(worst, *depth_errors_um(method, answer(method, series), series, truth).values())
    unit = 10.0 ** (np.floor(np.log10(MARGIN * worst)) - 1)
    return float(np.ceil(MARGIN * worst / unit) * unit)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disparity-dense", "photometric_stereo"])
def test_tolerances_are_those_of_the_rule(name: str) -> None:
    """For two lines that are quick to work out; a last digit may differ from one machine to another."""
    assert tolerance_um(name, "plane") == pytest.approx(CONTENDERS[name][1].plane, rel=0.1)


@pytest.mark.parametrize("name", ["disparity", "disparity_icp"])
def test_the_printed_formula_halves_a_step(name: str) -> None:
    """Why it has no tolerance: it is not noise, it is a factor of two (beside a slope of half the tilt)."""
    usual = usual_answer(name, "step")
    assert isinstance(usual, Estimate)
    assert usual.points is not None
    x, z = usual.points.xyz_um[:, 0], usual.points.xyz_um[:, 2]
    design = np.column_stack([np.ones(len(x)), x, x > 0])
    kept = np.ones(len(x), dtype=bool)
    for _ in range(5):  # mismatches are left out
        fit = np.linalg.lstsq(design[kept], z[kept], rcond=None)[0]
        away = np.abs(z - design @ fit)
        kept = away <= 3 * np.median(away)
    assert fit[2] == pytest.approx(5.0, abs=1.0)  # the specimen's is 10 um
