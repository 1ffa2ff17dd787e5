"""Distances to a surface, where geometry knows them."""

import numpy as np
import pytest

from rig.mesh import Mesh
from server.services.truth import surface_distance


@pytest.mark.parametrize(
    ("point", "distance"),
    [((3, 3, 5), 5), ((5, 5, -2), 2), ((12, 5, 0), 2), ((13, 14, 0), 5), ((-3, 0, 4), 5), ((0, 0, 0), 0)],
)
def test_distance_to_a_square_by_hand(point: tuple[float, float, float], distance: float) -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 10, 4), np.linspace(0, 10, 4), indexing="xy"), 2).reshape(-1, 2)
    vertices = np.concatenate([grid, np.zeros((16, 1))], axis=1)
    faces = []
    for row in range(3):
        for column in range(3):
            a = 4 * row + column
            faces += [[a, a + 1, a + 5], [a, a + 5, a + 4]]
    found = surface_distance(np.array([point], float), Mesh(vertices, np.array(faces, np.int32)))
    assert found[0] == pytest.approx(distance, abs=1e-9)
