"""Crops of a picture: planted coordinates come back, whatever the scale, the roll and the mirror."""

import numpy as np
import pytest

from pipeline.faces.detection import Crop, in_picture, make_pyramid


def coordinates(width: int, height: int) -> np.ndarray:
    """A picture whose red says x and whose green says y, of 255 parts of its size."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([x * 255.0 / (width - 1), y * 255.0 / (height - 1), 0.0 * x], axis=2).round().astype(np.uint8)


@pytest.mark.parametrize("size", [(640, 480), (1023, 767), (200, 333)])
@pytest.mark.parametrize("side", [40.0, 150.0, 190.0])
@pytest.mark.parametrize(("roll", "mirrored"), [(0.0, False), (35.0, False), (90.0, True), (-130.0, True)])
def test_a_crop_shows_what_lies_there(size: tuple[int, int], side: float, roll: float, mirrored: bool) -> None:
    width, height = size
    side *= max(size) / 640.0
    crop = Crop(np.array([0.52 * width, 0.47 * height]), side, roll, mirrored)
    shown = make_pyramid(coordinates(width, height)).sample(crop, 48).astype(float)
    columns, rows = np.meshgrid(np.arange(48), np.arange(48))
    pixels = in_picture(np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float), crop.picture_from_crop(48))
    expected = pixels / (width - 1, height - 1) * 255.0
    inside = ((expected > 2.0) & (expected < 253.0)).all(axis=1)
    assert inside.mean() > 0.9
    # Rounding to whole values when the picture is made, halved and sampled: half a value each.
    assert np.abs(shown.reshape(-1, 3)[inside, :2] - expected[inside]).max() < 2.0


def test_a_coarse_crop_is_a_mean_and_what_lies_outside_is_black() -> None:
    checks = (np.add.outer(np.arange(1024), np.arange(1024)) % 2 * 255).astype(np.uint8)
    crop = Crop(np.array([511.5, 511.5]), 800.0, 10.0)
    shown = make_pyramid(np.repeat(checks[..., None], 3, axis=2)).sample(crop, 64)
    assert np.abs(shown.astype(float) - 127.5).max() < 2.0  # single pixels would be 0 and 255
    white = np.full((100, 100, 3), 255, np.uint8)
    shown = make_pyramid(white).sample(Crop(np.array([0.0, 50.0]), 50.0, 0.0), 50)
    assert shown[:, :20].max() == 0
    assert shown[:, 30:].min() == 255
