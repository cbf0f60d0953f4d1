"""Claims about single wrong sightings: found where the rest can tell, left alone where it cannot."""

from __future__ import annotations

import numpy as np
import pytest

from semrecon.data import Array, Optics, Poses, Tracks
from semrecon.geometry import project, rotations_from_tilts
from semrecon.numerics.robust import fit_noise
from semrecon.points.sightings import without_wrong_sightings
from semrecon.points.triangulation import triangulate

OPTICS = Optics(0.147, 854, 640)
NOISE_PX = 0.3


def planted(views: int, share: float = 0.1, *, points: int = 3000, seed: int = 0) -> tuple[Tracks, Poses, Array, Array]:
    """Tracks of which a share has one sighting off by 5 to 40 px; points, and the wrong view of each track or -1."""
    rng = np.random.default_rng(seed)
    poses = Poses(rotations_from_tilts(np.linspace(0.0, 4.0 * (views - 1), views)), np.zeros((views, 3)))
    xyz = rng.uniform(-1, 1, (points, 3)) * [55.0, 42.0, 20.0]
    xy = np.stack([project(xyz, r, np.zeros(3), OPTICS) for r in poses.rotations], axis=1)
    xy += rng.normal(0, NOISE_PX, xy.shape)
    wrong = np.where(rng.random(points) < share, rng.integers(0, views, points), -1)
    rows = np.flatnonzero(wrong >= 0)
    angle, size = rng.uniform(0, 2 * np.pi, len(rows)), rng.uniform(5, 40, len(rows))
    xy[rows, wrong[rows]] += size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return Tracks(xy), poses, xyz, wrong


@pytest.mark.parametrize(("views", "least"), [(3, 0.5), (4, 0.75), (6, 0.95)])
def test_the_wrong_sighting_goes_and_its_point_stays(views: int, least: float) -> None:
    tracks, poses, xyz, wrong = planted(views)
    kept = without_wrong_sightings(tracks, poses, OPTICS)
    gone, rows = tracks.seen & ~kept.seen, np.flatnonzero(wrong >= 0)
    assert gone[rows, wrong[rows]].mean() > least
    gone[rows, wrong[rows]] = False
    assert gone.sum() < 0.002 * tracks.seen.sum()
    cloud = triangulate(kept, poses, OPTICS, sigma_px=NOISE_PX)
    noise = fit_noise(cloud.residual_px, kept.seen.sum(axis=1))
    back = rows[noise.inliers[rows] & ~kept.seen[rows, wrong[rows]]]
    square = ((cloud.xyz_um - xyz)[back, 2] / cloud.sigma_um[back]) ** 2
    assert np.mean(square) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("views", [3, 4, 6])
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_noise_is_neither_hidden_nor_made(views: int, share: float) -> None:
    tracks, poses, _, _ = planted(views, share, seed=1)
    kept = without_wrong_sightings(tracks, poses, OPTICS)
    noise = fit_noise(triangulate(kept, poses, OPTICS).residual_px, kept.seen.sum(axis=1))
    assert noise.sigma_px == pytest.approx(NOISE_PX, rel=0.02)


def test_more_points_are_kept_than_by_dropping_whole_tracks() -> None:
    tracks, poses, _, wrong = planted(6, 0.3)
    kept = without_wrong_sightings(tracks, poses, OPTICS)
    before, after = (
        fit_noise(triangulate(each, poses, OPTICS).residual_px, each.seen.sum(axis=1)).inliers
        for each in (tracks, kept)
    )
    assert before.mean() < 0.72
    assert after.mean() > 0.97
    assert after[wrong < 0].mean() > 0.99


def test_what_two_views_or_three_along_the_lines_cannot_tell_is_left_alone() -> None:
    tracks, poses, _, _ = planted(3, 0.0)
    xy = tracks.xy_px.copy()
    xy[:300, 1, 0] += 20.0  # along the epipolar lines
    xy[300:600, 2] = np.nan
    xy[300:600, 1, 1] += 20.0
    kept = without_wrong_sightings(Tracks(xy), poses, OPTICS)
    np.testing.assert_array_equal(kept.seen[300:600], np.isfinite(xy[300:600]).all(axis=2))
    assert (Tracks(xy).seen & ~kept.seen)[:300].any(axis=1).mean() < 0.05


def test_good_tracks_and_none_stay_as_they_are() -> None:
    tracks, poses, _, _ = planted(5, 0.0, points=500)
    kept = without_wrong_sightings(tracks, poses, OPTICS)
    assert (tracks.seen & ~kept.seen).mean() < 0.001
    empty = Tracks(np.empty((0, 5, 2)))
    assert len(without_wrong_sightings(empty, poses, OPTICS)) == 0
