"""Pictures as cameras make them: RAW, HEIC, 16 bits and foreign colours all come as 8-bit sRGB, rows as recorded."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from rig.errors import InputError
from rig.formats.pictures.images import decode_image_file, is_picture, open_picture, picture_size, read_image
from rig.formats.pictures.mask_values import read_masks

HEIC = Path(__file__).with_name("three_bands.heic")  # 64 x 48: red, green and blue bands from left to right


def dng(bayer: np.ndarray) -> bytes:
    """A DNG of one strip of 16-bit values, red first (Adobe's specification 1.4, chapter 4)."""
    height, width = bayer.shape
    matrix = np.round(np.linalg.inv([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]), 4)
    rationals = b"".join(struct.pack("<ii", round(value * 10_000), 10_000) for value in matrix.ravel())
    neutral = struct.pack("<6I", 1, 1, 1, 1, 1, 1)
    tags = [
        (254, 4, 1, struct.pack("<I", 0)),
        (256, 4, 1, struct.pack("<I", width)),
        (257, 4, 1, struct.pack("<I", height)),
        (258, 3, 1, struct.pack("<H", 16)),
        (259, 3, 1, struct.pack("<H", 1)),
        (262, 3, 1, struct.pack("<H", 32803)),
        (271, 2, 5, b"Made\0"),
        (272, 2, 5, b"Test\0"),
        (273, 4, 1, b"here"),
        (274, 3, 1, struct.pack("<H", 6)),  # turned to look at: not to be obeyed
        (277, 3, 1, struct.pack("<H", 1)),
        (278, 4, 1, struct.pack("<I", height)),
        (279, 4, 1, struct.pack("<I", 2 * width * height)),
        (33421, 3, 2, struct.pack("<HH", 2, 2)),
        (33422, 1, 4, bytes([0, 1, 1, 2])),
        (50706, 1, 4, bytes([1, 4, 0, 0])),
        (50708, 2, 10, b"Test made\0"),
        (50717, 4, 1, struct.pack("<I", 65535)),
        (50721, 10, 9, rationals),
        (50728, 5, 3, neutral),
        (50778, 3, 1, struct.pack("<H", 21)),
    ]
    at = 8 + 2 + 12 * len(tags) + 4
    entries, tail = b"", b""
    for tag, kind, count, value in tags:
        if value == b"here":
            value = struct.pack("<I", at + sum(len(v) + len(v) % 2 for *_, v in tags if len(v) > 4))
        if len(value) > 4:
            place, tail = at + len(tail), tail + value + b"\0" * (len(value) % 2)
            value = struct.pack("<I", place)
        entries += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0)
    return head + tail + bayer.astype("<u2").tobytes()


def test_a_dng_is_developed_in_its_own_rows(tmp_path: Path) -> None:
    bayer = np.full((120, 160), 2000, np.uint16)
    bayer[:, 80:][0::2, 0::2] = 40_000  # the right half is red
    (tmp_path / "a.dng").write_bytes(dng(bayer))
    assert picture_size(tmp_path / "a.dng") == (160, 120)
    pixels = read_image(tmp_path / "a.dng")
    assert pixels.shape == (120, 160, 3)
    left, right = pixels[40:80, 20:60].mean(axis=(0, 1)), pixels[40:80, 100:140].mean(axis=(0, 1))
    assert right[0] > 150
    assert right[0] > 3 * right[1]
    assert left.max() < 70
    assert open_picture(tmp_path / "a.dng").size == (160, 120)


@pytest.mark.parametrize(
    ("begins", "kind"), [(b"\0\0\0\x20ftypavif", "AVIF"), (b"\0\0\0\x18ftypmp42", "video"), (b"GIF89a", "GIF")]
)
def test_a_file_of_another_kind_than_its_name_is_called_what_it_is(tmp_path: Path, begins: bytes, kind: str) -> None:
    (tmp_path / "a.png").write_bytes(begins + bytes(100))
    with pytest.raises(InputError, match=f"is of the kind {kind}"):
        read_image(tmp_path / "a.png")


