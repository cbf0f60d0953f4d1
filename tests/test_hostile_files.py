"""The promise on what comes in: an Intake, or one sentence that names the file; no traceback, no wrong number."""

from __future__ import annotations

import io
import math
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from semrecon.cli import app
from semrecon.errors import InputError
from semrecon.input.images import MOST_PIXELS, read_image
from semrecon.input.intake import Intake, Stated, take_in
from semrecon.input.metadata import read_metadata
from semrecon.input.vendors.base import LIMITS

GREY = np.random.default_rng(7).integers(1, 255, (40, 50), dtype=np.uint8)
FEI = (
    "[Beam]\r\nBeam=EBeam\r\n[EBeam]\r\nScanRotation=0\r\n[Scan]\r\nPixelWidth=1e-8\r\nPixelHeight=1e-8\r\n[Stage]\r\n"
)
FEI += "StageT=0.1\r\n[Image]\r\nResolutionX=50\r\nResolutionY=40\r\n"
TESCAN = "[SEM]\r\nPixelSizeX=1e-8\r\nPixelSizeY=1e-8\r\nStageTilt=3.0\r\nScanRotation=0\r\nWD=0.01\r\n"
ZEISS = "\r\n".join(["0"] * 2 + ["AP_IMAGE_PIXEL_SIZE", "Image Pixel Size = 10 nm", "AP_STAGE_AT_T"])
ZEISS += "\r\nStage at T = 3.0 °\r\nDP_IMAGE_STORE\r\nStore resolution = 50 * 40\r\n"
JEOL = "$CM_FORMAT JEOL/EM\r\n$CM_FULL_SIZE 50 40\r\n$CM_STAGE_POS 0 0 0 0 3.5 0\r\n$$SM_MICRON_BAR 50\r\n"
JEOL += "$$SM_MICRON_MARKER 1um\r\n$$SM_WD 10.0\r\n"
HITACHI = "[SemImageFile]\r\nPixelSize=10.0\r\nDataSize=50x40\r\nStagePositionT=3.0\r\nWorkingDistance=10000 um\r\n"


def tiff(pixels: np.ndarray = GREY, **how: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, **how)
    return file.getvalue()


def by_pillow(kind: str, mode: str = "L", pixels: np.ndarray = GREY) -> bytes:
    file = io.BytesIO()
    picture = Image.fromarray(pixels)
    (picture if mode == "L" else picture.convert(mode)).save(file, kind)
    return file.getvalue()


def vendor(tag: int, kind: int, text: str) -> bytes:
    block = text.encode("cp1252")
    return tiff(extratags=[(tag, kind, len(block), block, True)])


PALETTE = np.repeat((np.arange(256, dtype=np.uint16) * 257)[None], 3, axis=0)
FILES = {
    "grey8.tif": tiff(),
    "grey16.tif": tiff(GREY.astype(np.uint16) * 200),
    "other_end.tif": tiff(GREY.astype(np.uint16), byteorder=">"),
    "float.tif": tiff(GREY.astype(np.float32)),
    "big.tif": tiff(bigtiff=True),
    "rgb.tif": tiff(np.repeat(GREY[..., None], 3, axis=2), photometric="rgb"),
    "planes.tif": tiff(np.repeat(GREY[None], 3, axis=0), photometric="rgb", planarconfig="separate"),
    "palette.tif": tiff(photometric="palette", colormap=PALETTE),
    "white.tif": tiff(photometric="miniswhite"),
    "zip.tif": tiff(compression="zlib", rowsperstrip=8),
    "tiles.tif": tiff(np.tile(GREY, (2, 2)), tile=(16, 16)),
    "pages.tif": tiff(np.stack([GREY, GREY])),
    "fei.tif": vendor(34682, 2, FEI),
    "tescan.tif": vendor(50431, 1, "\xff\xd8\xff\xd9\0" + TESCAN),
    "zeiss.tif": vendor(34118, 2, ZEISS),
    "grey.png": by_pillow("PNG"),
    "palette.png": by_pillow("PNG", "P"),
    "rgb.png": by_pillow("PNG", "RGB"),
    "grey16.png": by_pillow("PNG", pixels=GREY.astype(np.uint16) * 200),
    "grey.jpg": by_pillow("JPEG"),
    "rgb.jpg": by_pillow("JPEG", "RGB"),
}
SIDECARS = {"a.hdr": TESCAN.encode(), "b.txt": JEOL.encode(), "c.txt": HITACHI.encode("utf-16")}
DAMAGE = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1), st.just(b"")),
    st.tuples(st.just("head"), st.floats(0, 1), st.binary(min_size=1, max_size=4)),
    st.tuples(st.just("over"), st.floats(0, 1), st.binary(min_size=1, max_size=8)),
    st.tuples(st.just("into"), st.floats(0, 1), st.binary(min_size=1, max_size=8)),
)


