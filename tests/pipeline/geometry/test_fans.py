"""Corners sorted by counting are those of a stable sort."""

import numpy as np

from pipeline.geometry.surface_index import corners_at_vertices


def test_corners_are_those_of_a_stable_sort() -> None:
    faces = np.random.default_rng(4).integers(0, 90, (300, 3))
    start, corner = corners_at_vertices(faces, 100)
    np.testing.assert_array_equal(corner, np.argsort(faces.ravel(), kind="stable"))
    np.testing.assert_array_equal(np.diff(start), np.bincount(faces.ravel(), minlength=100))
    assert start[0] == 0