def test_a_heic_is_read(tmp_path: Path) -> None:
    assert picture_size(HEIC) == (64, 48)
    pixels = read_image(HEIC).astype(int)
    bands = [pixels[:, at : at + 10].mean(axis=(0, 1)) for at in (5, 27, 49)]
    assert [int(band.argmax()) for band in bands] == [0, 1, 2]
    grey, digest, fault = decode_image_file(HEIC, "a.heic", "grey")
    assert grey is not None
    assert grey.shape == (48, 64)
    assert (len(digest), fault) == (64, None)
    (tmp_path / "a.jpg").write_bytes(HEIC.read_bytes())  # under another kind's name
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), pixels)


def test_sixteen_bits_become_eight(tmp_path: Path) -> None:
    ramp = np.repeat(np.linspace(0, 65535, 64).astype(np.uint16)[None, :, None], 48, axis=0).repeat(3, axis=2)
    cv2.imwrite(str(tmp_path / "a.tif"), ramp)
    seen = read_image(tmp_path / "a.tif")
    assert seen.dtype == np.uint8
    assert np.abs(seen[0, :, 0].astype(int) - ramp[0, :, 0] / 257.0).max() <= 1.0


def test_another_profile_s_colours_become_srgb(tmp_path: Path) -> None:
    swapped = np.zeros((8, 8, 3), np.uint8)
    swapped[:] = (200, 100, 50)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(swapped).save(tmp_path / "srgb.png", icc_profile=lab)
    np.testing.assert_array_equal(read_image(tmp_path / "srgb.png"), swapped)
    Image.fromarray(swapped).save(tmp_path / "odd.png", icc_profile=b"no profile at all")
    np.testing.assert_array_equal(read_image(tmp_path / "odd.png"), swapped)
    wide = lab.replace(b"s\0R\0G\0B", b"w\0i\0d\0e").replace(b"sRGB", b"wide")  # named otherwise, primaries swapped
    names = [wide.index(name, 128) for name in (b"rXYZ", b"bXYZ")]
    red, blue = (wide[at + 4 : at + 8] for at in names)
    parts = bytearray(wide)
    parts[names[0] + 4 : names[0] + 8], parts[names[1] + 4 : names[1] + 8] = blue, red
    Image.fromarray(swapped).save(tmp_path / "wide.png", icc_profile=bytes(parts))
    np.testing.assert_allclose(read_image(tmp_path / "wide.png")[0, 0], (50, 100, 200), atol=3)


def test_a_file_is_read_by_its_content_whatever_its_ending(tmp_path: Path) -> None:
    picture = Image.fromarray(np.full((40, 50, 3), (200, 100, 50), np.uint8))
    for content in ("JPEG", "WEBP", "TIFF"):
        picture.save(tmp_path / "a.png", format=content, quality=100)
        np.testing.assert_allclose(read_image(tmp_path / "a.png")[20, 20], (200, 100, 50), atol=3)
    picture.save(tmp_path / "more.png")
    whole = (tmp_path / "more.png").read_bytes()
    (tmp_path / "more.png").write_bytes(whole + b"written behind the end by a camera's maker")
    np.testing.assert_array_equal(read_image(tmp_path / "more.png")[20, 20], (200, 100, 50))
    (tmp_path / "cut.jpg").write_bytes(whole[:-20])  # a PNG by another name, cut off
    with pytest.raises(InputError, match="is damaged"):
        read_image(tmp_path / "cut.jpg")


def half(value: object, other: object = 0, kind: type = np.uint8) -> np.ndarray:
    """A mask whose left half is ``value``."""
    return np.array([[value] * 4 + [other] * 4] * 6, kind)


def painted() -> Image.Image:
    """The same with a palette whose second colour is dark."""
    picture = Image.fromarray(half(1))
    picture.putpalette([0, 0, 0, 40, 0, 0])
    return picture


@pytest.mark.parametrize(
    "picture",
    [
        pytest.param(Image.fromarray(half(1)), id="labels"),
        pytest.param(Image.fromarray(half(1, kind=np.uint16)), id="labels of 16 bits"),
        pytest.param(Image.fromarray(half((0, 0, 4), (0, 0, 0))), id="a dark colour"),
        pytest.param(Image.fromarray(half((0, 0, 0, 255), (0, 0, 0, 0))), id="a cut-out, black"),
        pytest.param(Image.fromarray(half((90, 80, 70, 200), (90, 80, 70, 100))), id="a cut-out with a soft edge"),
        pytest.param(Image.fromarray(half((255, 255, 255, 255), (0, 0, 0, 255))), id="opaque all over"),
        pytest.param(painted(), id="a palette"),
        pytest.param(Image.fromarray(half(255)).convert("1"), id="one bit"),
        pytest.param(Image.fromarray(half(255)).convert("LA"), id="grey and opaque"),
    ],
)
def test_a_mask_in_any_form_has_two_levels(picture: Image.Image, tmp_path: Path) -> None:
    picture.save(tmp_path / "cam00.png")
    plane, _, fault = decode_image_file(tmp_path / "cam00.png", "masks/cam00.png", "mask")
    assert plane is not None, fault
    np.testing.assert_array_equal(read_masks({"cam00": plane})["cam00"].share, half(255))


