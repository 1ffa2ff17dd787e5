"""Photographs without their shading: closed forms."""

import numpy as np

from pipeline.photometric_fit.images import remove_shading

SIGMA_PX = 3.0
INSIDE = np.zeros((120, 160), bool)
INSIDE[20:100, 30:140] = True
MIDDLE = (slice(40, 80), slice(50, 120))


def waves(length_px: float) -> np.ndarray:
    return np.tile(20.0 * np.sin(2.0 * np.pi * np.arange(160) / length_px), (120, 1)).astype(np.float32)


def test_slow_shading_goes_and_fine_texture_stays() -> None:
    """A Gaussian of 3 px keeps exp(-2 pi^2 (3 / L)^2) of a wave of L px."""
    for length_px in (6.0, 60.0):
        left = remove_shading(100.0 + waves(length_px), INSIDE, SIGMA_PX)[MIDDLE]
        kept = 1.0 - np.exp(-2.0 * (np.pi * SIGMA_PX / length_px) ** 2)
        np.testing.assert_allclose(left, kept * waves(length_px)[MIDDLE], atol=0.15)


def test_a_bright_wall_behind_the_head_leaves_no_trace_and_no_subject_no_texture() -> None:
    dark, bright = (np.where(INSIDE, 100.0 + waves(6.0), wall).astype(np.float32) for wall in (0.0, 250.0))
    np.testing.assert_array_equal(remove_shading(dark, INSIDE, SIGMA_PX), remove_shading(bright, INSIDE, SIGMA_PX))
    assert not remove_shading(waves(6.0), np.zeros_like(INSIDE), SIGMA_PX).any()
