"""Speed of the kernels beside what one would use instead. Ratios within one run mean something; times do not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from semrecon.data import PointCloud
from semrecon.geometry import tilt_rotation
from semrecon.icp import icp
from semrecon.open3d_icp import icp_open3d
from semrecon.translation import solve_closed_form, solve_generalised_inverse
from semsim.mesh import Mesh
from semsim.microscope import Microscope, TiltSchedule, poses
from semsim.surface import Backend, surface_buffer

STEP = tilt_rotation(3.0)


def exact_matches(n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    xyz = np.random.default_rng(0).uniform(-60, 60, (n, 3))
    return xyz[:, :2], (xyz @ STEP.T)[:, :2]


@pytest.mark.benchmark(group="translation of 400 matches, Eqs. 4 and 5")
@pytest.mark.parametrize(
    "solve", [solve_generalised_inverse, solve_closed_form], ids=["generalised inverse", "closed form"]
)
def test_translation(benchmark: BenchmarkFixture, solve: Callable[..., Any]) -> None:
    solved = benchmark.pedantic(solve, args=(*exact_matches(400), STEP), rounds=3)  # type: ignore[no-untyped-call]
    assert solved.rank == 401


@pytest.mark.benchmark(group="translation of a million matches")
def test_translation_of_a_million(benchmark: BenchmarkFixture) -> None:
    solved = benchmark.pedantic(solve_closed_form, args=(*exact_matches(1_000_000), STEP), rounds=3)  # type: ignore[no-untyped-call]
    assert solved.rank == 1_000_001


@pytest.mark.benchmark(group="point-to-point ICP of 5000 points, 3 degrees")
@pytest.mark.parametrize("register", [icp, icp_open3d], ids=["ours", "Open3D"])
def test_icp(benchmark: BenchmarkFixture, register: Callable[..., Any]) -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-50, 50, (5000, 2))
    z = 20 * np.cos(xy[:, 0] / 30) * np.cos(xy[:, 1] / 25) + 0.3 * rng.standard_normal(5000)
    fixed = np.column_stack([xy, z])
    clouds = [PointCloud(each, np.zeros((5000, 3, 3)), z, xy) for each in (fixed @ STEP.T, fixed)]
    found = benchmark.pedantic(register, args=clouds, rounds=2)  # type: ignore[no-untyped-call]
    assert np.linalg.norm(found.rotation - STEP.T) < 0.1


@pytest.mark.benchmark(group="surface buffer of 320 k faces at 854 x 640")
@pytest.mark.parametrize("backend", ["raycast", "pyrender"])
def test_surface_buffer(benchmark: BenchmarkFixture, backend: Backend) -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=7, radius=45.0)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    pose = poses(TiltSchedule((3.0,)))[0]
    microscope = Microscope(5 / 34, 854, 640)
    buffer = benchmark.pedantic(surface_buffer, args=(mesh, microscope, pose, backend), rounds=2)  # type: ignore[no-untyped-call]
    assert 0.5 < 1 - buffer.miss.mean() < 0.6
