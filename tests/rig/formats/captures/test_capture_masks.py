"""Masks of a capture, as its reader takes them: inverted ones turned and told, soft ones kept, faults said once."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture, write_capture
from tests.support.small_captures import HEIGHT, WIDTH, picture, small_rig

ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
BUST = (np.hypot(COLUMNS - 32, ROWS - 22) < 10) | ((ROWS > 32) & (np.abs(COLUMNS - 32) < 22))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = {name: picture() for name in "abc"}
    write_capture(tmp_path, Capture(images, masks=dict.fromkeys("abc", BUST)), small_rig())
    return tmp_path


def write(folder: Path, name: str, pixels: np.ndarray) -> None:
    cv2.imwrite(str(folder / "masks" / f"{name}.png"), pixels)


@pytest.mark.parametrize(("names", "words"), [("abc", "all masks are inverted"), ("b", "masks/b.png is inverted")])
def test_inverted_masks_are_turned_and_told(folder: Path, names: str, words: str) -> None:
    for name in names:
        write(folder, name, np.where(BUST, 0, 255).astype(np.uint8))
    capture, _ = read_capture(folder)
    for name in "abc":
        np.testing.assert_array_equal(capture.masks[name], BUST)
    (remark,) = capture.remarks
    assert remark.code == "mask-inverted"
    assert words in remark.text


def test_soft_masks_keep_their_greys_and_are_written_with_them(folder: Path, tmp_path: Path) -> None:
    soft = cv2.GaussianBlur(BUST.astype(np.uint8) * np.uint8(255), (0, 0), 0.8)
    write(folder, "a", 255 - soft)
    capture, rig = read_capture(folder)
    assert set(capture.soft_masks) == {"a"}
    np.testing.assert_allclose(capture.soft_masks["a"].astype(float), soft, atol=2)
    write_capture(tmp_path / "again", capture, rig)
    again, _ = read_capture(tmp_path / "again")
    np.testing.assert_array_equal(again.masks["a"], capture.masks["a"])


def test_specks_apart_from_the_subject_are_taken_away_and_told(folder: Path) -> None:
    specked = BUST.astype(np.uint8) * np.uint8(255)
    specked[3:7, 2:5] = 255
    specked[5, 3] = 0  # a hole in a speck goes with it
    specked[20, 60] = 255
    write(folder, "b", specked)
    capture, _ = read_capture(folder)
    np.testing.assert_array_equal(capture.masks["b"], BUST)
    (remark,) = capture.remarks
    assert remark.code == "mask-specks"
    assert remark.text.startswith("masks/b.png: small pieces apart from the subject")


def test_a_head_above_a_collar_that_cuts_it_off_stays(folder: Path) -> None:
    parted = BUST & ((ROWS < 28) | (ROWS > 33))
    write(folder, "b", parted.astype(np.uint8) * np.uint8(255))
    capture, _ = read_capture(folder)
    np.testing.assert_array_equal(capture.masks["b"], parted)
    assert capture.remarks == ()


def test_what_is_true_of_all_masks_is_said_once(folder: Path) -> None:
    for name in "abc":
        write(folder, name, np.where(BUST, 1 + ROWS // 12, 0).astype(np.uint8))
    with pytest.raises(InputError) as refused:
        read_capture(folder)
    (fault,) = refused.value.faults
    assert fault.text.startswith("masks/a.png holds areas of 4 values")
    assert fault.text.endswith("the same is true of 2 more (b, c)")
