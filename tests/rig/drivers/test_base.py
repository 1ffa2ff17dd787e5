"""What all drivers share."""

import numpy as np
import pytest

from rig.drivers.base import upright


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_upright_turns_clockwise(rotation_deg: int) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[0, 0] = 255  # top left; a quarter turn clockwise takes it to the top right
    turned = upright(image, rotation_deg)
    corner = {0: (0, 0), 90: (0, -1), 180: (-1, -1), 270: (-1, 0)}[rotation_deg]
    assert turned[corner].tolist() == [255] * 3
    assert turned.shape == ((4, 6, 3) if rotation_deg % 180 == 0 else (6, 4, 3))
