"""A view of another moment looks otherwise than the rest; other exposure, gloss and hidden parts do not count."""

import numpy as np
import pytest

from pipeline.texturing.vertex_colours import MIN_LIKENESS, find_unlike

VERTICES = 2_000
HALF = np.arange(VERTICES) < VERTICES // 2


def face(rng: np.random.Generator) -> np.ndarray:
    """Brightness along a row of vertices, smooth over some thirty."""
    return 0.2 + 0.1 * np.convolve(rng.standard_normal(VERTICES + 30), np.ones(31) / np.sqrt(31.0), "valid")


def views(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    shared = face(rng)
    level = np.stack([(0.6 + 0.2 * k) * shared + 0.01 * rng.standard_normal(VERTICES) for k in range(count)])
    return np.ones((count, VERTICES), np.float32), np.repeat(level[..., None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize("count", [3, 6])
def test_views_of_one_moment_are_alike_in_any_exposure(count: int) -> None:
    assert find_unlike(*views(count), [HALF, ~HALF]) == {}


@pytest.mark.parametrize("count", [3, 6])
def test_the_view_whose_half_shows_something_else_is_named(count: int) -> None:
    weights, colours = views(count)
    colours[1, ~HALF] = face(np.random.default_rng(8))[~HALF, None]
    found = find_unlike(weights, colours, [HALF, ~HALF])
    assert list(found) == [1]
    assert found[1] < MIN_LIKENESS


def test_no_view_is_named_where_it_shows_little_where_no_two_agree_and_of_two() -> None:
    weights, colours = views(4)
    colours[1] = face(np.random.default_rng(8))[:, None]
    assert find_unlike(weights[:2], colours[:2], [HALF]) == {}
    weights[1, 100:] = 0.0
    assert find_unlike(weights, colours, [HALF]) == {}
    apart = np.stack([np.repeat(face(np.random.default_rng(k))[:, None], 3, axis=1) for k in range(4)])
    assert find_unlike(np.ones_like(weights), apart.astype(np.float32), [HALF]) == {}
