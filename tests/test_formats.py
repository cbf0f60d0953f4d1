"""Claims on further formats: what other programs read is what was measured, in the unit and frame that is stated."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semrecon.data import HeightMap, PointCloud, SurfaceMesh
from semrecon.output.sdf import write_sdf
from semrecon.output.stl import write_stl
from semrecon.output.x3p import write_x3p
from semrecon.output.xyz import write_xyz

SDF_FIELDS = ["ManufacID", "CreateDate", "ModDate", "NumPoints", "NumProfiles", "Xscale", "Yscale", "Zscale"]
SDF_FIELDS += ["Zresolution", "Compression", "DataType", "CheckType"]
AREAS = hnp.arrays(
    np.float64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=6), elements=st.floats(-1e4, 1e4) | st.just(np.nan)
)


def sdf_in_metres(path: Path) -> tuple[np.ndarray, float, float]:
    """Read the text form of a surface data file by the fields of ISO 25178-71: heights with y growing, and pitches."""
    records = path.read_bytes().decode("ascii").replace("\r\n", "\n").split("*\n")
    assert len(records) == 4
    assert records[2:] == ["", ""]
    magic, *lines = records[0].splitlines()
    assert magic == "aISO-1.0"
    assert [line.split(" = ")[0] for line in lines] == SDF_FIELDS
    field = dict(line.split(" = ") for line in lines)
    assert len(field["ManufacID"]) <= 10
    assert len(field["CreateDate"]) == len(field["ModDate"]) == 12
    assert (field["Compression"], field["DataType"], field["CheckType"]) == ("0", "7", "0")
    z = np.array([np.nan if word == "BAD" else float(word) for word in records[1].split()])
    z = z.reshape(int(field["NumProfiles"]), int(field["NumPoints"])) * float(field["Zscale"])
    return z, float(field["Xscale"]), float(field["Yscale"])


def x3p_in_metres(path: Path) -> tuple[np.ndarray, float, float]:
    """Read an X3P file by the records of ISO 25178-72, its checksums included."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        document = archive.read("main.xml")
        root = ElementTree.fromstring(document)
        assert root.tag == "{http://www.opengps.eu/2008/ISO5436_2}ISO5436_2"
        stated = archive.read(root.findtext("Record4/ChecksumFile")).decode("ascii").split()[0]
        assert stated == hashlib.md5(document).hexdigest()
        data = archive.read(root.findtext("Record3/DataLink/PointDataLink"))
    assert root.findtext("Record3/DataLink/MD5ChecksumPointData") == hashlib.md5(data).hexdigest()
    assert root.findtext("Record1/FeatureType") == "SUR"
    assert [root.findtext(f"Record1/Axes/{axis}/AxisType") for axis in ("CX", "CY", "CZ")] == ["I", "I", "A"]
    assert root.findtext("Record1/Axes/CZ/DataType") == "D"
    columns, rows, layers = (int(root.findtext(f"Record3/MatrixDimension/Size{axis}")) for axis in "XYZ")
    assert layers == 1
    pitch = [float(root.findtext(f"Record1/Axes/{axis}/Increment")) for axis in ("CX", "CY")]
    return np.frombuffer(data, dtype="<f8").reshape(rows, columns), pitch[0], pitch[1]


READERS = [(write_sdf, sdf_in_metres, 1e-8), (write_x3p, x3p_in_metres, 1e-15)]


@pytest.mark.parametrize(("write", "read", "precision"), READERS, ids=["sdf", "x3p"])
def test_height_maps_come_back_in_metres_with_y_up(tmp_path: Path, write, read, precision) -> None:
    z = np.array([[0.1, np.nan, 2.25], [-3.0, 1e-3, 1234.56789]])
    write(tmp_path / "height", HeightMap(z, np.full_like(z, 0.1), 0.147))
    found, pitch_x, pitch_y = read(tmp_path / "height")
    np.testing.assert_allclose(found[::-1], z * 1e-6, rtol=precision)  # the lowest row of the image is at y = 0
    assert (pitch_x, pitch_y) == pytest.approx((0.147e-6, 0.147e-6))


@pytest.mark.parametrize(("write", "read", "precision"), READERS, ids=["sdf", "x3p"])
@settings(max_examples=40, deadline=None)
@given(z=AREAS)
def test_any_heights_come_back(tmp_path_factory, write, read, precision, z: np.ndarray) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    write(path, HeightMap(z, z, 1.0))
    np.testing.assert_allclose(read(path)[0][::-1], z * 1e-6, rtol=precision, atol=1e-300)


def tetrahedron() -> SurfaceMesh:
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0], [0, 0, 2.5]], dtype=float)
    return SurfaceMesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def test_stl_opens_elsewhere(tmp_path: Path) -> None:
    import open3d as o3d
    import trimesh

    write_stl(tmp_path / "mesh.stl", tetrahedron())
    assert (tmp_path / "mesh.stl").stat().st_size == 84 + 4 * 50
    assert not (tmp_path / "mesh.stl").read_bytes().startswith(b"solid")
    mesh = trimesh.load(tmp_path / "mesh.stl")
    assert mesh.volume == pytest.approx(4 * 3 * 2.5 / 6)  # positive: all faces look outward
    assert mesh.bounds.tolist() == [[0, 0, 0], [4, 3, 2.5]]
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.stl"))
    assert np.asarray(mesh.triangles).shape == (4, 3)
    np.testing.assert_allclose(np.asarray(mesh.get_max_bound()), [4, 3, 2.5])


def test_stl_normals_are_those_of_its_corners_and_0_without_area(tmp_path: Path) -> None:
    vertices, faces = tetrahedron().vertices_um, np.vstack([tetrahedron().faces, [[0, 1, 1]]])
    write_stl(tmp_path / "mesh.stl", SurfaceMesh(vertices, faces))
    content = (tmp_path / "mesh.stl").read_bytes()
    assert int.from_bytes(content[80:84], "little") == 5
    numbers = np.stack([np.frombuffer(content, "<f4", 12, 84 + 50 * i) for i in range(5)])
    np.testing.assert_allclose(numbers[:, 3:].reshape(5, 3, 3), vertices[faces])
    expected = [[0, 0, -1], [0, -1, 0], [-1, 0, 0], np.array([7.5, 10, 12]) / np.linalg.norm([7.5, 10, 12]), [0, 0, 0]]
    np.testing.assert_allclose(numbers[:, :3], expected, atol=1e-6)


def test_xyz_opens_elsewhere(tmp_path: Path) -> None:
    import open3d as o3d

    xyz = np.random.default_rng(0).normal(scale=50, size=(40, 3))
    write_xyz(tmp_path / "points.xyz", PointCloud(xyz, np.zeros((40, 3, 3)), np.zeros(40), np.zeros((40, 2))))
    np.testing.assert_allclose(np.loadtxt(tmp_path / "points.xyz"), xyz, rtol=1e-8)
    np.testing.assert_allclose(np.asarray(o3d.io.read_point_cloud(str(tmp_path / "points.xyz")).points), xyz, rtol=1e-8)
