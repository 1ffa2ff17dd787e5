import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.imaging.masks import BAND_PX, distance_to_level
from pipeline.imaging.silhouette import signed_distance


def grid(size: int = 160) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:size, :size].astype(np.float64)
    return x, y


@given(st.floats(70, 90), st.floats(70, 90), st.floats(20, 55))
def test_a_circle_is_met_to_hundredths_of_a_pixel(cx: float, cy: float, radius: float) -> None:
    x, y = grid()
    truth = np.hypot(x - cx, y - cy) - radius
    found = distance_to_level(np.clip(0.5 - truth / 4, 0, 1).astype(np.float32))
    near = np.abs(truth) < BAND_PX / 2
    # The chord of a pixel's arc lies 1 / (8 r) = 0.006 px inside; the ramp's linear interpolation is as good.
    assert np.abs(found - truth)[near].max() < 0.05
    far = np.abs(truth) >= BAND_PX
    assert (np.abs(found - truth)[far] < 0.75 + 0.03 * np.abs(truth[far])).all()


def test_a_slanted_edge_has_no_bias() -> None:
    x, y = grid()
    truth = (x - 80.3) * np.cos(0.4) + (y - 79.1) * np.sin(0.4)
    found = distance_to_level(np.clip(0.5 - truth / 3, 0, 1).astype(np.float32))
    near = (np.abs(truth) < 6) & (x > 20) & (x < 140) & (y > 20) & (y < 140)
    assert abs((found - truth)[near].mean()) < 1e-4
    assert np.abs(found - truth)[near].max() < 0.05  # where the propagation took the second nearest piece


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_without_a_contour_everything_is_farther_than_any_pixel_and_has_slopes(value: float) -> None:
    far = -90.0 if value else 90.0
    field = np.full((40, 50), value, np.float32)
    np.testing.assert_array_equal(distance_to_level(field), far)
    np.testing.assert_array_equal(signed_distance(field > 0.5), far)


def test_the_sign_is_the_level_even_where_corners_touch() -> None:
    field = np.zeros((12, 12), np.float32)
    field[3:6, 3:6] = field[6:9, 6:9] = 1.0
    found = distance_to_level(field)
    np.testing.assert_array_equal(found < 0, field > 0.5)
    assert np.abs(found[4, 4] + 1.5) < 1e-6
