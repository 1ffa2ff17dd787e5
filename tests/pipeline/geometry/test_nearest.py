"""The nearest points are SciPy's own, by any number of threads."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.geometry.nearest import PointTree, nearest, sorted_into_cells


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("queries", [0, 1, 1000])
@pytest.mark.parametrize("axes", [2, 3])
def test_they_are_scipys(threads: int, count: int, queries: int, axes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", str(threads))
    rng = np.random.default_rng(3)
    points, places = rng.normal(size=(500, axes)), rng.normal(size=(queries, axes))
    for within in (np.inf, 0.3):
        distance, row = nearest(PointTree.of(points), places, count=count, within=within)
        expected_distance, expected_row = KDTree(points).query(places, k=count, distance_upper_bound=within)
        np.testing.assert_array_equal(distance, expected_distance)
        np.testing.assert_array_equal(row, expected_row)


@pytest.mark.parametrize("points", [0, 1, 12, 13, 100])
def test_few_points_and_more_wanted_than_there_are(points: int) -> None:
    at = np.random.default_rng(1).normal(size=(points, 3))
    distance, row = nearest(PointTree.of(at), np.zeros((2, 3)), count=20)
    expected_distance, expected_row = KDTree(at).query(np.zeros((2, 3)), k=20)
    np.testing.assert_array_equal(distance, expected_distance)
    np.testing.assert_array_equal(row, expected_row)


def test_of_equally_far_points_the_first_comes_first() -> None:
    corners = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    many = np.concatenate([corners] * 9)
    distance, row = nearest(PointTree.of(many), np.zeros((1, 3)), count=8)
    np.testing.assert_array_equal(distance[0], np.full(8, np.sqrt(3.0)))
    np.testing.assert_array_equal(row[0], np.arange(8))
    np.testing.assert_array_equal(nearest(PointTree.of(many), corners)[1], np.arange(8))
    distance, row = nearest(PointTree.of(np.ones((1000, 3))), np.ones((1, 3)), count=3, within=1.0)  # one place
    np.testing.assert_array_equal(distance, np.zeros((1, 3)))
    np.testing.assert_array_equal(row, [[0, 1, 2]])


WIDE = 2.0


def test_near_points_are_at_fixed_steps_of_the_key() -> None:
    points = np.random.default_rng(0).uniform(-9.0, 7.0, (400, 3))
    cells = sorted_into_cells(points, WIDE)
    key_of = np.empty(len(points), np.int64)
    key_of[cells.order] = cells.keys
    steps = {(i * cells.spans[1] + j) * cells.spans[2] + k for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    for a, b in np.argwhere(apart < WIDE):
        assert key_of[b] - key_of[a] in steps


def test_keys_are_sorted_and_the_outermost_cells_are_empty() -> None:
    cells = sorted_into_cells(np.random.default_rng(1).normal(size=(50, 3)), 0.7)
    assert (np.diff(cells.keys) >= 0).all()
    index = np.stack(np.unravel_index(cells.keys, cells.spans))
    assert (index >= 1).all()
    assert (index < cells.spans[:, None] - 1).all()
