"""Rims that undistortion leaves, planted in pictures of noise."""

import cv2
import numpy as np
import pytest

from rig.formats.pictures.picture_samples import empty_rim, fill_rims

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
