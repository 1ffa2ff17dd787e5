"""Thinned points are the weighted means of their cells."""

import numpy as np

from pipeline.detail.dense_points import SurfacePoints, thinned
from pipeline.part_labels.codes import Part


def test_points_of_one_cell_part_and_side_become_their_mean_by_information() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.5, 0.3, 0.1], [0.2, 0.1, 0.1], [0.2, 0.1, 0.3], [1.6, 0.1, 0.1]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    part = np.array([Part.SKIN, Part.SKIN, Part.SKIN, Part.HAIR, Part.SKIN], np.uint8)
    found = thinned(SurfacePoints(points, normals, np.array([1.0, 0.5, 1.0, 1.0, 1.0]), part), 1.5)
    assert len(found.points) == 4
    joined = np.flatnonzero(found.deviation_mm < 0.9)
    np.testing.assert_allclose(found.points[joined], [(points[0] + 4.0 * points[1]) / 5.0])
    mean = normals[0] + 4.0 * normals[1]
    np.testing.assert_allclose(found.normals[joined], [mean / np.linalg.norm(mean)])
    np.testing.assert_allclose(found.deviation_mm[joined], np.sqrt(2.0 / 5.0))
    assert sorted(found.part) == sorted([Part.SKIN, Part.SKIN, Part.HAIR, Part.SKIN])


def test_every_cell_keeps_one_of_many_points() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(-20.0, 20.0, (2000, 3))
    normals = np.tile([1.0, 0.0, 0.0], (2000, 1))
    found = thinned(SurfacePoints(points, normals, np.ones(2000), np.zeros(2000, np.uint8)), 5.0)
    cells = np.unique(np.floor((points - points.min(axis=0)) / 5.0).astype(int), axis=0, return_counts=True)
    np.testing.assert_array_equal(np.floor((found.points - points.min(axis=0)) / 5.0), cells[0])
    np.testing.assert_allclose(found.deviation_mm, 1.0)
