"""Speed of the kernels beside what one would use instead. Ratios within one run mean something; times do not."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from semrecon.adjustment.refinement import refine
from semrecon.clouds.icp import icp
from semrecon.clouds.open3d_icp import icp_open3d
from semrecon.data import Optics, PointCloud, Tracks
from semrecon.geometry import project, rotations_from_tilts, tilt_rotation
from semrecon.judging.metrics import relative_rotation_error_deg
from semrecon.points.translation import PairTranslation, solve_closed_form, solve_generalised_inverse
from semsim.capture import simulate
from semsim.charging import ChargingOptions
from semsim.detector import DetectorOptions
from semsim.imperfections import StageErrors, ViewErrors
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, camera_from_world, pixel_grid, pixel_rays, poses
from semsim.raster import draw
from semsim.raycast import search_tree, tensor
from semsim.scan import ScanOptions
from semsim.scene import Scene
from semsim.spot import SpotOptions
from semsim.surface import Backend, surface_buffer
from semsim.zbuffer import rasterise

STEP = tilt_rotation(3.0)


def exact_matches(n: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Matches in both views, and the depths to be found."""
    xyz = np.random.default_rng(0).uniform(-60, 60, (n, 3))
    return xyz[:, :2], (xyz @ STEP.T)[:, :2], xyz[:, 2]


def largest_depth_error_um(solved: PairTranslation, depth_um: NDArray[Any]) -> float:
    """Largest error of the depths beside their common offset."""
    error = solved.depth_um - depth_um
    return float(np.abs(error - np.median(error)).max())


@pytest.mark.benchmark(group="translation of 400 matches, Eqs. 4 and 5")
@pytest.mark.parametrize(
    "solve", [solve_generalised_inverse, solve_closed_form], ids=["generalised inverse", "closed form"]
)
def test_translation(benchmark: BenchmarkFixture, solve: Callable[..., Any]) -> None:
    first, second, depth = exact_matches(400)
    solved = benchmark.pedantic(solve, args=(first, second, STEP), rounds=3)  # type: ignore[no-untyped-call]
    benchmark.extra_info["largest_depth_error_um"] = largest_depth_error_um(solved, depth)
    assert benchmark.extra_info["largest_depth_error_um"] < 1e-8


@pytest.mark.benchmark(group="translation of a million matches")
def test_translation_of_a_million(benchmark: BenchmarkFixture) -> None:
    first, second, depth = exact_matches(1_000_000)
    solved = benchmark.pedantic(solve_closed_form, args=(first, second, STEP), rounds=3)  # type: ignore[no-untyped-call]
    benchmark.extra_info["largest_depth_error_um"] = largest_depth_error_um(solved, depth)
    assert benchmark.extra_info["largest_depth_error_um"] < 1e-8


@pytest.mark.benchmark(group="point-to-point ICP of 5000 points, 3 degrees")
@pytest.mark.parametrize("register", [icp, icp_open3d], ids=["ours", "Open3D"])
def test_icp(benchmark: BenchmarkFixture, register: Callable[..., Any]) -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-50, 50, (5000, 2))
    z = 20 * np.cos(xy[:, 0] / 30) * np.cos(xy[:, 1] / 25) + 0.3 * rng.standard_normal(5000)
    fixed = np.column_stack([xy, z])
    clouds = [PointCloud(each, np.zeros((5000, 3, 3)), z, xy) for each in (fixed @ STEP.T, fixed)]
    found = benchmark.pedantic(register, args=clouds, rounds=2)  # type: ignore[no-untyped-call]
    benchmark.extra_info |= {"rre_deg": relative_rotation_error_deg(STEP.T, found.rotation), "rmse_um": found.rmse_um}
    assert np.linalg.norm(found.rotation - STEP.T) < 0.1


def tilted_tracks(points: int, views: int) -> tuple[Tracks, NDArray[Any], Optics, NDArray[Any]]:
    """Sightings at 0.3 px of a relief under tilts from -30 to 30 degrees that the stage states to 0.1 degree.

    Returns
    -------
    What `refine` takes, and the true tilts.
    """
    rng, optics, stated = np.random.default_rng(0), Optics(0.147, 854, 640), np.linspace(-30.0, 30.0, views)
    xyz = rng.uniform(-1, 1, (points, 3)) * [55.0, 42.0, 20.0]
    xy = np.empty((points, views, 2))
    true = stated + rng.normal(0, 0.1, views)
    for view, rotation in enumerate(rotations_from_tilts(true)):
        xy[:, view] = project(xyz, rotation, np.append(rng.uniform(-5, 5, 2), 0.0), optics)
    return Tracks(xy + rng.normal(0, 0.3, xy.shape)), stated, optics, true


