"""What tests plant: wrong contours, and cameras that are off."""

import numpy as np
import pytest

from rig.studio.scene.layout import default_layout
from tests.support.spoilt_captures import WRONG_RADII_PX, WRONG_SHARE, spoiled
from tests.support.subjects import off_by, stated


def test_a_fifth_of_the_contour_is_wrong() -> None:
    rows, columns = np.ogrid[:300, :400]
    mask = (rows - 150) ** 2 + (columns - 200) ** 2 < 100**2
    wrong = spoiled(mask, np.random.default_rng(1))
    edge = 2 * np.pi * 100
    changed = np.argwhere(wrong != mask)
    angle = np.arctan2(changed[:, 0] - 150, changed[:, 1] - 200)
    share = len(np.unique((angle / (2 * np.pi) * 400).astype(int))) / 400
    assert WRONG_SHARE - 0.02 < share < WRONG_SHARE + 2 * WRONG_RADII_PX[1] / edge + 0.02
    assert (wrong & ~mask).any()
    assert (mask & ~wrong).any()


def test_cameras_are_off_by_what_was_asked() -> None:
    """Mean square motion of points on a sphere of 100 mm radius, in squares of what was asked: along each image axis 1
    of tilt and slide, and 1/3 each of roll and range."""
    rig, rng = default_layout(), np.random.default_rng(3)
    directions = rng.standard_normal((200, 3))
    points = rig.centre_world() + 100.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    squares = []
    for _ in range(30):
        off = off_by(rig, 0.5, rng)
        squares += [((off[c.name].project(points) - c.project(points)) ** 2).sum(axis=1).mean() for c in rig]
    # 330 cameras with about three numbers each that dominate: a standard error of 4 % in squares.
    assert np.mean(squares) == pytest.approx(0.5**2 * 2 * (1 + 1 / 3 + 1 / 3), rel=0.16)
    assert all(camera.covariance is not None for camera in stated(rig, 0.5))