def damaged(content: bytes, blows: list[tuple[str, float, bytes]]) -> bytes:
    """Cut, overwrite (mostly in the first 400 bytes, where headers are) or push bytes in."""
    for how, where, new in blows:
        at = int(where * (min(len(content), 400) if how == "head" else len(content)))
        rest = b"" if how == "cut" else content[at:] if how == "into" else content[at + len(new) :]
        content = content[:at] + new + rest
    return content


def intake_or_sentence(make: Callable[[], Intake], *names: str) -> Intake | None:
    """Claim what this page promises, and hand back the intake if there is one."""
    said, intake = "", None
    try:
        intake = make()
    except InputError as error:
        said = str(error)
    if intake is None:
        assert "\n" not in said
        assert any(name in said for name in names), said
        return None
    series = intake.series
    least, most = LIMITS["pixel_size_um"][:2]
    assert least <= series.optics.pixel_size_um <= most
    assert (np.abs(series.tilts_deg) <= 90).all()
    assert abs(series.tilt_axis_deg) <= 360
    assert 0 <= series.optics.inverse_working_distance <= 1
    for view in series.views:
        assert view.image.shape == series.optics.shape
        assert min(view.image.shape) > 0
        assert np.isfinite(view.image).all()
    return intake


# --- one image --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=15)
@given(blows=st.lists(DAMAGE, min_size=1, max_size=3))
def test_a_damaged_file_is_an_image_or_a_sentence(name: str, blows: list[tuple[str, float, bytes]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        good, bad = Path(folder) / f"good{Path(name).suffix}", Path(folder) / name
        good.write_bytes(tiff(GREY[::-1]) if name.endswith("tif") else by_pillow("PNG", pixels=GREY[::-1]))
        bad.write_bytes(damaged(FILES[name], blows))
        intake_or_sentence(lambda: take_in([bad, good], Stated((0.0, 5.0), 0.1)), name, good.name, "images must all")
        data = read_metadata(bad)
        for field, (least, most, _, _) in LIMITS.items():
            value = getattr(data, field)
            assert value is None or least <= value <= most


@pytest.mark.parametrize("name", SIDECARS)
@settings(max_examples=25)
@given(blows=st.lists(DAMAGE, min_size=1, max_size=4))
def test_a_damaged_sidecar_never_gives_an_absurd_number(name: str, blows: list[tuple[str, float, bytes]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for stem in (Path(name).stem, "other"):
            (Path(folder) / stem).with_suffix(".tif").write_bytes(tiff(GREY if stem == "other" else GREY[::-1]))
        (Path(folder) / name).write_bytes(damaged(SIDECARS[name], blows))
        (Path(folder) / "other").with_suffix(Path(name).suffix).write_bytes(SIDECARS[name])
        images = [(Path(folder) / stem).with_suffix(".tif") for stem in (Path(name).stem, "other")]
        intake_or_sentence(lambda: take_in(images), Path(name).stem, "pixel size")


def retagged(content: bytes, **tags: int) -> bytes:
    """Change values of tags in the header of a small little-endian TIFF: width, length, count of offsets."""
    numbers = {"width": (256, 8), "length": (257, 8), "rows_a_strip": (278, 8), "offsets": (273, 4), "counts": (279, 4)}
    changed = bytearray(content)
    start = struct.unpack_from("<I", content, 4)[0]
    for i in range(struct.unpack_from("<H", content, start)[0]):
        entry = start + 2 + 12 * i
        for name, value in tags.items():
            if struct.unpack_from("<H", content, entry)[0] == numbers[name][0]:
                struct.pack_into("<I", changed, entry + numbers[name][1], value)
    return bytes(changed)


def png_of(columns: int, rows: int) -> bytes:
    """A PNG whose header declares another size than it has."""
    import zlib

    content = by_pillow("PNG")
    head = content[12:16] + struct.pack(">II", columns, rows) + content[24:29]
    return content[:12] + head + struct.pack(">I", zlib.crc32(head)) + content[33:]


NOT_IMAGES = {
    "text named .tif": (b"dear diary", "is not an image"),
    "text named like a TIFF": (b"II*\0 dear diary", "damaged TIFF"),
    "empty": (b"", "is not an image"),
    "four bytes": (b"II*\0", "damaged TIFF"),
    "wrong end": (b"MM\0*" + tiff()[4:], "damaged TIFF"),
    "declares 60000 x 60000": (retagged(tiff(), width=60000, length=60000), "declares 60000 x 60000 pixels"),
    "no columns": (retagged(tiff(), width=0), "no pixels"),
    "twice as long, zipped": (retagged(tiff(compression="zlib", rowsperstrip=8), length=80), "are missing"),
    "half the strips": (retagged(tiff(rowsperstrip=8), offsets=2, counts=2), "are missing"),
    "bomb": (png_of(50000, 50000), "more pixels than a series can have"),
    "large png": (png_of(13000, 13000), "damaged image"),
    "colour": (tiff(np.stack([GREY, GREY, GREY[::-1]], axis=-1), photometric="rgb"), "is in colour"),
    "pages": (FILES["pages.tif"], "holds 2 images"),
    "turned": (tiff(extratags=[(274, 3, 1, 6, True)]), "orientation tag 6"),
    "infinite": (tiff(np.where(GREY > 250, np.inf, GREY).astype(np.float32)), "infinite"),
    "only NaN": (tiff(np.full((40, 50), np.nan, np.float32)), "no numbers"),
    "fractions from white": (tiff(GREY.astype(np.float32), photometric="miniswhite"), "counts down from white"),
    "signed": (tiff(GREY.astype(np.int16)), "type int16"),
    "doubles": (tiff(GREY.astype(np.float64)), "type float64"),
    "bits": (tiff(GREY > 100), "type bool"),
}


@pytest.mark.parametrize("case", NOT_IMAGES)
def test_what_is_no_micrograph_is_named(tmp_path: Path, case: str) -> None:
    content, sentence = NOT_IMAGES[case]
    (tmp_path / "odd.tif").write_bytes(content)
    with pytest.raises(InputError, match=sentence) as raised:
        read_image(tmp_path / "odd.tif")
    assert str(raised.value).startswith(str(tmp_path / "odd.tif"))


def test_a_large_but_possible_image_is_not_a_bomb() -> None:
    assert MOST_PIXELS >= 16384 * 16384  # the largest frame of common scan generators


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (2, 2), (17, 17)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_tiny_images_come_in(tmp_path: Path, shape: tuple[int, int], dtype: type) -> None:
    for i in range(2):
        pixels = np.random.default_rng(i).integers(1, 255, shape).astype(dtype)
        tifffile.imwrite(tmp_path / f"{i}.tif", pixels)
    made = take_in([tmp_path / "0.tif", tmp_path / "1.tif"], Stated((0.0, 5.0), 0.1))
    assert made.series.optics.shape == shape


# --- series.toml ------------------------------------------------------------------------------------------------------

ANY = st.recursive(
    st.one_of(
        st.none().map(lambda _: "none"),
        st.booleans(),
        st.integers(-(2**70), 2**70),
        st.floats(),
        st.text(max_size=6),
        st.sampled_from(["a.tif", "b.tif", "/a.tif", "../a.tif", "", ".", "a\0b", "x" * 300, 3.0, 0.1, 400.0, -90.0]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=2)),
    max_leaves=4,
)
VIEW = st.fixed_dictionaries(
    {"image": st.sampled_from(["a.tif", "b.tif", "c.tif"]), "tilt_deg": st.floats(-100, 100) | st.floats()},
    optional={"stage_um": ANY, "channels": st.dictionaries(st.sampled_from(["x", "image"]), st.just("c.tif")) | ANY},
)
SERIES = st.fixed_dictionaries(
    {"pixel_size_um": st.sampled_from([0.1, 1.0]) | ANY, "view": st.lists(VIEW, max_size=3) | ANY},
    optional={"tilt_axis_deg": ANY, "working_distance_um": ANY, "channel": ANY, "camera": ANY},
)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("garbled")
    for i, name in enumerate("abc"):
        pixels = np.random.default_rng(i).integers(1, 255, (40, 50), dtype=np.uint8)
        tifffile.imwrite(folder / f"{name}.tif", pixels)
    return folder


@settings(max_examples=120)
@given(content=SERIES)
def test_a_garbled_series_is_an_intake_or_a_sentence(images: Path, content: dict[str, Any]) -> None:
    try:
        (images / "series.toml").write_bytes(tomli_w.dumps(content).encode())
    except (UnicodeEncodeError, ValueError):  # what cannot be written cannot be read
        return
    names = ("series.toml", ".tif", str(images), "cannot be the name of a file", "tilt axis", "image")
    intake_or_sentence(lambda: take_in([images]), *names)


@settings(max_examples=40)
@given(content=st.binary(max_size=60) | st.integers(1, 3000).map(lambda n: b"a = " + b"[" * n))
def test_bytes_are_no_series(images: Path, content: bytes) -> None:
    (images / "series.toml").write_bytes(content)
    intake_or_sentence(lambda: take_in([images]), "series.toml")


HEAD = "pixel_size_um = 0.1\ntilt_axis_deg = 0.0\n"
TWO = "[[view]]\nimage = 'a.tif'\ntilt_deg = 0.0\n[[view]]\nimage = 'b.tif'\ntilt_deg = 5.0\n"
ODD_SERIES = {
    "tilt of 400": (HEAD + TWO.replace("5.0", "400.0"), "b.tif has a tilt of 400 degrees"),
    "infinite tilt": (HEAD + TWO.replace("5.0", "-inf"), "b.tif has a tilt of -inf degrees"),
    "NaN tilt": (HEAD + TWO.replace("5.0", "nan"), "b.tif has no tilt angle"),
    "negative pixel": (HEAD.replace("0.1", "-0.1") + TWO, "series.toml: pixel_size_um must be a positive number"),
    "NaN pixel": (HEAD.replace("0.1", "nan") + TWO, "series.toml: pixel_size_um must be a positive number"),
    "pixel of a metre": (HEAD.replace("0.1", "1e6") + TWO, "series.toml: pixel_size_um is 1e.06, which no pixel size"),
    "axis of NaN": (HEAD.replace("0.0", "nan") + TWO, "tilt axis must be an angle"),
    "axis of 4000": (HEAD.replace("0.0", "4000") + TWO, "tilt axis must be an angle"),
    "missing image": (HEAD + TWO.replace("b.tif", "d.tif"), "d.tif does not exist"),
    "image named twice": (HEAD + TWO.replace("b.tif", "a.tif"), "a.tif is named twice"),
    "image named twice in two ways": (HEAD + TWO.replace("b.tif", "../{}/a.tif"), "a.tif is named twice"),
    "folder for an image": (HEAD + TWO.replace("b.tif", "."), "is a folder where an image"),
    "name with a NUL": (HEAD + TWO.replace("'b.tif'", '"b\\u0000"'), "cannot be the name of a file"),
    "name too long": (HEAD + TWO.replace("b.tif", "b" * 5000), "cannot be read"),
    "not UTF-8": (HEAD + "# \xff", "series.toml is not valid TOML"),
    "one view as a table": (HEAD + TWO.split("[[", 2)[1].replace("view]]", "[view]"), "series.toml: view"),
}


@pytest.mark.parametrize("case", ODD_SERIES)
@pytest.mark.parametrize("command", ["reconstruct", "take_in"])
def test_an_odd_series_is_one_sentence(tmp_path: Path, images: Path, case: str, command: str) -> None:
    for name in ("a.tif", "b.tif"):
        (tmp_path / name).write_bytes((images / name).read_bytes())
    toml, sentence = ODD_SERIES[case]
    (tmp_path / "series.toml").write_bytes(toml.replace("{}", tmp_path.name).encode("latin-1"))
    if command == "take_in":
        with pytest.raises(InputError, match=sentence):
            take_in([tmp_path])
        return
    result = CliRunner().invoke(app, ["reconstruct", str(tmp_path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_an_absolute_path_is_a_path(tmp_path: Path, images: Path) -> None:
    toml = HEAD + TWO.replace("a.tif", str(images / "a.tif")).replace("b.tif", str(images / "b.tif"))
    (tmp_path / "series.toml").write_text(toml)
    assert [view.name for view in take_in([tmp_path]).series.views] == ["a.tif", "b.tif"]


def test_a_folder_named_series_toml_is_no_series(tmp_path: Path) -> None:
    (tmp_path / "series.toml").mkdir()
    with pytest.raises(InputError, match=r"series\.toml cannot be read"):
        take_in([tmp_path])


@pytest.mark.parametrize("command", ["info", "reconstruct"])
@pytest.mark.parametrize("case", ["text named .tif", "empty", "declares 60000 x 60000", "bomb", "turned", "only NaN"])
def test_the_commands_say_it_in_one_sentence(tmp_path: Path, command: str, case: str) -> None:
    (tmp_path / "a.tif").write_bytes(tiff())
    (tmp_path / "odd.tif").write_bytes(NOT_IMAGES[case][0])
    more = ["--out", str(tmp_path / "out"), "--tilts", "0,5", "--pixel-size-um", "0.1"] if command != "info" else []
    result = CliRunner().invoke(app, [command, str(tmp_path / "a.tif"), str(tmp_path / "odd.tif"), *more])
    assert result.exit_code == 2
    assert "odd.tif" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"a.tif", "odd.tif"}


@pytest.mark.parametrize(
    ("stated", "sentence"),
    [
        (Stated((0.0, 400.0), 0.1), "b.tif has a tilt of 400 degrees"),
        (Stated((0.0, 5.0), 1e9), r"--pixel-size-um is 1e\+09, which no pixel size can be"),
        (Stated((0.0, 5.0), math.nan), "--pixel-size-um must be a positive number"),
        (Stated((0.0, 5.0), 0.1, math.inf), "tilt axis must be an angle"),
    ],
)
def test_flags_are_checked_like_files(images: Path, stated: Stated, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        take_in([images / "a.tif", images / "b.tif"], stated)


# --- views that are there twice ---------------------------------------------------------------------------------------


def test_a_file_given_twice_is_refused(images: Path) -> None:
    with pytest.raises(InputError, match=r"a\.tif is named twice"):
        take_in([images / "a.tif", images / "b.tif", images / ".." / images.name / "a.tif"], Stated((0, 5, 9), 0.1))


def test_a_copy_under_another_name_is_refused(tmp_path: Path, images: Path) -> None:
    (tmp_path / "copy.tif").write_bytes((images / "a.tif").read_bytes())
    paths = [images / "a.tif", images / "b.tif", tmp_path / "copy.tif"]
    with pytest.raises(InputError, match=r"copy\.tif holds the same picture as a.tif .* the tilts are 0 and 9 degrees"):
        take_in(paths, Stated((0.0, 5.0, 9.0), 0.1))
    with pytest.raises(InputError, match="both at 0 degrees"):
        take_in(paths, Stated((0.0, 5.0, 0.0), 0.1))


def test_two_pictures_at_one_tilt_are_said(images: Path) -> None:
    paths = [images / f"{name}.tif" for name in "abc"]
    twice = take_in(paths, Stated((3.0, 5.0, 3.0), 0.1, 0.0))
    assert [said for said in twice.warnings if "one tilt" in said] == [
        "a.tif and c.tif have one tilt, 3 degrees, and so no parallax against each other; check the tilts"
    ]
    assert not take_in(paths, Stated((3.0, 5.0, 7.0), 0.1, 0.0)).warnings
