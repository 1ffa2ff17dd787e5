"""Vertices of planted parabolas, of single values and of arrays."""

import numpy as np
import pytest

from rig.geometry import second_difference, vertex_offset

ARRAYS = np.array([0.1, -0.2, 0.4]), np.array([-1.0, -3.0, 2.0])


@pytest.mark.parametrize(("vertex", "bend"), [(0.0, -2.0), (0.3, -0.5), (-0.45, 3.0), (1.7, -1.0), ARRAYS])
def test_a_planted_vertex_is_found(vertex: float | np.ndarray, bend: float | np.ndarray) -> None:
    before, middle, after = (np.asarray(0.5 * bend * (x - vertex) ** 2 + 7.0) for x in (-1.0, 0.0, 1.0))
    curvature = second_difference(before, middle, after)
    assert curvature == pytest.approx(bend, abs=1e-12)
    assert vertex_offset(before, after, curvature) == pytest.approx(vertex, abs=1e-12)
