"""Claims on files: grey values survive every container, damage is named, folders are whole or absent."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
from known_surface import KnowsTheBump, bump_series
from PIL import Image

from semrecon.data import TiltSeries, View
from semrecon.errors import InputError
from semrecon.input.images import read_image
from semrecon.input.intake import Stated, take_in
from semrecon.input.metadata import read_metadata, zeiss
from semrecon.input.series import read_series, write_series
from semrecon.output.export import FILES, write_map, write_reconstruction
from semrecon.pipeline import reconstruct
from semrecon.reconstruction import jsonable

GREY8 = np.random.default_rng(1).integers(0, 256, (40, 50), dtype=np.uint8)
GREY16 = np.random.default_rng(2).integers(0, 65536, (40, 50), dtype=np.uint16)
ZEISS = {
    "ap_image_pixel_size": ("Image Pixel Size", 55.82, "nm"),
    "ap_pixel_size": ("Pixel Size", 111.6, "nm"),
    "ap_stage_at_t": ("Stage at T", -9.0, "°"),
    "ap_tilt_angle": ("Tilt Angle", 30.0, "°"),
    "ap_wd": ("WD", 6.2, "mm"),
    "dp_stage_tilted": ("Stage Tilt", "in X"),
    "dp_image_store": ("Store resolution", "2048 * 1536"),
    "dp_scan_rot": ("Scan Rot", False),
    "dp_tilt_correction": ("Tilt Corrn.", False),
}

real_data = pytest.mark.skipif("SEM_REAL_DATA" not in os.environ, reason="SEM_REAL_DATA names no folder of real images")


# --- images -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grey", [GREY8, GREY16], ids=["8 bit", "16 bit"])
@pytest.mark.parametrize("name", ["a.tif", "a.png"])
def test_grey_values_survive(tmp_path: Path, name: str, grey: np.ndarray) -> None:
    path = tmp_path / name
    tifffile.imwrite(path, grey) if path.suffix == ".tif" else Image.fromarray(grey).save(path)
    image = read_image(path)
    assert image.dtype == grey.dtype
    np.testing.assert_array_equal(image, grey)
    assert not image.flags.writeable


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_both_byte_orders_come_out_native(tmp_path: Path, byteorder: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY16, byteorder=byteorder)
    image = read_image(tmp_path / "a.tif")
    assert image.dtype.isnative
    np.testing.assert_array_equal(image, GREY16)


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate"])
@pytest.mark.parametrize("grey", [GREY8, GREY16], ids=["8 bit", "16 bit"])
def test_compressed_tiffs_are_exact(tmp_path: Path, compression: str, grey: np.ndarray) -> None:
    Image.fromarray(grey).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), grey)


@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_a_grey_palette_is_undone_exactly(tmp_path: Path, compression: str | None) -> None:
    indexed = Image.fromarray(255 - GREY8).convert("P")
    indexed.putpalette([255 - i // 3 for i in range(768)])  # a reversed ramp: indices are not the grey values
    indexed.save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GREY8)


@pytest.mark.parametrize("channels", [3, 4])
def test_grey_in_colour_channels_is_grey(tmp_path: Path, channels: int) -> None:
    stacked = np.repeat(GREY8[..., None], channels, axis=2)
    stacked[..., 3:] = 255
    Image.fromarray(stacked).save(tmp_path / "a.png")
    tifffile.imwrite(tmp_path / "a.tif", stacked, photometric="rgb")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), GREY8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GREY8)


def test_white_is_bright_whichever_way_the_file_counts(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", 255 - GREY8, photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GREY8)


def test_jpeg_is_near(tmp_path: Path) -> None:
    smooth = np.tile(np.linspace(0, 255, 50).astype(np.uint8), (40, 1))
    Image.fromarray(smooth).convert("RGB").save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - smooth).max() <= 4


def test_colour_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.stack([GREY8, GREY8, GREY8.T.reshape(40, 50)], axis=2)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png is in colour"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("keep", [0.02, 0.5, 0.97])
@pytest.mark.parametrize("kind", ["plain", "lzw", "png", "jpg", "pillow"])
def test_a_cut_file_is_named_and_never_half_read(
    tmp_path: Path, kind: str, keep: float, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / {"png": "a.png", "jpg": "a.jpg"}.get(kind, "a.tif")
    if kind == "plain":
        tifffile.imwrite(path, GREY8)
    else:
        Image.fromarray(GREY8).save(path, **({"compression": "tiff_lzw"} if kind == "lzw" else {}))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(InputError, match=r"a\.(tif|png|jpg)"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


def test_several_images_in_a_file_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.stack([GREY8, GREY8]), photometric="minisblack")
    with pytest.raises(InputError, match="holds 2 images"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("dtype", [np.int16, np.float64])
def test_other_kinds_of_numbers_are_refused(tmp_path: Path, dtype: type) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY8.astype(dtype))
    with pytest.raises(InputError, match="8 or 16 bits"):
        read_image(tmp_path / "a.tif")


# --- vendor metadata --------------------------------------------------------------------------------------------------


def test_zeiss_takes_the_stored_pixels_and_the_stage() -> None:
    data = zeiss(ZEISS, (2048, 1536), "a.tif")
    assert data.pixel_size_um == pytest.approx(0.05582)
    assert (data.tilt_deg, data.tilt_axis_deg, data.working_distance_um) == (-9.0, 90.0, 6200.0)
    assert data.warnings == ()


def test_zeiss_axis_of_an_image_turned_after_the_scan() -> None:
    assert zeiss(ZEISS, (1536, 2048), "a.tif").tilt_axis_deg == 0.0


def test_zeiss_axis_is_unknown_under_scan_rotation() -> None:
    turned = {**ZEISS, "dp_scan_rot": ("Scan Rot", True), "ap_scanrotation": ("Scan Rotation", 31.0, "°")}
    assert zeiss(turned, (2048, 1536), "a.tif").tilt_axis_deg is None
    full = {**turned, "ap_scanrotation": ("Scan Rotation", 360.0, "°")}
    assert zeiss(full, (2048, 1536), "a.tif").tilt_axis_deg == 90.0


@pytest.mark.parametrize("unit", ["µm", "μm"])
def test_zeiss_units(unit: str) -> None:
    tags = {**ZEISS, "ap_image_pixel_size": ("Image Pixel Size", 1.5, unit)}
    assert zeiss(tags, (2048, 1536), "a.tif").pixel_size_um == pytest.approx(1.5)


def test_zeiss_warns_of_tilt_correction() -> None:
    tags = {**ZEISS, "dp_tilt_correction": ("Tilt Corrn.", True)}
    assert "tilt correction" in zeiss(tags, (2048, 1536), "a.tif").warnings[0]


def test_files_without_metadata_say_nothing(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY8)
    Image.fromarray(GREY8).save(tmp_path / "a.png")
    for path in (tmp_path / "a.tif", tmp_path / "a.png", tmp_path / "missing.tif"):
        data = read_metadata(path)
        assert (data.pixel_size_um, data.tilt_deg, data.source) == (None, None, "")


@real_data
def test_real_potamogeton_metadata() -> None:
    folder = Path(os.environ["SEM_REAL_DATA"]) / "potamogeton"
    data = [read_metadata(path) for path in sorted(folder.glob("*.tif"))]
    assert [one.tilt_deg for one in data] == [-9, -6, -3, 0, 3, 6, 9]
    assert {one.pixel_size_um for one in data} == {0.05582}
    assert {one.tilt_axis_deg for one in data} == {0.0}


@real_data
@pytest.mark.parametrize("name", ["potamogeton/pot_00.tif", "brassica/Brassica01.jpg", "bse/P33_scale1_detectorA.tif"])
def test_real_images_agree_with_pillow(name: str) -> None:
    path = Path(os.environ["SEM_REAL_DATA"]) / name
    with Image.open(path) as picture:
        expected = np.asarray(picture if picture.mode.startswith("I") else picture.convert("RGB"))
    image = read_image(path)
    np.testing.assert_array_equal(image, expected if expected.ndim == 2 else expected[..., 0])


# --- series folder ----------------------------------------------------------------------------------------------------


def same_series(a: TiltSeries, b: TiltSeries) -> None:
    assert a.optics == b.optics
    assert a.tilt_axis_deg == b.tilt_axis_deg
    np.testing.assert_array_equal(a.tilts_deg, b.tilts_deg)
    for one, other in zip(a.views, b.views, strict=True):
        assert one.image.dtype == other.image.dtype
        np.testing.assert_array_equal(one.image, other.image)
        assert one.channels.keys() == other.channels.keys()
        for name in one.channels:
            np.testing.assert_array_equal(one.channels[name], other.channels[name])


def test_a_series_folder_comes_back_to_the_bit(tmp_path: Path) -> None:
    series = bump_series((0.0, 6.1))
    with_channels = View(series.views[0].image, 3.3, channels={"left": GREY8.repeat(3, 0).repeat(4, 1)[:120, :160]})
    optics = type(series.optics)(0.1, 160, 120, 1 / 8192.0)
    series = TiltSeries((*series.views, with_channels), optics, tilt_axis_deg=12.5)
    write_series(series, tmp_path / "s")
    same_series(read_series(tmp_path / "s"), series)


def test_truth_is_never_read(tmp_path: Path) -> None:
    write_series(bump_series(), tmp_path / "s")
    before = read_series(tmp_path / "s")
    (tmp_path / "s" / "truth").mkdir()
    for name in ("truth.npz", "mesh.ply", "settings.toml"):
        (tmp_path / "s" / "truth" / name).write_bytes(b"garbage")
    same_series(read_series(tmp_path / "s"), before)


def test_plain_images_make_the_same_series(tmp_path: Path) -> None:
    series = bump_series()
    write_series(series, tmp_path / "s")
    paths = sorted((tmp_path / "s").glob("*.tif"))
    same_series(take_in(paths, Stated((0.0, 6.0, 12.0), pixel_size_um=0.1)).series, series)


@pytest.mark.parametrize(
    ("toml", "sentence"),
    [
        ("pixel_size = 0.1\nview = []", r"series\.toml: unknown key pixel_size; allowed are pixel_size_um, view"),
        ('pixel_size_um = "0.1"\nview = []', "pixel_size_um must be a number"),
        ("view = []", "missing: pixel_size_um"),
        ("pixel_size_um = 0.1", "missing: view"),
        ("pixel_size_um = 0.1\nview = []", "names no"),
        ("pixel_size_um = 0.1\nview = 3", "view is not of the right kind"),
        ("pixel_size_um = 0.0\n[[view]]\nimage='a.tif'\ntilt_deg=0", "pixel_size_um must be a positive number"),
        ("pixel_size_um = 0.1\n[[view]]\nimage='a.tif'", "missing: view 1 tilt_deg"),
        (
            "pixel_size_um = 0.1\n[[view]]\nimage='a.tif'\ntilt=3.0",
            "unknown key tilt in view 1; allowed are image, tilt_deg",
        ),
        ("pixel_size_um = 0.1\n[[view]]\nimage=3\ntilt_deg=3.0", "view 1 image must be text"),
        ("working_distance_um = -1\npixel_size_um = 0.1\n[[view]]\nimage='a.tif'\ntilt_deg=0", "working_distance_um"),
        ("pixel_size_um = ", "not valid TOML"),
    ],
)
def test_series_toml_is_strict(tmp_path: Path, toml: str, sentence: str) -> None:
    (tmp_path / "series.toml").write_text(toml)
    with pytest.raises(InputError, match=sentence):
        read_series(tmp_path)


# --- reconstruction folder --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "out"
    write_reconstruction(reconstruct(bump_series(), KnowsTheBump()), out)
    return out


def test_the_folder_holds_what_it_should(written: Path) -> None:
    assert {path.name for path in written.iterdir()} == set(FILES)
    assert {path.name for path in written.parent.iterdir()} == {"out"}


def test_maps_are_float32_with_a_scale(written: Path) -> None:
    with tifffile.TiffFile(written / "height.tif") as tiff:
        assert tiff.pages[0].dtype == np.float32
        assert tiff.imagej_metadata["unit"] == "um"
        assert tiff.pages[0].get_resolution()[0] == pytest.approx(10.0)
    z = tifffile.imread(written / "height.tif")
    assert z.shape == (120, 160)
    assert np.isnan(z[0]).all()
    assert np.nanmax(z) == pytest.approx(3.0, abs=0.05)


def test_a_map_comes_back(tmp_path: Path) -> None:
    values = np.array([[0.1, np.nan], [-3.0, 1e-3]])
    write_map(tmp_path / "m.tif", values, 0.147)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "m.tif"), values.astype(np.float32))


def test_points_open_elsewhere_with_their_sigma(written: Path) -> None:
    import open3d as o3d
    import trimesh

    expected = reconstruct(bump_series(), KnowsTheBump()).points
    cloud = o3d.t.io.read_point_cloud(str(written / "points.ply"))
    np.testing.assert_allclose(cloud.point.positions.numpy(), expected.xyz_um, atol=1e-5)
    np.testing.assert_allclose(cloud.point["sigma"].numpy()[:, 0], expected.sigma_um, rtol=1e-6)
    np.testing.assert_allclose(trimesh.load(written / "points.ply").vertices, expected.xyz_um, atol=1e-5)


def test_the_mesh_opens_elsewhere_and_faces_the_gun(written: Path) -> None:
    import open3d as o3d
    import trimesh

    mesh = trimesh.load(written / "mesh.ply", process=False)
    assert len(mesh.faces) > 100
    assert (mesh.face_normals[:, 2] > 0).all()
    assert len(o3d.io.read_triangle_mesh(str(written / "mesh.ply")).triangles) == len(mesh.faces)


def test_the_report_is_strict_json(written: Path) -> None:
    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is not JSON")

    report = json.loads((written / "report.json").read_text(), parse_constant=refuse)
    assert report["method"] == "knows_the_bump"
    assert report["diagnostics"] == {"residual": None, "matches": [1, 2]}
    assert report["warnings"] == ["a sentence from the method"]
    assert report["residuals"]["reprojection_median_px"] == pytest.approx(0.2)
    assert len(report["poses"]) == 3
    assert set(report["seconds"]) == {"knows_the_bump", "surface"}
    assert {"semrecon", "numpy", "python"} <= set(report["versions"])


def test_jsonable_leaves_no_special_numbers() -> None:
    odd = {"a": np.float32("inf"), 3: (np.bool_(True), Path("x")), "n": np.array([[1.0, np.nan]])}
    assert jsonable(odd) == {"a": None, "3": [True, "x"], "n": [[1.0, None]]}


def test_the_summary_is_a_picture_and_not_blank(written: Path) -> None:
    with Image.open(written / "summary.png") as picture:
        pixels = np.asarray(picture.convert("L"))
    assert min(pixels.shape) > 600
    assert pixels.std() > 20


def test_a_former_reconstruction_is_replaced_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    series = bump_series()
    write_reconstruction(reconstruct(series, KnowsTheBump()), out)
    write_reconstruction(reconstruct(series, KnowsTheBump(points=False, heights=True)), out)
    assert json.loads((out / "report.json").read_text())["options"]["heights"] is True
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("stranger", ["notes.txt", "view_00.tif"])
def test_a_former_reconstruction_with_a_stranger_in_it_stays(tmp_path: Path, stranger: str) -> None:
    out = tmp_path / "out"
    result = reconstruct(bump_series(), KnowsTheBump())
    write_reconstruction(result, out)
    (out / stranger).write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(InputError, match="holds something else"):
        write_reconstruction(result, out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("former", [False, True])
def test_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, former: bool, interruption: type[BaseException]
) -> None:
    out = tmp_path / "out"
    result = reconstruct(bump_series(), KnowsTheBump())
    if former:
        write_reconstruction(result, out)
    before = {path.name: path.read_bytes() for path in out.iterdir()} if former else None

    def interrupt(*_: object) -> None:
        raise interruption

    monkeypatch.setattr("semrecon.output.figures.write_summary", interrupt)
    with pytest.raises(interruption):
        write_reconstruction(result, out)
    assert [path.name for path in tmp_path.iterdir()] == (["out"] if former else [])
    if former:
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
