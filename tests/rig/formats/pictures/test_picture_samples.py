"""How samples are held: bits that files of 16 use, and mosaics."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.picture_samples import is_mosaic, measure_samples, used_bits
from tests.support.small_captures import small_rig

PICTURE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 2)


def mosaic(rgb: np.ndarray) -> np.ndarray:
    found = rgb[..., 1].copy()
    found[0::2, 0::2], found[1::2, 1::2] = rgb[0::2, 0::2, 2], rgb[1::2, 1::2, 0]
    return found


@pytest.mark.parametrize(("largest", "bits"), [(255, 8), (1023, 10), (1024, 12), (4095, 12), (16383, 14), (16384, 16)])
def test_the_largest_sample_tells_the_bits(largest: int, bits: int) -> None:
    assert used_bits(largest) == bits


def test_bits_are_those_of_all_files_together(tmp_path: Path) -> None:
    for name, shift in (("dark.png", 1), ("light.tif", 4)):
        cv2.imwrite(str(tmp_path / name), PICTURE.astype(np.uint16) << shift)
    files = sorted(tmp_path.iterdir())
    assert measure_samples(files[:1]).bits == 10
    assert measure_samples(files).bits == 12
    cv2.imwrite(str(tmp_path / "eight.png"), PICTURE)
    assert measure_samples([tmp_path / "eight.png"]).bits is None
    (tmp_path / "cut.png").write_bytes((tmp_path / "dark.png").read_bytes()[:60])
    assert measure_samples([tmp_path / "cut.png"]).bits is None


def test_a_mosaic_is_told_from_a_grey_picture() -> None:
    coloured = (PICTURE * np.array([0.4, 0.7, 1.0])).astype(np.uint8)
    assert is_mosaic(mosaic(coloured))
    assert not is_mosaic(cv2.cvtColor(PICTURE, cv2.COLOR_BGR2GRAY))
    assert not is_mosaic(np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8))
    assert not is_mosaic(np.full((48, 64), 90, np.uint8))


def test_grey_pictures_among_others_are_named(tmp_path: Path) -> None:
    capture = Capture(dict.fromkeys("abc", PICTURE), dict.fromkeys("abc", (PICTURE,)))
    write_capture(tmp_path, capture, small_rig())
    cv2.imwrite(str(tmp_path / "images" / "b.png"), cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY))
    (remark,) = read_capture(tmp_path)[0].remarks
    assert remark.code == "pictures-grey"
    assert "pictures of b are grey" in remark.text
    for name in "ac":
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY))
    assert read_capture(tmp_path)[0].remarks == ()


@pytest.mark.parametrize("shift", [2, 4])
def test_a_capture_of_10_or_12_bits_in_16_is_read_as_one_of_8(tmp_path: Path, shift: int) -> None:
    write_capture(tmp_path, Capture(dict.fromkeys("abc", PICTURE), dict.fromkeys("abc", (PICTURE,))), small_rig())
    plain, _ = read_capture(tmp_path)
    assert plain.remarks == ()
    for path in tmp_path.rglob("*.png"):
        pixels = cv2.imread(str(path))
        assert pixels is not None
        cv2.imwrite(str(path), pixels.astype(np.uint16) << shift)
    again, _ = read_capture(tmp_path)
    for name in "abc":
        np.testing.assert_array_equal(again.images[name], plain.images[name])
        np.testing.assert_array_equal(again.backgrounds[name][0], plain.backgrounds[name][0])
    (remark,) = again.remarks
    assert remark.code == "picture-levels"
    assert f"is above {2 ** (8 + shift) - 1} of 65535" in remark.text
