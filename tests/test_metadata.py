"""Claims on what instruments write: every known trap is avoided, damage never becomes a number, bars are found."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.errors import InputError
from semrecon.input.bottom import bottom_of, dead_rows
from semrecon.input.databar import common_data_bar, find_data_bar
from semrecon.input.doubts import doubts
from semrecon.input.images import read_image
from semrecon.input.intake import Stated, facts_of, take_in
from semrecon.input.metadata import ImageMetadata, read_metadata
from semrecon.input.vendors.base import LIMITS, length_um, number, pair
from semrecon.input.vendors.fei import fei
from semrecon.input.vendors.hitachi import hitachi
from semrecon.input.vendors.jeol import jeol
from semrecon.input.vendors.tescan import tescan_header, tescan_tag
from semrecon.input.vendors.text import sections
from semrecon.input.vendors.zeiss import zeiss
from semsim.databar import DataBarOptions, with_data_bar
from semsim.microscope import Microscope

SIZE = (160, 120)
FEI = """[Beam]
Beam=EBeam
Scan=EScan
[EBeam]
TiltCorrectionIsOn=no
ScanRotation=0
WD=0.011
[EScan]
PixelWidth=3e-07
PixelHeight=3e-07
[Stage]
StageT=0.1
WorkingDistance=0.011
[Image]
ResolutionX=160
ResolutionY=120
[Detectors]
Name=LFD
[PrivateFei]
DatabarHeight=0
"""
TESCAN = """Magnification=1000.0
MagnificationReference=0.32
PixelSizeX=0.000002
PixelSizeY=0.000002
Detector=E-T
ScanRotation=0.0
StageRotation=30.0
StageTilt=7.5
TiltCorrection=0.0
WD=0.006
"""
JEOL = """$CM_FORMAT JEOL-SEM
$CM_MAG 500
$CM_FULL_SIZE 160 100
$CM_SIGNAL SEI
$CM_STAGE_POS 2.044 0.704 10.2 11.0 7.5 0
$$SM_MICRON_BAR 80
$$SM_MICRON_MARKER 10um
$$SM_WD 8.2
"""
HITACHI = """[SemImageFile]
InstructName=S-4800
DataSize=160x120
PixelSize=99.21875
SignalName=SE(M)
WorkingDistance=8100 um
StagePositionR=0
StagePositionT=7.5
"""
real_data = pytest.mark.skipif("SEM_REAL_DATA" not in os.environ, reason="SEM_REAL_DATA names no folder of real images")


def real(name: str) -> Path:
    return Path(os.environ["SEM_REAL_DATA"]) / name


def picture(rows: int = SIZE[1], columns: int = SIZE[0], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(120, 25, (rows, columns)).clip(0, 255).astype(np.uint8)


def barred(seed: int = 0, columns: int = 320, bar: int = 32, rows: int = 240) -> np.ndarray:
    return with_data_bar(picture(rows, columns, seed), DataBarOptions(bar), Microscope(0.1, columns, rows), "pollen")


def thumbnail() -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture(8, 8)).save(file, "JPEG")
    return file.getvalue()


def tescan_block(text: str) -> bytes:
    """Lay out chunks as the instrument does: size, kind, content."""

    def chunk(kind: int, content: bytes) -> bytes:
        return (len(content) + 2).to_bytes(4, "little") + kind.to_bytes(2, "little") + content

    return chunk(1, b"\0\0" + thumbnail()) + chunk(2, text.encode() + b"\0") + b"\2\0\0\0\0\0"


def tiff(path: Path, tag: int, block: bytes, image: np.ndarray | None = None) -> Path:
    tifffile.imwrite(path, picture() if image is None else image, extratags=[(tag, 7, len(block), block, True)])
    return path


def numbers(data: ImageMetadata) -> tuple[float | None, ...]:
    return data.pixel_size_um, data.tilt_deg, data.tilt_axis_deg, data.working_distance_um


# --- vendors ----------------------------------------------------------------------------------------------------------


def test_fei_is_in_metres_and_radians(tmp_path: Path) -> None:
    data = read_metadata(tiff(tmp_path / "a.tif", 34682, FEI.encode() + b"\0"))
    assert numbers(data) == pytest.approx((0.3, math.degrees(0.1), 90.0, 11000.0))
    assert (data.detector, data.data_bar_px, data.warnings) == ("LFD", 0, ())
    assert dict(data.tags)["tilt_deg"] == "Stage/StageT"


def test_fei_degrees_in_place_of_radians_are_not_believed() -> None:
    data = fei(FEI.replace("StageT=0.1", "StageT=15").encode(), SIZE, "a.tif")
    assert data.tilt_deg is None
    assert "tilt of 859.4 degrees" in data.warnings[0]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("TiltCorrectionIsOn=no", "TiltCorrectionIsOn=yes", "tilt correction on"),
        ("PixelHeight=3e-07", "PixelHeight=3.5e-07", "1.167 times as high as wide"),
        ("Beam=EBeam", "Beam=IBeam", "ion beam"),
    ],
)
def test_fei_says_what_spoils_the_geometry(old: str, new: str, sentence: str) -> None:
    assert any(sentence in said for said in fei(FEI.replace(old, new).encode(), SIZE, "a.tif").warnings)


def test_fei_axis_is_unknown_under_scan_rotation() -> None:
    assert fei(FEI.replace("ScanRotation=0", "ScanRotation=0.5").encode(), SIZE, "a").tilt_axis_deg is None


def test_tescan_text_stands_behind_a_thumbnail(tmp_path: Path) -> None:
    data = read_metadata(tiff(tmp_path / "a.tif", 50431, tescan_block(TESCAN)))
    assert numbers(data) == pytest.approx((2.0, 7.5, 90.0, 6000.0))
    assert (data.detector, data.source, data.warnings) == ("E-T", "TESCAN metadata", ())


@pytest.mark.parametrize("name", ["a.hdr", "a-tif.hdr"])
def test_tescan_header_says_the_same(tmp_path: Path, name: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", picture())
    (tmp_path / name).write_text("[MAIN]\n" + TESCAN.replace("Detector", "\n[SEM]\nDetector"))
    data = read_metadata(tmp_path / "a.tif")
    assert numbers(data) == pytest.approx((2.0, 7.5, 90.0, 6000.0))
    assert data.source == f"TESCAN {name}"


def test_tescan_tag_and_header_that_differ_are_named(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", 50431, tescan_block(TESCAN))
    (tmp_path / "a.hdr").write_text(TESCAN)
    assert read_metadata(path).warnings == ()
    (tmp_path / "a.hdr").write_text(TESCAN.replace("StageTilt=7.5", "StageTilt=8.5"))
    data = read_metadata(path)
    assert data.tilt_deg == 7.5
    assert "tilt of 7.5 and TESCAN a.hdr one of 8.5" in data.warnings[0]


@pytest.mark.parametrize(("suffix", "encoding"), [(".jpg", "utf-8"), (".tif", "cp1252"), (".tif", "utf-16")])
def test_jeol_sidecar(tmp_path: Path, suffix: str, encoding: str) -> None:
    Image.fromarray(picture()).save(tmp_path / f"a{suffix}")
    (tmp_path / "a.txt").write_bytes(JEOL.replace("10um", "10µm").encode(encoding))
    data = read_metadata(tmp_path / f"a{suffix}")
    assert numbers(data) == pytest.approx((10 / 80, 7.5, None, 8200.0))
    assert (data.detector, data.data_bar_px, data.source) == ("SEI", 20, "JEOL a.txt")
    assert "to 0.6% only" in data.warnings[0]  # half a pixel of 80


def test_jeol_field_of_view_needs_no_marker() -> None:
    text = JEOL + "$CM_FIELD_OF_VIEW 32.0 24.0\n$CM_IMAGE_SIZE 160 120\n$CM_STAGE_POSITION 0 0 10 0 -3 0\n"
    data = jeol(text.encode(), SIZE, "a.tif", "a.txt")
    assert (data.pixel_size_um, data.tilt_deg, data.warnings) == (0.2, -3.0, ())


@pytest.mark.parametrize(
    ("stage", "tilt_deg"),
    [
        ("X=37.1761, Y=44.9344, R=354.9968, Z=16.90, T=-3.50", -3.5),
        ("X=37.1761, Y=44.9344, R=354.9968, Z=16.90", None),
        ("X=1, Y=2, R=3, Z=4, T=", None),
        ("1 2 3 4", None),
    ],
)
def test_jeol_stage_by_name_or_not_at_all(stage: str, tilt_deg: float | None) -> None:
    text = JEOL + f"$CM_FIELD_OF_VIEW 32.0µm 24.0µm\n$CM_IMAGE_SIZE 160 120\n$CM_STAGE_POSITION {stage}\n"
    data = jeol(text.encode(), SIZE, "a.tif", "a.txt")
    assert (data.pixel_size_um, data.tilt_deg) == (0.2, tilt_deg)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_hitachi_sidecar_is_in_nanometres(tmp_path: Path, encoding: str) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.tif")
    (tmp_path / "a.txt").write_bytes(HITACHI.replace("\n", "\r\n").encode(encoding))
    data = read_metadata(tmp_path / "a.tif")
    assert numbers(data) == pytest.approx((0.09921875, 7.5, None, 8100.0))
    assert (data.detector, data.source, data.warnings) == ("SE(M)", "Hitachi a.txt", ())


def test_a_note_beside_an_image_is_no_sidecar(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.tif")
    (tmp_path / "a.txt").write_text("PixelSize=3\nStageTilt=4\nmicroscope was in a bad mood\n")
    assert read_metadata(tmp_path / "a.tif") == ImageMetadata()


READERS: list[tuple[str, Callable[[bytes, tuple[int, int]], ImageMetadata], str]] = [
    ("fei", lambda block, size: fei(block, size, "a"), FEI),
    ("tescan tag", lambda block, size: tescan_tag(block, size, "a"), TESCAN),
    ("tescan header", lambda block, size: tescan_header(block, size, "a", "a.hdr"), TESCAN),
    ("jeol", lambda block, size: jeol(block, size, "a", "a.txt"), JEOL),
    ("hitachi", lambda block, size: hitachi(block, size, "a", "a.txt"), HITACHI),
]
every_reader = pytest.mark.parametrize(("read", "text"), [r[1:] for r in READERS], ids=[r[0] for r in READERS])


@every_reader
def test_the_pixel_size_of_another_grid_is_withheld(
    read: Callable[[bytes, tuple[int, int]], ImageMetadata], text: str
) -> None:
    """Rows may differ (a bar cut off); half the columns need half the pixels, or a cut: nobody but the user knows."""
    whole = read(text.encode(), SIZE)
    assert whole.pixel_size_um is not None
    assert read(text.encode(), (SIZE[0], 77)).pixel_size_um == whole.pixel_size_um
    halved = read(text.encode(), (SIZE[0] // 2, SIZE[1] // 2))
    assert halved.pixel_size_um is None
    assert any(f"if it was resized, --pixel-size-um {2 * whole.pixel_size_um:.5g}" in said for said in halved.warnings)


@every_reader
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_block_cut_anywhere_never_gives_another_number(
    read: Callable[[bytes, tuple[int, int]], ImageMetadata], text: str, data: st.DataObject
) -> None:
    whole = read(text.encode(), SIZE)
    short = read(text.encode()[: data.draw(st.integers(0, len(text)))], SIZE)
    for mine, theirs in zip(
        numbers(short)[:2] + numbers(short)[3:], numbers(whole)[:2] + numbers(whole)[3:], strict=True
    ):
        assert mine is None or mine == theirs


@every_reader
@settings(max_examples=60, deadline=None)
@given(places=st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=6)), max_size=6))
def test_damage_gives_believable_numbers_or_none(
    read: Callable[[bytes, tuple[int, int]], ImageMetadata], text: str, places: list[tuple[int, bytes]]
) -> None:
    block = bytearray(text.encode())
    for at, damage in places:
        block[at : at + len(damage)] = damage
    believable(read(bytes(block), SIZE))


@every_reader
@settings(max_examples=40, deadline=None)
@given(block=st.binary(max_size=300))
def test_noise_is_no_metadata(read: Callable[[bytes, tuple[int, int]], ImageMetadata], text: str, block: bytes) -> None:
    believable(read(block, SIZE))


@every_reader
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999", "1_0", "0x10", "1,5", "", "--", "1e300", "-1"])
def test_absurd_values_are_none(read: Callable[[bytes, tuple[int, int]], ImageMetadata], text: str, value: str) -> None:
    lines = [line.split("=")[0] + f"={value}" if "=" in line else line for line in text.splitlines()]
    lines = [f"{line.split(' ')[0]} {value} {value}" if line.startswith("$") else line for line in lines]
    data = read("\n".join([*lines, ""]).encode(), SIZE)
    assert (data.pixel_size_um, data.working_distance_um) == (None, None)
    assert data.tilt_deg in {None, -1.0, math.degrees(-1.0)}


def believable(data: ImageMetadata) -> None:
    for field, (least, most, _, _) in LIMITS.items():
        value = getattr(data, field)
        assert value is None or (math.isfinite(value) and least <= value <= most)
    assert data.data_bar_px is None or data.data_bar_px >= 0


def test_a_key_with_two_values_counts_for_nothing() -> None:
    assert sections(b"[a]\nx=1\nx=2\ny=3\ny=3\n")["a"] == {"y": "3"}
    assert tescan_tag((TESCAN + "StageTilt=9\n").encode(), SIZE, "a").tilt_deg is None
    assert jeol((JEOL + "$$SM_MICRON_BAR 81\n").encode(), SIZE, "a", "t").pixel_size_um is None


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_come_back(value: float) -> None:
    assert number(repr(value)) == value
    assert number(f" {value!r} ") == value


@pytest.mark.parametrize(
    ("text", "expected"), [("10um", 10), ("500nm", 0.5), ("1 mm", 1000), ("10µm", 10), ("1e-3 m", 1000), ("5 kg", None)]
)
def test_lengths_have_units(text: str, expected: float | None) -> None:
    assert length_um(text, "um") == pytest.approx(expected)


def test_pairs() -> None:
    assert (pair("1280x960"), pair("1280 960"), pair("2048 * 1536"), pair("0x5"), pair("12")) == (
        (1280, 960), (1280, 960), (2048, 1536), None, None,
    )  # fmt: skip


def test_a_damaged_tag_in_a_file_is_no_traceback(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for tag in (34118, 34682, 50431):
        for i in range(5):
            believable(read_metadata(tiff(tmp_path / f"{tag}_{i}.tif", tag, rng.bytes(200))))


def test_a_zeiss_block_cut_in_a_number_loses_the_number(tmp_path: Path) -> None:
    block = b"\r\n0\r\nAP_WD\r\nWD = 6.2 mm\r\nAP_STAGE_AT_T\r\nStage at T = -12.5 \xb0\r\n"
    assert read_metadata(tiff(tmp_path / "a.tif", 34118, block)).tilt_deg == -12.5
    for end in (5, 6, 7):
        short = read_metadata(tiff(tmp_path / f"{end}.tif", 34118, block[:-end]))
        assert (short.tilt_deg, short.working_distance_um) == (None, pytest.approx(6200))


def test_zeiss_of_a_resized_image_has_no_pixel_size() -> None:
    tags = {
        "ap_image_pixel_size": ("Image Pixel Size", 50.0, "nm"),
        "dp_image_store": ("Store resolution", "1024 * 768"),
    }
    assert zeiss(tags, (768, 1024), "a").pixel_size_um == pytest.approx(0.05)  # turned
    resized = zeiss(tags, (768, 576), "a")
    assert resized.pixel_size_um is None
    assert "--pixel-size-um 0.066667" in resized.warnings[0]


# --- data bars --------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    columns=st.integers(200, 900),
    bar=st.integers(24, 60),
    seed=st.integers(0, 99),
    wide=st.booleans(),
    inverted=st.booleans(),
)
def test_simulated_data_bars_are_found_to_the_row(
    columns: int, bar: int, seed: int, wide: bool, inverted: bool
) -> None:
    image = barred(seed, columns, bar, 300)
    image = 255 - image if inverted else image
    image = image.astype(np.uint16) * 257 if wide else image
    assert find_data_bar(image) == bar


@pytest.mark.parametrize("quality", [60, 90])
def test_data_bars_survive_jpeg(tmp_path: Path, quality: int) -> None:
    Image.fromarray(barred()).save(tmp_path / "a.jpg", quality=quality)
    found = find_data_bar(read_image(tmp_path / "a.jpg"))
    assert found is not None
    assert 32 <= found <= 40  # JPEG frays the edge by up to a block


def test_a_row_of_the_picture_below_the_bar_goes_with_it() -> None:
    assert find_data_bar(np.concatenate([barred(), picture(1, 320)])) == 33


def black_ground(seed: int) -> np.ndarray:
    """A grain on a ground so dark that it is cut off to zero."""
    image = picture(300, 400, seed)
    y, x = np.mgrid[:300, :400]
    return np.where((x - 200) ** 2 + (y - 180) ** 2 < 100**2, image, 0).astype(np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        picture(300, 400),
        black_ground(1),
        255 - black_ground(2),
        np.zeros((300, 400), np.uint8),
        np.concatenate([picture(260, 400), np.zeros((40, 400), np.uint8)]),  # an interrupted scan is not written on
        np.concatenate([picture(260, 400), picture(40, 400) // 8]),
        np.tile(np.arange(400, dtype=np.uint16), (300, 1)),
        picture(20, 400),
    ],
    ids=["noise", "black ground", "white ground", "blank", "cut scan", "dark strip", "ramp", "low"],
)
def test_pictures_have_no_data_bar(image: np.ndarray) -> None:
    assert find_data_bar(image) is None


def test_a_series_has_a_bar_only_if_all_have_the_same() -> None:
    assert common_data_bar([barred(0), barred(1)]) == (32, "")
    assert common_data_bar([picture(), picture()]) == (None, "")
    rows, said = common_data_bar([barred(0), picture(272, 320)])
    assert rows is None
    assert "rows: 32, none" in said


def smooth(seed: int = 0) -> np.ndarray:
    """A picture whose rows resemble their neighbours."""
    coarse = picture(20, 30, seed)
    return np.asarray(Image.fromarray(coarse).resize((300, 200), Image.Resampling.BICUBIC), float)


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_dead_lines_at_the_bottom_are_counted(dead: int) -> None:
    """One flat line, and above it one that blends into it."""
    image = smooth()
    image[len(image) - dead :] *= np.array([0.0] if dead == 1 else [0.4, 0.0])[:dead, None]
    assert dead_rows(image.astype(np.uint8)) == dead
    assert bottom_of([image.astype(np.uint8), smooth(1).astype(np.uint8)]).crop_px == dead


@pytest.mark.parametrize("image", [black_ground(3), np.zeros((300, 400), np.uint8), picture(20, 30)])
def test_dark_bottoms_are_not_dead(image: np.ndarray) -> None:
    assert dead_rows(image) == 0


# --- series -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def plain(tmp_path: Path) -> list[Path]:
    for i in range(2):
        Image.fromarray(barred(i)).save(tmp_path / f"{i}.png")
    return [tmp_path / "0.png", tmp_path / "1.png"]


def test_a_certain_bar_is_cropped_and_said(plain: list[Path]) -> None:
    intake = take_in(plain, Stated((0.0, 6.0), 0.1))
    assert intake.series.optics.shape == (240, 320)
    np.testing.assert_array_equal(intake.series.views[1].image, picture(240, 320, 1))
    assert intake.warnings == ("a data bar of 32 rows was found, and cropped; --crop-bottom 0 keeps it",)


@pytest.mark.parametrize("rows", [0, 5])
def test_the_option_wins_over_the_bar(plain: list[Path], rows: int) -> None:
    intake = take_in(plain, Stated((0.0, 6.0), 0.1, crop_bottom_px=rows))
    assert intake.series.optics.shape == (272 - rows, 320)
    assert intake.warnings == ()


def test_a_bar_in_a_series_folder_is_said_only(plain: list[Path]) -> None:
    views = "".join(f'[[view]]\nimage = "{i}.png"\ntilt_deg = {6 * i}.0\n' for i in range(2))
    (plain[0].parent / "series.toml").write_text(f"pixel_size_um = 0.1\n{views}")
    intake = take_in([plain[0].parent])
    assert intake.series.optics.shape == (272, 320)
    assert "give --crop-bottom 32" in intake.warnings[0]


def test_a_bar_where_the_metadata_states_none(tmp_path: Path) -> None:
    """DatabarHeight = 0 and a bar in the picture."""
    text = FEI.replace("ResolutionX=160", "ResolutionX=320")
    paths = [
        tiff(tmp_path / f"{i}.tif", 34682, text.replace("T=0.1", f"T=0.{i}").encode(), barred(i)) for i in range(2)
    ]
    intake = take_in(paths)
    assert intake.series.optics.shape == (240, 320)
    assert intake.series.tilts_deg == pytest.approx([0.0, math.degrees(0.1)])
    assert "32 rows was found, though the metadata states 0, and cropped" in intake.warnings[0]


def test_a_stated_bar_that_is_not_seen_is_said(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", 34682, FEI.replace("Height=0", "Height=20").encode())
    assert any("states a data bar of 20 rows" in said for said in doubts(facts_of([path]), [read_image(path)]))


def test_info_says_that_all_tilts_are_equal_and_where_they_were_read(tmp_path: Path) -> None:
    paths = [tiff(tmp_path / f"{i}.tif", 34682, FEI.encode()) for i in range(3)]
    result = CliRunner().invoke(app, ["info", *map(str, paths)])
    assert result.exit_code == 0, result.output
    assert "all 3 tilts are 5.72958 degrees" in result.stderr
    assert "tilt_deg from Stage/StageT" in result.stdout
    assert result.stdout.count("LFD") == 3


def test_info_says_that_images_do_not_agree(tmp_path: Path) -> None:
    tiff(tmp_path / "a.tif", 34682, FEI.encode())
    tiff(tmp_path / "b.tif", 34682, FEI.replace("e-07", "e-08").replace("T=0.1", "T=0").encode(), picture(130))
    result = CliRunner().invoke(app, ["info", str(tmp_path / "a.tif"), str(tmp_path / "b.tif")])
    assert "do not agree on a pixel size (0.3, 0.03); give --pixel-size-um" in result.stderr
    assert "not all of one size" in result.stderr


def test_files_with_different_pixel_sizes_need_a_word(tmp_path: Path) -> None:
    paths = [
        tiff(tmp_path / f"{i}.tif", 34682, FEI.replace("3e-07", f"{i + 3}e-07").encode(), picture(seed=i))
        for i in range(2)
    ]
    with pytest.raises(InputError, match="no common pixel size"):
        take_in(paths)


# --- real files -------------------------------------------------------------------------------------------------------


@real_data
def test_real_zeiss_tilt_correction_is_not_the_stage() -> None:
    data = read_metadata(real("vendor/zeiss_auriga_tilt54.tif"))
    assert numbers(data) == pytest.approx((0.07443, 54.0, 90.0, 5100.0))  # AP_TILT_ANGLE says 36
    assert "tilt correction on" in data.warnings[0]
    assert numbers(read_metadata(real("vendor/zeiss_merlin.tif")))[:2] == (0.05582, 0.0)  # AP_TILT_ANGLE says -16.2


@real_data
def test_real_zeiss_image_pixel_size_not_pixel_size() -> None:
    data = read_metadata(real("potamogeton/pot_03.tif"))
    assert data.pixel_size_um == pytest.approx(0.05582)  # AP_PIXEL_SIZE, of 1024 columns, says 111.6 nm
    assert data.tilt_axis_deg == 0.0  # turned by a quarter after the scan


@real_data
def test_real_fei() -> None:
    data = read_metadata(real("vendor/fei_quanta.tif"))
    assert numbers(data) == pytest.approx((0.441942, math.degrees(0.0121551), 90.0, 11051.0))
    assert (data.detector, data.data_bar_px) == ("LFD", 59)


@real_data
def test_real_tescan_tag_and_header_agree(tmp_path: Path) -> None:
    path = real("vendor/tescan_pfib_pixels_zeroed.tif")
    data = read_metadata(path)
    assert numbers(data) == pytest.approx((0.0015625, 0.0, 90.0, 5947.501))
    assert (data.detector, data.data_bar_px, data.warnings) == ("E-T", 298, ())  # 1280 + 298 rows
    header = path.with_suffix(".hdr").read_bytes()
    assert numbers(tescan_header(header, (1280, 1578), "a", "a.hdr")) == numbers(data)


@real_data
@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("vendor/fei_quanta.tif", 59),
        ("bse/P33_scale1_detectorA.tif", 79),
        ("bse/P33_scale1_detectorC.tif", 79),
        ("vendor/zeiss_auriga_tilt54.tif", 78),
        ("vendor/zeiss_merlin.tif", None),
        ("vendor/tescan_pfib_pixels_zeroed.tif", None),
        ("potamogeton/pot_00.tif", None),
        ("potamogeton/pot_06.tif", None),
        ("brassica/Brassica01.jpg", None),
    ],
)
def test_real_data_bars(name: str, rows: int | None) -> None:
    assert find_data_bar(read_image(real(name))) == rows


@real_data
def test_real_segments_of_one_pose_have_equal_tilts() -> None:
    paths = [real(f"bse/P33_scale1_detector{segment}.tif") for segment in "ABC"]
    said = " ".join(doubts(facts_of(paths), [read_image(path) for path in paths]))
    assert "all 3 tilts are" in said
    assert "data bar of 79 rows" in said


@real_data
@pytest.mark.parametrize(
    ("name", "rows"),
    [("potamogeton/pot_00.tif", 2), ("brassica/Brassica01.jpg", 0), ("vendor/zeiss_merlin.tif", 0)],
)
def test_real_dead_rows(name: str, rows: int) -> None:
    assert dead_rows(read_image(real(name))) == rows
