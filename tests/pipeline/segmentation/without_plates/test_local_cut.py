"""A disc before a cloth with folds, from a mask that is too wide."""

import cv2
import numpy as np
import pytest

from pipeline.segmentation.without_plates.decide import BANDS, cut_along


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Image and true mask: a disc of radius 90 and its shading, before a cloth of 9 levels' scatter."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:300, :400]
    mask = np.hypot(column - 200, row - 150) < 90
    cloth = 85 + 100 * cv2.GaussianBlur(rng.normal(size=(300, 400)), (0, 0), 3)
    subject = 170 - 30 * (np.hypot(column - 200, row - 150) / 90) ** 2
    image = np.where(mask, subject, cloth)[:, :, None] * np.array([1.0, 0.95, 0.9]) + rng.normal(0, 4, (300, 400, 3))
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8), 0, 255).astype(np.uint8), mask


@pytest.mark.parametrize("grown", [-3, 5, 10])
def test_the_edge_is_found_from_a_mask_that_is_off(grown: int) -> None:
    image, truth = scene()
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(grown) + 1,) * 2)
    wide = (cv2.dilate if grown > 0 else cv2.erode)(truth.astype(np.uint8), disc).view(bool)
    found = wide
    for bands in BANDS:
        found = cut_along(image, found, bands) > 0.5
    # One pixel all around is 2 * pi * 90 of 25,447 pixels, 2.2 %.
    assert np.count_nonzero(found ^ truth) < 0.022 * truth.sum()
    assert np.count_nonzero(found ^ truth) < 0.5 * np.count_nonzero(wide ^ truth)
