"""Foreign lenses: OpenCV projects as they do, pictures and points are undistorted alike, files keep them."""

import cv2
import numpy as np
import pytest

from rig.recorded_lens import LensModel, RecordedLens

MATRIX = np.array([[300.0, 0, 255.3], [0, 305.0, 190.1], [0, 0, 1]])
LENSES = [
    RecordedLens("kannala-brandt", (-0.03, 0.011, -0.004, 0.0007)),
    RecordedLens("rational", (0.12, -0.05, 1e-3, -8e-4, 0.01, 0.31, 0.02, 0.003)),
    RecordedLens("rational", (0.12, -0.05, 1e-3, -8e-4, 0.01, 0.0, 0.0, 0.0), skew=-0.01),
]
PIXELS = np.random.default_rng(3).uniform([20, 20], [490, 360], (50, 2))


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_points_go_there_and_back(lens: RecordedLens) -> None:
    there = lens.distorted(PIXELS, MATRIX)
    assert np.abs(there - PIXELS).max() > 1.0
    np.testing.assert_allclose(lens.undistorted(there, MATRIX), PIXELS, atol=1e-7)


def test_kannala_and_brandt_bend_by_the_angle() -> None:
    lens = LENSES[0]
    normalised = (PIXELS - MATRIX[:2, 2]) / (300.0, 305.0)
    radius = np.linalg.norm(normalised, axis=1)
    theta = np.arctan(radius)
    k1, k2, k3, k4 = lens.coefficients
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    wanted = normalised * (bent / radius)[:, None] * (300.0, 305.0) + MATRIX[:2, 2]
    np.testing.assert_allclose(lens.distorted(PIXELS, MATRIX), wanted, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_a_dot_is_where_the_pinhole_sees_it(lens: RecordedLens) -> None:
    wanted = np.array([[330.0, 120.0]])
    at = lens.distorted(wanted, MATRIX)[0]
    rows, columns = np.mgrid[:384, :512]
    picture = (255 * np.exp(-((columns - at[0]) ** 2 + (rows - at[1]) ** 2) / 18)).astype(np.uint8)
    seen = lens.undistort(picture, MATRIX).astype(float)
    centre = [(seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()]
    np.testing.assert_allclose(centre, wanted[0], atol=0.15)  # the blob itself is stretched a little


@pytest.mark.parametrize(("model", "count"), [("kannala-brandt", 4), ("rational", 8)])
def test_masks_stay_two_valued(model: LensModel, count: int) -> None:
    mask = np.zeros((384, 512), np.uint8)
    cv2.circle(mask, (250, 200), 90, 255, -1)
    seen = RecordedLens(model, (0.05,) + (0.0,) * (count - 1)).undistort(mask, MATRIX, smooth=False)
    assert set(np.unique(seen)) == {0, 255}
