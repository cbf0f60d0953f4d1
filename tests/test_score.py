"""Claims on judging what others made: truth is right however it lies, nothing else is, and a hole buys nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.judging.judge import TOLERANCES_PX
from benchmarks.judging.submission import Options, Subject, subject_of
from benchmarks.judging.submitted import Scored, score_submission
from benchmarks.scenes import SimulatedSource
from benchmarks.suite import suite
from semrecon.data import Array
from semrecon.errors import InputError
from semrecon.input.series import read_series
from semsim.capture import expose
from semsim.io import write_series
from semsim.microscope import Microscope, TiltSchedule
from semsim.scene import Scene
from semsim.specimens import specimen_from

PIXEL_UM = 0.9
TURN = Rotation.from_euler("zyx", [73, -21, 35], degrees=True).as_matrix()
FAR_UM = np.array([300.0, -20.0, 55.0])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSource:
    """A fracture: rough, without symmetry, wider than the pictures. The reference view is the second."""
    rough = specimen_from({"name": "fracture", "edge_um": 1.0, "frame_width_um": 96.0, "frame_height_um": 72.0})
    scene = Scene("rough", rough, Microscope(PIXEL_UM, 104, 78), TiltSchedule((-6.0, 0.0, 6.0)))
    return SimulatedSource(scene, tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def subject(source: SimulatedSource) -> Subject:
    return subject_of("rough", source.truth(), source.series(0))


def surface_um(subject: Subject) -> Array:
    """Points of the true surface, one a pixel of the reference view, world."""
    buffer = subject.truth.buffers[subject.view]
    return buffer.position_um[~buffer.miss]


def scored(subject: Subject, path: Path, points_um: Array, **options: object) -> Scored:
    """Judge a cloud handed in as a text file."""
    np.savetxt(path / "cloud.xyz", points_um, fmt="%.17g")
    return score_submission(path / "cloud.xyz", subject, Options(**options))  # type: ignore[arg-type]


def test_truth_scores_zero_and_complete_as_a_map_and_as_a_cloud(subject: Subject, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "h.tif", subject.truth.height_map(subject.view).astype(np.float64))
    as_map = score_submission(tmp_path / "h.tif", subject, Options())
    as_cloud = scored(subject, tmp_path, surface_um(subject), align="none")
    for found in (as_map.before, as_map.after, as_cloud.before, as_cloud.after):
        assert found["median_um"] == pytest.approx(0.0, abs=1e-12)
        assert found["rms_um"] == pytest.approx(0.0, abs=1e-12)
        assert found["completeness"] == 1.0
        assert [found[f"fscore_{each:g}px"] for each in TOLERANCES_PX] == [1.0] * 4
    assert "nothing was moved or turned" in as_map.reason
    assert as_cloud.after["own_precision_0.5px"] == 1.0


def test_truth_moved_as_a_rigid_body_comes_back(subject: Subject, tmp_path: Path) -> None:
    found = scored(subject, tmp_path, surface_um(subject) @ TURN.T + FAR_UM)
    assert not found.before["median_um"] < 1.0
    assert found.after["rms_um"] < 1e-4
    assert found.after["completeness"] > 0.98  # rounding may lose the rim
    assert found.motion is not None
    assert found.motion.scale == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(found.motion.linear, TURN.T, atol=1e-6)
    np.testing.assert_allclose(found.motion.shift_um, -TURN.T @ FAR_UM, atol=1e-3)


def test_a_mesh_moved_as_a_rigid_body_comes_back_from_stl(subject: Subject, tmp_path: Path) -> None:
    mesh = subject.truth.mesh
    trimesh.Trimesh(mesh.vertices_um @ TURN.T + FAR_UM, mesh.faces, process=False).export(tmp_path / "m.stl")
    found = score_submission(tmp_path / "m.stl", subject, Options())
    assert found.after["median_um"] < 0.02 * PIXEL_UM  # the truth is interpolated between pixels to find the motion
    assert found.after["completeness"] > 0.99
    assert found.after["own_precision_1px"] > 0.99


@pytest.mark.slow
def test_a_wrong_size_is_seen_unless_size_is_declared_unknown(subject: Subject, tmp_path: Path) -> None:
    grown = 1.15 * surface_um(subject) @ TURN.T
    rigid = scored(subject, tmp_path, grown)
    free = scored(subject, tmp_path, grown, align="similarity")
    assert rigid.after["median_um"] > 0.1 * PIXEL_UM
    assert free.after["median_um"] < 1e-3 * rigid.after["median_um"]
    assert free.motion is not None
    assert free.motion.scale == pytest.approx(1 / 1.15, rel=1e-4)
    assert "its size is not judged" in free.reason


def test_a_unit_is_taken_as_stated_and_a_wrong_one_is_no_surface(subject: Subject, tmp_path: Path) -> None:
    in_nm = 1000 * surface_um(subject)
    assert scored(subject, tmp_path, in_nm, unit_um=1e-3, align="offset").after["rms_um"] < 1e-9
    with pytest.raises(InputError, match="is its unit right"):
        scored(subject, tmp_path, in_nm)


@pytest.mark.slow
def test_a_mirror_image_is_not_right_and_is_named(subject: Subject, tmp_path: Path) -> None:
    mirrored = surface_um(subject) * [-1.0, 1.0, 1.0]
    found = scored(subject, tmp_path, mirrored)
    assert found.after["median_um"] > 0.3 * PIXEL_UM
    assert any("mirror image would fit far better" in note for note in found.notes)
    allowed = scored(subject, tmp_path, mirrored, mirror=True)
    assert allowed.after["rms_um"] < 1e-4
    assert allowed.motion is not None
    assert allowed.motion.mirrored


def test_depths_instead_of_heights_are_named_and_can_be_declared(subject: Subject, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "depth.tif", 50.0 - subject.truth.height_map(subject.view))
    found = score_submission(tmp_path / "depth.tif", subject, Options())
    assert found.after["median_um"] > PIXEL_UM
    assert "may be depths" in found.notes[0]
    told = score_submission(tmp_path / "depth.tif", subject, Options(frame="camera"))
    assert told.after["rms_um"] < 1e-9
    assert told.removed == ("offset of -50 um",)
    assert not told.notes


@pytest.mark.slow
def test_a_cloud_of_a_camera_is_turned_over_and_that_is_said(subject: Subject, tmp_path: Path) -> None:
    camera = surface_um(subject) * [1.0, -1.0, -1.0]
    found = scored(subject, tmp_path, camera)
    assert found.after["rms_um"] < 1e-4
    assert any("turned over" in note for note in found.notes)
    assert not scored(subject, tmp_path, camera, frame="camera").notes


def test_only_the_declared_gauge_is_removed_from_a_map(subject: Subject, tmp_path: Path) -> None:
    true = subject.truth.height_map(subject.view)
    columns = np.arange(true.shape[1]) * PIXEL_UM
    tifffile.imwrite(tmp_path / "h.tif", 2.0 * true + 0.1 * columns + 7)
    plain = score_submission(tmp_path / "h.tif", subject, Options())
    free = score_submission(tmp_path / "h.tif", subject, Options(gauge=("offset", "plane", "scale")))
    assert plain.after["median_um"] > 1.0
    assert free.after["median_um"] < 1e-6
    assert free.removed[-1] == "heights multiplied by 0.5"


def test_a_missing_height_never_improves_a_score(subject: Subject, tmp_path: Path) -> None:
    true = subject.truth.height_map(subject.view)
    noisy = true + np.random.default_rng(1).normal(0, 0.5, true.shape)
    tifffile.imwrite(tmp_path / "whole.tif", noisy)
    whole = score_submission(tmp_path / "whole.tif", subject, Options()).after
    bad = np.abs(noisy - true) > 0.5
    for stands_for_none in (np.nan, -9999.0):
        tifffile.imwrite(tmp_path / "holes.tif", np.where(bad, stands_for_none, noisy))
        found = score_submission(tmp_path / "holes.tif", subject, Options(missing=-9999.0)).after
        assert found["completeness"] == pytest.approx(1 - bad[subject.judged].mean())
        assert found["penalised_median_um"] >= whole["penalised_median_um"] - 0.02  # the offset moves by chance
        assert found["recall_0.5px"] <= whole["recall_0.5px"]
    cloud = surface_um(subject)
    cloud[::3] = np.nan
    thinned = scored(subject, tmp_path, cloud, align="offset").after
    assert thinned["points"] == len(cloud) - len(cloud[::3])


def test_part_of_the_surface_is_judged_as_part(subject: Subject, tmp_path: Path) -> None:
    points = surface_um(subject)
    half = scored(subject, tmp_path, points[points[:, 0] > 0], frame="world", align="offset").after
    assert half["rms_um"] < 1e-9
    assert half["completeness"] == pytest.approx(0.5, abs=0.03)
    assert half["recall_0.5px"] < 0.6
    assert half["precision_0.5px"] == 1.0


def run(*arguments: object) -> tuple[int, str]:
    """Exit status and output of a command of the bench."""
    done = CliRunner().invoke(app, [str(each) for each in arguments], env={"COLUMNS": "200"})
    return done.exit_code, done.output


def test_the_command_judges_against_a_folder_with_truth(
    source: SimulatedSource, subject: Subject, tmp_path: Path
) -> None:
    write_series(expose(source.surfaces(), 1), tmp_path / "series", 1)
    tifffile.imwrite(tmp_path / "h.tif", subject.truth.height_map(subject.view) + 3)
    status, said = run("score", tmp_path / "h.tif", "--scene", tmp_path / "series", "--out", tmp_path / "out")
    assert status == 0, said
    assert "Removed: offset of 3 um." in said
    assert "the reference view is view_01.tif, at 0 degrees" in said
    content = json.loads((tmp_path / "out" / "score.json").read_text())
    assert content["aligned"]["completeness"] == 1.0
    assert np.nanmax(np.abs(tifffile.imread(tmp_path / "out" / "error.tif"))) < 1e-5
    assert "| completeness | 1 | 1 |" in (tmp_path / "out" / "score.md").read_text()


def test_the_pictures_of_a_scene_are_those_of_the_bench_and_hold_no_truth(
    source: SimulatedSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    from benchmarks import suite as module

    small = replace(suite(tmp_path)[0], name="rough", source=source)
    monkeypatch.setattr(module, "suite", lambda *_, **__: (small,))
    status, said = run("scene", "rough", "--out", tmp_path / "series", "--repetition", 2)
    assert status == 0, said
    names = {path.name for path in (tmp_path / "series").iterdir()}
    assert names == {"series.toml", *(f"view_0{i}.tif" for i in range(3))}
    for ours, theirs in zip(read_series(tmp_path / "series").views, small.series(2).views, strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)
        assert not np.array_equal(ours.image, small.series(0).views[0].image)
    status, said = run("scene", "rough", "--out", tmp_path / "series")
    assert (status, "holds something else" in said) == (2, True)
    status, said = run("scene", "rough", "--out", tmp_path / "with", "--truth", "--repetition", 2)
    assert status == 0, said
    np.testing.assert_array_equal(read_series(tmp_path / "with").views[0].image, small.series(2).views[0].image)
    assert (tmp_path / "with" / "truth" / "mesh.ply").is_file()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nothing.ply",), "nothing.ply does not exist"),
        (("h.doc",), "is no surface that is read here"),
        (("h.tif", "--align", "luck"), "--align knows none, offset"),
        (("h.tif", "--gauge", "luck"), "--gauge knows offset"),
        (("h.tif", "--frame", "mine"), "--frame knows world"),
        (("h.tif", "--unit-um", "0"), "--unit-um must be a positive number"),
        (("h.tif", "--gauge", "offset", "--align", "rigid"), "give one of them"),
        (("h.tif", "--align", "offset", "--mirror"), "--mirror goes with"),
        (("h.tif",), "states no pixel size"),
        (("cut.stl",), "cut.stl"),
    ],
)
def test_what_cannot_be_judged_is_one_sentence(
    subject: Subject,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: tuple[str, ...],
    sentence: str,
) -> None:
    from benchmarks.commands import score as module

    monkeypatch.setattr(module, "_subject", lambda *_, **__: subject)
    (tmp_path / "h.doc").write_text("x")
    (tmp_path / "cut.stl").write_bytes(b"solid nothing")
    tifffile.imwrite(tmp_path / "h.tif", np.zeros((5, 5), dtype=np.float32))
    status, said = run("score", tmp_path / arguments[0], *arguments[1:], "--scene", "rough")
    assert status == 2, said
    assert sentence in said
    assert said.startswith("Error: ")
    assert said.count("\n") == 1
