"""Grey pictures, and plates that can be compared with them."""

import numpy as np
import pytest

from rig.image import is_grey, plates_for

COLOUR = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
GREY = np.repeat(COLOUR[..., :1], 3, axis=2)


def test_one_pixel_of_colour_is_enough() -> None:
    assert is_grey(GREY)
    speck = GREY.copy()
    speck[7, 9, 0] ^= 1
    assert not is_grey(speck)


def test_plates_become_grey_where_the_picture_is() -> None:
    (plate,) = plates_for(GREY, [COLOUR])
    assert is_grey(plate)
    assert plate[3, 4, 0] == pytest.approx(COLOUR[3, 4] @ np.array([0.299, 0.587, 0.114]), abs=0.51)
    assert plates_for(COLOUR, [COLOUR])[0] is COLOUR
    assert plates_for(GREY, [GREY])[0] is GREY
    assert plates_for(GREY, []) == ()
