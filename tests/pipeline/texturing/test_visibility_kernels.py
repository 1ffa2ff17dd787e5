"""The compiled weights and colours of a view against NumPy and SciPy, where they change and where they end."""

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from pipeline.texturing.view_selection_kernels import POOR, SLOPE_SLACK, WINDOW, sample_colours, visibility_weights
from pipeline.texturing.visibility import unclipped
from rig.colour_space import linear_from_srgb

LIMITS = (1.5, 3.0, 0.35, 4.0)  # margin px, hidden mm, least facing, sharpness
PIXEL_ANGLE = 1 / 1500


def expected_weights(
    pixels: np.ndarray, depths: np.ndarray, facing: np.ndarray, depth: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """The definition, for all points at once."""
    margin, hidden, least, sharpness = LIMITS
    height, width = depth.shape
    x, y = pixels.T
    inside = (x >= 1) & (y >= 1) & (x < width - 2) & (y < height - 2) & (facing > 0.02)
    column, row = np.where(inside, np.floor(x + 0.5), 0).astype(int), np.where(inside, np.floor(y + 0.5), 0).astype(int)
    near = {reach: minimum_filter(depth, 2 * reach + 1, mode="constant", cval=np.inf) for reach in (1, WINDOW)}
    clear = -distance[row, column] - margin
    cosine = np.where(inside, facing, 1.0)
    step = PIXEL_ANGLE * depths * np.minimum(np.tan(np.arccos(np.minimum(1.0, cosine))), 4.0)
    seen = inside & (clear > 0) & (depths <= depth[row, column] + hidden + 0.5 * step)
    seen &= depths <= near[1][row, column] + hidden + SLOPE_SLACK * 2.1 * step
    good = (cosine > least) & (depths <= near[WINDOW][row, column] + hidden + SLOPE_SLACK * 1.414 * WINDOW * step)
    ramp = np.clip(clear / (2 * margin + 1), None, 1.0)
    return np.where(seen, np.where(good, 1.0, POOR) * cosine**sharpness * ramp / depths**2 * 1e6, 0.0)


def weigh(
    pixels: np.ndarray, depths: np.ndarray, facing: np.ndarray, depth: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    return visibility_weights(pixels, depths, facing, depth, distance, PIXEL_ANGLE, LIMITS)


def test_weights_are_the_definition_over_a_rough_surface() -> None:
    """Steps of a few millimetres between pixels, around every threshold; each kind of weight comes."""
    rng = np.random.default_rng(3)
    depth = (1000 + rng.uniform(0, 12, (40, 50))).astype(np.float32)
    distance = rng.uniform(-12, 2, (40, 50)).astype(np.float32)
    pixels = rng.uniform(-3, 52, (20_000, 2))
    at = np.clip(np.round(pixels).astype(int), 0, (49, 39))
    depths = depth[at[:, 1], at[:, 0]] + rng.uniform(-6, 9, len(pixels))
    facing = rng.uniform(-0.2, 1.0, len(pixels))
    found, expected = (
        weigh(pixels, depths, facing, depth, distance),
        expected_weights(pixels, depths, facing, depth, distance),
    )
    np.testing.assert_allclose(found, expected, rtol=2e-4)
    kinds = [expected == 0, (expected > 0) & (expected < 1e-3), expected >= 1e-3]
    assert min(kind.mean() for kind in kinds) > 0.02


@pytest.mark.parametrize(
    ("pixel", "facing", "distance", "is_seen"),
    [
        ((1.0, 1.0), 0.9, -9.0, True),
        ((0.99, 5.0), 0.9, -9.0, False),
        ((5.0, 0.99), 0.9, -9.0, False),
        ((17.99, 5.0), 0.9, -9.0, True),
        ((18.0, 5.0), 0.9, -9.0, False),
        ((5.0, 13.0), 0.9, -9.0, False),
        ((5.0, 12.99), 0.9, -9.0, True),
        ((np.nan, 5.0), 0.9, -9.0, False),
        ((5.0, 5.0), 0.02, -9.0, False),
        ((5.0, 5.0), 0.021, -9.0, True),
        ((5.0, 5.0), 0.9, -1.5, False),  # on the margin
        ((5.0, 5.0), 0.9, -1.6, True),
    ],
)
def test_where_a_view_ends(pixel: tuple[float, float], facing: float, distance: float, is_seen: bool) -> None:
    depth, field = np.full((15, 20), 900, np.float32), np.full((15, 20), distance, np.float32)
    found = weigh(np.array([pixel]), np.array([900.0]), np.array([facing]), depth, field)
    assert (found[0] > 0) == is_seen


def test_a_surface_that_faces_the_camera_is_hidden_at_exactly_the_limit() -> None:
    """Without a slope there is no slack: 3 mm behind the nearest sample it is seen, above that it is not, or poor."""
    field, at = np.full((15, 20), -9, np.float32), np.array([[9.0, 7.0]])

    def weight(behind_mm: float, column: int) -> float:
        depth = np.full((15, 20), 900, np.float32)
        depth[7, column] -= 50
        return float(weigh(at, np.array([850.0 + behind_mm]), np.array([1.0]), depth, field)[0])

    best = 1e6 / 853.0**2
    for column in (9, 10, 8):  # its own pixel, the next ones
        assert weight(3.0, column) == pytest.approx(best, rel=1e-5)
        assert weight(3.001, column) == 0
    for column in (11, 7):  # in the window
        assert weight(3.0, column) == pytest.approx(best, rel=1e-5)
        assert weight(3.001, column) == pytest.approx(POOR * best, rel=1e-3)
    for column in (12, 6):
        assert weight(3.001, column) == pytest.approx(best, rel=1e-3)


def test_colours_are_a_gaussian_mean_of_codes_read_from_the_table() -> None:
    rng = np.random.default_rng(7)
    image, sigma = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), 0.7
    table = np.linspace(0, 1, 256, dtype=np.float32) ** 2
    pixels = np.vstack([rng.uniform((-0.4, -0.4), (15.4, 11.4), (400, 2)), [[4.0, 4.0], [0.0, 0.0], [15.0, 11.0]]])
    weights = np.r_[np.ones(401), 1e-9, 0.5].astype(np.float32)
    found = sample_colours(image, pixels, weights, table, sigma)
    rows, columns = np.mgrid[:12, :16]
    for (x, y), colour in zip(pixels, found, strict=True):
        left, top = np.floor(x) - 1, np.floor(y) - 1
        window = (columns >= left) & (columns < left + 4) & (rows >= top) & (rows < top + 4)
        share = np.where(window, np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2)), 0)
        code = np.einsum("ij,ijc->c", share, image.astype(float)) / share.sum()
        np.testing.assert_allclose(colour, np.interp(code, np.arange(256), table), atol=2e-6)


def test_white_and_what_is_not_seen() -> None:
    """The last entry of the table is read, and nothing beyond it; a weight of zero gives no colour."""
    image, table = np.full((8, 8, 3), 255, np.uint8), np.linspace(0, 1, 256, dtype=np.float32) ** 2
    found = sample_colours(image, np.full((2, 2), 3.5), np.array([1, 0], np.float32), table, 0.7)
    np.testing.assert_allclose(found, [[1, 1, 1], [0, 0, 0]], atol=1e-6)


def test_what_is_clipped_gives_way_to_what_is_not_and_is_white_where_all_is() -> None:
    colours = linear_from_srgb(np.array([[128, 128, 128], [255, 200, 190], [248, 230, 220]]) / 255.0)
    found = unclipped(colours.astype(np.float32))
    assert found[0] == 1.0
    assert found[1] == pytest.approx(POOR)
    assert POOR < found[2] < 1.0
