"""Holes of a mask."""

import numpy as np

from pipeline.imaging.masks import without_holes


def test_what_is_enclosed_is_filled_and_what_reaches_the_border_is_not() -> None:
    mask = np.zeros((12, 14), bool)
    mask[2:10, 2:10] = True
    mask[4:6, 4:6] = False  # enclosed
    mask[7, 7:14] = False  # a notch
    mask[10:, 5:7] = True  # the subject leaves the picture
    filled = without_holes(mask)
    assert filled[4:6, 4:6].all()
    assert not filled[7, 7:].any()
    assert (filled & ~mask).sum() == 4
    assert not mask[4:6, 4:6].any()

    corners = without_holes(~np.eye(6, dtype=bool))  # gaps that touch at their corners alone
    assert (corners[2, 2], corners[0, 0], corners[5, 5]) == (True, False, False)
    assert without_holes(np.ones((3, 4), bool)).all()
    assert not without_holes(np.zeros((3, 4), bool)).any()
