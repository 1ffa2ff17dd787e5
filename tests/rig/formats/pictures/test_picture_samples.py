"""How samples are held: bits that files of 16 use, and mosaics; rims that undistortion leaves."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.picture_samples import empty_rim, fill_rims, is_mosaic, measure_samples, used_bits
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


SHAPE = 96, 128


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (*SHAPE, 3), dtype=np.uint8)


def outside_lens() -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return ((columns - 63.5) / 66.0) ** 4 + ((rows - 47.5) / 50.0) ** 4 > 1.0


@pytest.mark.parametrize("value", [0, 255])
def test_a_rim_that_the_plate_has_not_is_filled_with_the_plate(value: int) -> None:
    plate, rim = noise(1), outside_lens()
    image = np.where(rim[..., None], value, noise(0)).astype(np.uint8)
    images, plates, remarks = fill_rims({"cam00": image}, {"cam00": [plate]}, ())
    assert (images["cam00"][rim] == plate[rim]).all()
    inside = cv2.erode((~rim).astype(np.uint8), np.ones((9, 9), np.uint8)).view(bool)
    assert (images["cam00"][inside] == image[inside]).all()
    assert plates["cam00"][0] is plate
    assert [(remark.code, remark.parameters["count"]) for remark in remarks] == [("rims-empty", 1)]


def test_a_rim_of_the_plate_alone_is_filled_with_the_picture() -> None:
    image, rim = noise(0), outside_lens()
    plate = np.where(rim[..., None], 0, noise(1)).astype(np.uint8)
    images, plates, remarks = fill_rims({"cam00": image}, {"cam00": [plate]}, ())
    assert images["cam00"] is image
    assert (plates["cam00"][0][rim] == image[rim]).all()
    assert len(remarks) == 1


@pytest.mark.parametrize("value", [0, 2, 255])
def test_a_picture_that_is_dark_or_burnt_out_is_no_rim(value: int) -> None:
    """It would show its clean plate, or the clean plate would show the subject."""
    blank = np.full((*SHAPE, 3), value, np.uint8)
    for image, plate in ((blank, noise(1)), (noise(0), blank)):
        images, plates, remarks = fill_rims({"cam00": image}, {"cam00": [plate]}, ())
        assert (images["cam00"] is image, plates["cam00"][0] is plate, remarks) == (True, True, [])


def test_pictures_that_need_nothing_stay_the_same_objects() -> None:
    rim = outside_lens()[..., None]
    clothes = noise(3)
    clothes[60:] = 0  # reach three sides of the picture
    cases = {
        "cam00": (noise(0), noise(1)),
        "cam01": (np.where(rim, 0, noise(2)).astype(np.uint8), np.where(rim, 0, noise(1)).astype(np.uint8)),
        "cam02": (clothes, noise(4)),
        "cam03": (np.where(rim, 0, noise(5)).astype(np.uint8), noise(6)),  # has a mask
    }
    taken = {name: image for name, (image, _) in cases.items()}
    images, plates, remarks = fill_rims(taken, {name: [plate] for name, (_, plate) in cases.items()}, ["cam03"])
    assert not remarks
    assert all(images[name] is taken[name] and plates[name][0] is cases[name][1] for name in cases)
    assert empty_rim(clothes) is None
