"""Parallax of views: closed forms."""

import numpy as np
import pytest

from pipeline.multiview.triangulation import USUAL, depth_factor, parallax

VIEW, VALUE = np.array([[0, 1]]), np.ones((1, 2))


def of_two(angle_deg: float, normal: tuple[float, float, float]) -> float:
    """The parallax of two cameras at 500 mm, ``angle_deg`` apart, that look at the origin."""
    half = np.radians(angle_deg) / 2.0
    centres = 500.0 * np.array([[np.sin(half), 0.0, np.cos(half)], [-np.sin(half), 0.0, np.cos(half)]])
    return float(parallax(np.zeros((1, 3)), np.array([normal]), centres, VIEW, VALUE)[0])


@pytest.mark.parametrize("angle_deg", [5.0, 25.0, 60.0])
def test_two_cameras_shift_by_twice_the_sine_of_half_their_angle(angle_deg: float) -> None:
    """Half of the draws take one camera twice."""
    for normal in ((0.0, 0.0, 1.0), (0.0, 0.6, 0.8)):  # also a surface that is turned about the base line
        assert of_two(angle_deg, normal) == pytest.approx(np.sqrt(0.5) * 2.0 * np.sin(np.radians(angle_deg) / 2.0))


def test_a_view_that_compares_nothing_has_no_parallax() -> None:
    centres = np.array([[100.0, 0.0, 500.0], [0.0, 0.0, 500.0]])
    alone = parallax(
        np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), centres, np.array([[0, -1]]), np.array([[1.0, 0.0]])
    )
    np.testing.assert_allclose(alone, 0.0)


def test_depth_is_less_sure_by_the_ratio_of_the_parallaxes() -> None:
    np.testing.assert_allclose(depth_factor(np.array([USUAL, USUAL / 3.0, 2.0 * USUAL])), [1.0, 3.0, 1.0])
