"""The compiled blending of views against its definition in NumPy."""

import numpy as np
import pytest

from pipeline.texturing.view_selection_kernels import MAX_VOTE, MIN_SHARE, blend_views

OUTLIER = 0.15


def expected_blend(weights: np.ndarray, colours: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """One vertex after the other: weighted median of each channel, no view voting for much more than the mean one, then
    a mean that trusts what is off it less."""
    out, views = np.zeros((weights.shape[1], 3)), np.zeros(weights.shape[1], np.uint8)
    for v in range(weights.shape[1]):
        seen = weights[:, v] > 0
        if not seen.any():
            continue
        weight, colour = weights[seen, v].astype(float), colours[seen, v].astype(float)
        middle = np.zeros(3)
        for c in range(3):
            order = np.argsort(colour[:, c], kind="stable")
            votes = np.minimum(weight, MAX_VOTE * weight.mean())
            middle[c] = colour[order, c][np.argmax(np.cumsum(votes[order]) >= 0.5 * votes.sum())]
        off = (colour - middle) / (outlier * middle + 0.005)
        off = np.where(off > 0, off, 0.5 * off)
        share = weight / (1 + (off**2).mean(axis=1))
        out[v], views[v] = share @ colour / share.sum(), np.sum(weight > MIN_SHARE * weight.sum())
    return out, views


@pytest.mark.parametrize("cameras", [1, 2, 5, 11])
def test_blending_is_its_definition(cameras: int) -> None:
    rng = np.random.default_rng(cameras)
    weights = rng.uniform(0, 1, (cameras, 500)).astype(np.float32) ** 6  # some below a share of 0.005
    weights[rng.uniform(size=weights.shape) < 0.3] = 0
    colours = rng.uniform(0, 1, (cameras, 500, 3)).astype(np.float32)
    found, views = blend_views(weights, colours, OUTLIER)
    expected, expected_views = expected_blend(weights, colours, OUTLIER)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_array_equal(views, expected_views)
    assert (views == 0).any() or cameras > 5


def test_a_close_up_in_a_shadow_does_not_outvote_the_others() -> None:
    """It weighs as much as five others together, which agree: its photographer stood in the light."""
    weights = np.array([6.0, 1.0, 1.2, 0.8, 1.1, 0.9], np.float32)[:, None]
    colours = np.full((6, 1, 3), 0.24, np.float32)
    colours[0] = 0.15
    found, _ = blend_views(weights, colours, OUTLIER)
    assert found[0].min() > 0.2


def test_one_shadow_among_equal_views_is_damped_in_colour() -> None:
    """Two views of grey and one as bright that is blue: luminance alone would not tell it."""
    grey, blue = [0.3, 0.3, 0.3], [0.21, 0.3, 0.57]  # both 0.30 by 0.21 r + 0.72 g + 0.07 b
    found, _ = blend_views(np.ones((3, 1), np.float32), np.array([[grey], [blue], [grey]], np.float32), OUTLIER)
    np.testing.assert_allclose(found[0], grey, atol=0.02)
