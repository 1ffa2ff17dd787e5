"""Eqs. (4) and (5) and the signed distance, on shapes whose answers are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from pipeline.imaging.silhouette import boundary_weighted_xor, boundary_weights, signed_distance, silhouette_from_mask

ROWS, COLUMNS = np.mgrid[:96, :128].astype(float)


def disc(radius: float, row: float = 47.3, column: float = 63.6) -> np.ndarray:
    return np.hypot(ROWS - row, COLUMNS - column) < radius


masks = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).random((12, 15)) < 0.4)


def test_the_distance_to_a_disc_is_radius_minus_range() -> None:
    mask = disc(30.0)
    expected = np.hypot(ROWS - 47.3, COLUMNS - 63.6) - 30.0
    error = signed_distance(mask) - expected
    # Anywhere: to the nearest pixel centre, less half a pixel, which is half a diagonal off at worst.
    assert np.abs(error).max() < 0.5 * np.sqrt(2) + 0.01
    near = np.abs(expected) < 0.7  # what decides the contour; the staircase alone would leave 1 / sqrt(12) = 0.29 px
    assert abs(error[near].mean()) < 0.05
    assert error[near].std() < 0.6 * 12**-0.5  # measured 0.13 to 0.17 px on discs of 23 to 40 px
    assert silhouette_from_mask(mask).distance.dtype == np.float32


def test_a_straight_contour_runs_half_way_between_pixels() -> None:
    distance = signed_distance(COLUMNS < 40)
    # Along the grid a pixel's own square adds nothing to the blur: distances near the edge come out 1.083 times larger.
    np.testing.assert_allclose(distance, COLUMNS - 39.5, rtol=np.hypot(1.0, 12**-0.5) * 1.05 - 1.0)
    assert (np.sign(distance) == np.sign(COLUMNS - 39.5)).all()


@settings(max_examples=30)
@given(mask=masks)
def test_the_weights_are_eq_5_with_exact_distances(mask: np.ndarray) -> None:
    if mask.all() or not mask.any():
        return
    d = np.asarray(distance_transform_edt(mask)) + np.asarray(distance_transform_edt(~mask))
    np.testing.assert_allclose(boundary_weights(mask), 1.0 / d**2, rtol=1e-5)


@settings(max_examples=30)
@given(a=masks, b=masks)
def test_costs_are_symmetric_in_what_differs_and_zero_for_equals(a: np.ndarray, b: np.ndarray) -> None:
    weights = boundary_weights(a)
    assert boundary_weighted_xor(a, a, weights) == 0.0
    assert boundary_weighted_xor(a, b, weights) == pytest.approx(weights[a != b].sum(), rel=1e-5)


def test_a_disc_too_small_costs_the_ring_between_and_far_mismatch_hardly_counts() -> None:
    # Sum of 1 / d^2 over rings 1 .. 5 px inside a circle of 30 px: 2 pi (30 - d + 1/2) / d^2, 7 % off by pixels.
    observed = disc(30.0)
    expected = sum(2 * np.pi * (30.5 - d) / d**2 for d in range(1, 6))
    cost = boundary_weighted_xor(observed, disc(25.0), boundary_weights(observed))
    assert cost == pytest.approx(expected, rel=0.15)
    observed = disc(40.0)
    weights = boundary_weights(observed)
    hole = observed & ~disc(10.0)
    notch = observed & ~disc(10.0, column=100.0)
    assert boundary_weighted_xor(observed, hole, weights) < 0.02 * boundary_weighted_xor(observed, notch, weights)


@pytest.mark.parametrize("shape", [(121, 131), (100, 111)])
def test_distances_are_the_same_to_the_last_bit_wherever_the_mask_lies_in_memory(shape: tuple[int, int]) -> None:
    """OpenCV's own differed in up to 191 of these pixels, from every second call on: report.json differed by it."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    mask = np.hypot((rows - shape[0] / 2) / 1.3, columns - shape[1] / 2.2) < 30.0
    wanted = np.asarray(distance_transform_edt(mask)) + np.asarray(distance_transform_edt(~mask))
    held = []
    for _ in range(60):
        held.append(np.empty(rng.integers(100, 60_000), np.uint8))
        placed = mask.copy()
        held.append(placed)
        weights = boundary_weights(placed)
        np.testing.assert_array_equal(weights, (1.0 / wanted.astype(np.float32) ** 2).astype(np.float32))
        held.append(weights)
