"""The nearest points are SciPy's own, by any number of threads."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.geometry.nearest import nearest


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("queries", [0, 1, 1000])
def test_they_are_those_of_one_query(threads: int, count: int, queries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", str(threads))
    rng = np.random.default_rng(3)
    tree, points = KDTree(rng.normal(size=(500, 3))), rng.normal(size=(queries, 3))
    for within in (np.inf, 0.3):
        distance, row = nearest(tree, points, count=count, within=within)
        expected_distance, expected_row = tree.query(points, k=count, distance_upper_bound=within)
        np.testing.assert_array_equal(distance, expected_distance)
        np.testing.assert_array_equal(row, expected_row)
