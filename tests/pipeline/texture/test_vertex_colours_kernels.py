"""The compiled blending of views against its definition in NumPy."""

import numpy as np
import pytest

from pipeline.texture.vertex_colours_kernels import LEAST_SHARE, blend_views

HIGHLIGHT = 0.15


def expected_blend(weights: np.ndarray, colours: np.ndarray, highlight: float) -> tuple[np.ndarray, np.ndarray]:
    """One vertex after the other: weighted median of the luminance, then a mean that trusts what is above it less."""
    out, views = np.zeros((weights.shape[1], 3)), np.zeros(weights.shape[1], np.uint8)
    for v in range(weights.shape[1]):
        seen = weights[:, v] > 0
        if not seen.any():
            continue
        own, colour = weights[seen, v].astype(float), colours[seen, v].astype(float)
        level = colour @ (0.21, 0.72, 0.07)
        order = np.argsort(level, kind="stable")
        middle = level[order][np.argmax(np.cumsum(own[order]) >= 0.5 * own.sum())]
        excess = np.clip(level - middle, 0, None) / (highlight * middle + 0.005)
        share = own / (1 + excess**2)
        out[v], views[v] = share @ colour / share.sum(), np.sum(own > LEAST_SHARE * own.sum())
    return out, views


@pytest.mark.parametrize("cameras", [1, 2, 5, 11])
def test_blending_is_its_definition(cameras: int) -> None:
    rng = np.random.default_rng(cameras)
    weights = rng.uniform(0, 1, (cameras, 500)).astype(np.float32) ** 6  # some below a share of 0.005
    weights[rng.uniform(size=weights.shape) < 0.3] = 0
    colours = rng.uniform(0, 1, (cameras, 500, 3)).astype(np.float32)
    found, views = blend_views(weights, colours, HIGHLIGHT)
    expected, expected_views = expected_blend(weights, colours, HIGHLIGHT)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_array_equal(views, expected_views)
    assert (views == 0).any() or cameras > 5


def test_one_highlight_among_equal_views_is_damped() -> None:
    """Four views of 0.2 and one of 0.8, in every place: its excess is 0.6 over 0.035, so that it counts 1 of 295."""
    for bright in range(5):
        colours = np.full((5, 1, 3), 0.2, np.float32)
        colours[bright] = 0.8
        found, views = blend_views(np.ones((5, 1), np.float32), colours, HIGHLIGHT)
        share = 1 / (1 + (0.6 / 0.035) ** 2)
        np.testing.assert_allclose(found[0], (0.8 + 0.8 * share) / (4 + share), rtol=1e-5)
        assert views[0] == 5


def test_the_median_of_two_equal_views_is_the_darker() -> None:
    """Half of the weight is reached with the first; the other is then above it."""
    colours = np.array([[[0.6] * 3], [[0.2] * 3]], np.float32)
    found, _ = blend_views(np.ones((2, 1), np.float32), colours, HIGHLIGHT)
    share = 1 / (1 + (0.4 / 0.035) ** 2)
    np.testing.assert_allclose(found[0], (0.2 + 0.6 * share) / (1 + share), rtol=1e-5)
