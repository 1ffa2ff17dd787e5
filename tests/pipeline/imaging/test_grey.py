"""Noise of photographs: measured, and what a blur leaves of it."""

import cv2
import numpy as np
import pytest

from pipeline.imaging.grey import blur_growth, estimate_noise, noise_left


@pytest.mark.parametrize("sigma_px", [0.5, 0.7, 0.84, 1.2])
def test_noise_left_by_a_blur(sigma_px: float) -> None:
    noise = np.random.default_rng(0).normal(0.0, 4.0, (400, 500)).astype(np.float32)
    left = float(cv2.GaussianBlur(noise, (0, 0), sigma_px).std())
    assert noise_left(4.0, sigma_px) == pytest.approx(left, rel=0.02)


@pytest.mark.parametrize("levels", [1.0, 3.0, 6.0])
def test_noise_level_on_a_ramp_with_edges(levels: float) -> None:
    image = np.add.outer(np.linspace(40, 90, 300), np.linspace(0, 80, 400)).astype(np.float32)
    image[100:200, 150:250] += 60.0
    image += np.random.default_rng(1).normal(0.0, levels, image.shape).astype(np.float32)
    assert estimate_noise(image) == pytest.approx(levels, rel=0.05)


def test_quiet_photographs_are_blurred_as_ever() -> None:
    assert blur_growth(0.9) == 1.0
    assert 1.5 < blur_growth(4.4) < 1.8
