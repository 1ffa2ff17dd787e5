"""Pictures beside the results: tints against the formula."""

import numpy as np

from pipeline.results.overlays import PART_COLOURS, TINT, tinted


def test_a_pixel_moves_towards_the_colours_of_its_parts() -> None:
    """Rounded to a grey level: half of one, and single precision's."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (12, 17, 3), dtype=np.uint8)
    parts = np.zeros((12, 17, 3), np.float32)
    parts[3:9, 4:12] = rng.dirichlet([1.0, 1.0, 1.0], (6, 8))
    colours = np.array(list(PART_COLOURS.values()), float)
    expected = image * (1.0 - TINT * parts.sum(axis=2, keepdims=True)) + TINT * parts @ colours
    found = tinted(image, parts)
    np.testing.assert_allclose(found, expected, atol=0.501)
    np.testing.assert_array_equal(found[:3], image[:3])
