"""Claims about registration held against poses: none where both agree, the planted motion where they do not."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from known_surface import bump_series

from semrecon.clouds.icp import Registration
from semrecon.data import Array, Optics, PointCloud, Poses
from semrecon.errors import InputError
from semrecon.geometry import project, rotations_from_tilts, tilt_rotation
from semrecon.methods import KnownRotation
from semrecon.methods.pair_clouds import PairCloud
from semrecon.methods.registration_check import compare_with_registration, world_from_cloud
from semrecon.points.triangulation import pair_cloud

OPTICS = Optics(0.2, 400, 300)


def series(points: int = 300) -> tuple[tuple[PairCloud, ...], Poses, Array]:
    """Pair clouds of exact matches at tilts 0, 4, 8 degrees, each with a depth offset of its own."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (points, 3)) * [35, 25, 8]
    rotations = rotations_from_tilts(np.array([0.0, 4.0, 8.0]))
    shifts = np.array([[0.0, 0, 0], [2.0, -1.0, 0], [-3.0, 1.5, 0]])
    xy = [project(xyz, r, t, OPTICS) for r, t in zip(rotations, shifts, strict=True)]
    clouds = []
    for first, offset in ((0, 3.0), (1, -5.0)):
        relative = rotations[first + 1] @ rotations[first].T
        t = shifts[first + 1] - relative @ shifts[first]
        cloud = pair_cloud(xy[first], xy[first + 1], relative, t[:2] - offset * relative[:2, 2], OPTICS)
        clouds.append(PairCloud((first, first + 1), cloud, xy[first + 1]))
    return tuple(clouds), Poses(rotations, shifts), xyz


def test_clouds_come_to_lie_where_the_poses_have_them() -> None:
    clouds, poses, xyz = series()
    for one in clouds:
        np.testing.assert_allclose(world_from_cloud(one, poses, OPTICS).apply(one.cloud.xyz_um), xyz, atol=1e-9)


def by_poses(moving: PointCloud, fixed: PointCloud, turn_deg: float = 0.0) -> Registration:
    """A registration that knows the answer from rows that belong together, and turns it further about the centre."""
    from semrecon.numerics.motion import RigidMotion, fit_motion

    motion = fit_motion(moving.xyz_um, fixed.xyz_um)
    centre = fixed.xyz_um.mean(axis=0)
    turn = tilt_rotation(turn_deg)
    further = RigidMotion(turn, centre - turn @ centre) @ motion
    return Registration(further.rotation, further.translation_um, 0.0, None, None, "rows")


@pytest.mark.parametrize("turn_deg", [0.0, 0.7])
def test_the_difference_is_the_one_that_was_planted(turn_deg: float) -> None:
    clouds, poses, _ = series()
    (found,) = compare_with_registration(clouds, poses, OPTICS, partial(by_poses, turn_deg=turn_deg))
    assert found.rotation_deg == pytest.approx(turn_deg, abs=1e-6)
    assert found.shift_um == pytest.approx(0.0, abs=1e-6)
    assert found.poses_rmse_um == pytest.approx(0.0, abs=1e-6)
    assert (found.registration_rmse_um > 0.01) == (turn_deg > 0)


def test_too_few_points_are_no_comparison() -> None:
    clouds, poses, _ = series(2)
    assert compare_with_registration(clouds, poses, OPTICS) == ()
    assert compare_with_registration((), poses, OPTICS) == ()


def test_known_rotation_reports_the_comparison_and_registers_by_open3d_on_request() -> None:
    images = bump_series((0.0, 6.0, 12.0))
    rng = np.random.default_rng(0)
    (told,) = KnownRotation()(images, rng=rng).diagnostics["registration_check"]
    assert told["views"] == [[0, 1], [1, 2]]
    assert 0 < told["rotation_deg"] < 15
    assert 0 < told["registration_rmse_um"] <= 1.05 * told["poses_rmse_um"]
    ours, theirs = (
        KnownRotation(merge="icp", registration=kind)(images, rng=rng) for kind in ("icp", "open3d_point_to_point")
    )
    assert ours.diagnostics["registration"] != theirs.diagnostics["registration"]
    assert theirs.diagnostics["registration_rmse_um"] == pytest.approx(
        ours.diagnostics["registration_rmse_um"], rel=0.2
    )
    with pytest.raises(InputError, match="registration must be one of"):
        KnownRotation(registration="magic")  # type: ignore[arg-type]