@pytest.mark.benchmark(group="bundle adjustment: points, tilts, axis, magnifications, rotations and shifts of 40 views")
@pytest.mark.parametrize("points", [4_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_bundle_adjustment(benchmark: BenchmarkFixture, points: int) -> None:
    """`-m slow` takes the size that matters; the highest that the process ever took stands beside it."""
    *arguments, true = tilted_tracks(points, 40)
    refined = benchmark.pedantic(refine, args=arguments, rounds=1)  # type: ignore[no-untyped-call]
    benchmark.extra_info["peak_gib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3)
    steps = np.diff(refined.tilts_deg) - np.diff(true)
    benchmark.extra_info |= {"sigma_px": refined.sigma_px, "tilt_step_rms_deg": float(np.sqrt(np.mean(steps**2)))}
    assert refined.converged
    assert abs(refined.sigma_px - 0.3) < 0.01


SHARP = Microscope(5 / 102, 2560, 1920)
USUAL = Microscope(5 / 34, 854, 640)
TILTED = poses(TiltSchedule((3.0,)))[0]


@dataclass(frozen=True, eq=False)
class Ready:
    """A specimen that is there already, so that its making is not timed."""

    name: ClassVar[str] = "ready"
    mesh: Mesh

    def __call__(self, rng: np.random.Generator) -> Mesh:  # noqa: ARG002 - nothing is left to chance
        return self.mesh


@pytest.fixture(scope="module")
def ball() -> Mesh:
    """327 680 faces that fill half the frame, normals and search tree at hand."""
    import trimesh

    shape = trimesh.creation.icosphere(subdivisions=7, radius=45.0)
    mesh = Mesh(np.asarray(shape.vertices), np.asarray(shape.faces, dtype=np.int32))
    for backend in ("zbuffer", "raycast"):
        surface_buffer(mesh, Microscope(5.0, 32, 24), TILTED, backend)
    return mesh


def half_is_hit(miss: NDArray[Any]) -> bool:
    """The disc of the ball, pi 45^2 um^2, and the rest of the frame."""
    frame = SHARP.width_px * SHARP.height_px * SHARP.pixel_size_um**2
    return bool(abs((1 - miss.mean()) - np.pi * 45.0**2 / frame) < 1e-3)


def ball_error_um(depth: NDArray[Any]) -> float:
    """Root mean square error of depths of the ball but for its rim, beside their common offset."""
    x, y = np.moveaxis((pixel_grid(SHARP) - SHARP.centre_px) * SHARP.pixel_size_um, -1, 0)
    square = 45.0**2 - x**2 - y**2
    error = (depth + np.sqrt(np.maximum(square, 0.0)))[square > 20.0**2]
    return float(np.std(error - np.median(error)))


@pytest.mark.benchmark(group="surface buffer of 328 k faces at 2560 x 1920: depth, triangle, position and normal")
@pytest.mark.parametrize("backend", ["zbuffer", "raycast", "pyrender"])
def test_surface_buffer(benchmark: BenchmarkFixture, ball: Mesh, backend: Backend) -> None:
    buffer = benchmark.pedantic(surface_buffer, args=(ball, SHARP, TILTED, backend), rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    benchmark.extra_info["depth_rms_um"] = ball_error_um(buffer.depth_um)
    assert half_is_hit(buffer.miss)


@pytest.mark.benchmark(group="first surface of 328 k faces at 2560 x 1920: the search alone")
@pytest.mark.parametrize("peer", ["zbuffer", "Open3D", "pyrender"])
def test_search_for_the_first_surface(benchmark: BenchmarkFixture, ball: Mesh, peer: str) -> None:
    """What each peer takes by itself, its input made ready: depth and triangle; pyrender has depth only."""
    search = {"zbuffer": drawn_by_us, "Open3D": cast_by_open3d, "pyrender": drawn_by_pyrender}[peer](ball)
    depth = benchmark.pedantic(search, rounds=5, warmup_rounds=1)  # type: ignore[no-untyped-call]
    benchmark.extra_info["depth_rms_um"] = ball_error_um(depth)
    assert half_is_hit(~np.isfinite(depth))


def drawn_by_us(mesh: Mesh) -> Callable[[], NDArray[Any]]:
    return lambda: rasterise(mesh, SHARP, TILTED)[0]


def cast_by_open3d(mesh: Mesh) -> Callable[[], NDArray[Any]]:
    origins, directions = pixel_rays(SHARP, TILTED, pixel_grid(SHARP))
    rays = tensor(np.concatenate([origins - 100.0 * directions, directions], axis=-1), np.float32)
    cast = search_tree(mesh).cast_rays
    return lambda: np.asarray(cast(rays)["t_hit"].numpy())


def drawn_by_pyrender(mesh: Mesh) -> Callable[[], NDArray[Any]]:
    camera = camera_from_world(TILTED, mesh.vertices_um) + [0.0, 0.0, 150.0]
    return lambda: draw(mesh, SHARP, camera, near=50.0, far=250.0)


def everything_on(mesh: Mesh, microscope: Microscope) -> Scene:
    """One view with every effect switched on, save perspective and a second detector."""
    return Scene(
        "everything",
        Ready(mesh),
        microscope,
        TiltSchedule((3.0,)),
        spot=SpotOptions(sigma_px=0.8, astigmatism=0.2, astigmatism_angle_deg=30.0, convergence_mrad=5.0),
        charging=ChargingOptions(strength=0.3),
        detector=DetectorOptions(read_noise_e=2.0, frames=2),
        stage_errors=StageErrors(tilt_sigma_deg=0.1, shift_sigma_um=0.5),
        view_errors=ViewErrors(magnification_sigma=1e-3, rotation_sigma_deg=0.2, skew_sigma=1e-3),
        scan=ScanOptions(
            drift_px=(1.0, 2.0), wander_px=0.5, vibration_px=(0.2, 0.1), line_jitter_px=0.1, flyback_px=0.5
        ),
    )


def on_the_grid(mesh: Mesh, microscope: Microscope) -> Scene:
    """The same with a steady beam."""
    return replace(everything_on(mesh, microscope), scan=ScanOptions())


@pytest.mark.benchmark(group="micrograph of 328 k faces at 854 x 640, all effects on")
@pytest.mark.parametrize("scene", [on_the_grid, everything_on], ids=["steady beam", "scan errors"])
def test_micrograph(benchmark: BenchmarkFixture, ball: Mesh, scene: Callable[..., Scene]) -> None:
    captured = benchmark.pedantic(simulate, args=(scene(ball, USUAL), 0), rounds=3, warmup_rounds=1)  # type: ignore[no-untyped-call]
    benchmark.extra_info["grey_levels"] = int(np.ptp(captured.images[0]))
    assert benchmark.extra_info["grey_levels"] > 100


MEASURED_ALONE = """
import re, sys
from pathlib import Path
import numpy as np
from benchmarks.test_speed import SHARP, Mesh, everything_on, simulate
stored = np.load(sys.argv[1])
mesh = Mesh(stored["vertices"], stored["faces"])
peak = lambda: re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]
before = peak()
simulate(everything_on(mesh, SHARP), 0)
print(before, peak())
"""


@pytest.mark.benchmark(group="memory of a micrograph at 2560 x 1920")
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs the peak that Linux keeps for each process")
def test_memory(benchmark: BenchmarkFixture, ball: Mesh, tmp_path: Path) -> None:
    """Peak of a process of its own; beside it what Python, the libraries and the mesh had taken before.

    The kernel's own figure: that of `getrusage` is handed down from the process that started this one.
    """
    np.savez(tmp_path / "ball.npz", vertices=ball.vertices_um, faces=ball.faces)
    command = [sys.executable, "-c", MEASURED_ALONE, str(tmp_path / "ball.npz")]
    done = benchmark.pedantic(subprocess.run, args=(command,), kwargs={"capture_output": True, "check": True})  # type: ignore[no-untyped-call]
    before, peak = (int(kib) / 2**20 for kib in done.stdout.split())
    benchmark.extra_info |= {"before_gib": round(before, 3), "peak_gib": round(peak, 3)}
    assert peak < 2.0
