"""Cosines towards a place are those between normals and lines of sight."""

import numpy as np

from pipeline.geometry.surface_index import facing_cosine


def test_cosines_are_those_between_normals_and_lines_of_sight() -> None:
    rng = np.random.default_rng(5)
    place, points, towards = rng.normal(size=3), rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sight = place - points
    expected = (sight * towards).sum(axis=1) / np.linalg.norm(sight, axis=1)
    np.testing.assert_allclose(facing_cosine(place, points, towards), expected, atol=1e-12)