@pytest.mark.parametrize("ending", [".bmp", ".ppm", ".pnm"])
def test_uncompressed_pictures_come_out_as_they_are(ending: str, tmp_path: Path) -> None:
    picture = np.random.default_rng(3).integers(0, 256, (12, 17, 3), dtype=np.uint8)
    kept = Image.fromarray(picture)
    kept.save(tmp_path / f"a{ending}", format="PPM" if ending == ".pnm" else None)
    assert is_picture(tmp_path / f"a{ending}")
    assert picture_size(tmp_path / f"a{ending}") == (17, 12)
    assert open_picture(tmp_path / f"a{ending}").size == (17, 12)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{ending}"), picture)


@pytest.mark.parametrize("bits", [1, 4, 7, 10, 12, 14, 16])
def test_the_header_of_a_netpbm_map_says_which_value_is_white(bits: int, tmp_path: Path) -> None:
    white = (1 << bits) - 1
    grey = np.linspace(0, white, 48 * 16).round().reshape(16, 48)
    data = grey.astype(np.uint8 if white < 256 else ">u2").tobytes()
    (tmp_path / "a.pgm").write_bytes(b"P5 # of a machine's camera\n48 16\n%d\n" % white + data)
    pixels = read_image(tmp_path / "a.pgm")
    assert (pixels.min(), pixels.max()) == (0, 255)
    # of 16 bits the lower eight are cut off, of others the nearest level is taken
    np.testing.assert_allclose(pixels[..., 0], grey * 255 / white, atol=1.0 if bits == 16 else 0.5001)
    found, _, fault = decode_image_file(tmp_path / "a.pgm", "a.pgm", "grey")
    assert not fault
    np.testing.assert_array_equal(found, pixels[..., 0])
    masked, _, fault = decode_image_file(tmp_path / "a.pgm", "masks/a.pgm", "mask")
    assert not fault
    assert masked is not None
    assert masked.min() < masked.max()  # in the file's own numbers


@pytest.mark.parametrize("header", [b"P5\n48 16\n0\n", b"P5\n48 16\n70000\n", b"P6\n48 16\n4095\n", b"P5\n48", b"BM"])
def test_a_damaged_map_is_a_fault(header: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.ppm").write_bytes(header + bytes(20))
    pixels, _, fault = decode_image_file(tmp_path / "a.ppm", "images/a.ppm", "colour")
    assert pixels is None
    assert str(fault).startswith(("images/a.ppm: the file is damaged", "images/a.ppm: the picture is damaged"))


def test_folders_pipes_and_links_to_nothing_are_no_pictures(tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "link.png").symlink_to(tmp_path / "nowhere.png")
    (tmp_path / ".hidden.png").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "cam00.PNG").touch()
    assert [path.name for path in tmp_path.iterdir() if is_picture(path)] == ["cam00.PNG"]


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")  # what Pillow says of the broken TIFF
@pytest.mark.parametrize("name", ["a.dng", "a.cr3", "a.heic", "a.png", "a.tif"])
@pytest.mark.parametrize("content", [b"", b"nothing of the kind", b"II*\0\xff\xff\xff\x7f"])
def test_damage_is_a_fault(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    pixels, _, fault = decode_image_file(tmp_path / name, f"images/{name}", "colour")
    assert pixels is None
    assert str(fault).startswith(f"images/{name}: the file is damaged")
    with pytest.raises(InputError, match="is damaged"):
        picture_size(tmp_path / name)


@pytest.mark.parametrize(("name", "whole"), [("a.heic", HEIC.read_bytes()), ("a.dng", dng(np.zeros((64, 64))))])
def test_half_a_file_is_a_fault(name: str, whole: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    pixels, _, fault = decode_image_file(tmp_path / name, name, "colour")
    assert pixels is None
    assert "is damaged" in str(fault)
