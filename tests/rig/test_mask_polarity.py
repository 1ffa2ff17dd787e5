"""Which level of a mask is the subject: heads that touch the bottom, cameras on their side, close-ups."""

import numpy as np
import pytest

from rig.formats.pictures.mask_values import inverted_masks, subject_convention

ROWS, COLUMNS = np.indices((240, 320))
HEAD = ((COLUMNS - 160) / 60.0) ** 2 + ((ROWS - 110) / 75.0) ** 2 < 1.0
BUST = HEAD | ((ROWS > 170) & (np.abs(COLUMNS - 160) < 150))  # wide shoulders, to the bottom and half up the sides
CLOSE_UP = np.hypot(COLUMNS - 160, ROWS - 150) < 175  # three borders and more


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("subject", [HEAD, BUST], ids=["head", "bust"])
def test_the_borders_are_background(subject: np.ndarray, turns: int) -> None:
    assert subject_convention(np.rot90(subject, turns)) == "white"
    assert subject_convention(np.rot90(~subject, turns)) == "black"


def test_single_masks_may_be_inverted_and_a_close_up_follows_the_others() -> None:
    masks = {"a": BUST, "b": ~BUST, "c": HEAD, "d": CLOSE_UP}
    assert inverted_masks(masks, {}) == ["b"]
    assert subject_convention(CLOSE_UP) is None
    middle = np.array([160.0, 120.0])
    assert inverted_masks({"a": CLOSE_UP}, {"a": middle}) == []
    masks = {"a": ~BUST, "b": ~HEAD, "c": ~CLOSE_UP}
    assert inverted_masks(masks, dict.fromkeys(masks, middle)) == ["a", "b", "c"]
