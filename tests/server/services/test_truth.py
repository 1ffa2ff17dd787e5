"""Distances to a surface, where geometry knows them."""

import numpy as np
import pytest

from rig.mesh import Mesh
from server.services.truth import surface_distance


def sphere(radius: float, rings: int = 60) -> Mesh:
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    vertices = radius * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 2)
    index = np.arange(theta.size).reshape(theta.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return Mesh(
        vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    )


def test_distance_to_a_sphere_is_the_difference_of_radii() -> None:
    """The facets lie at most r (1 - cos(pi / 59 / 2)) (two axes) within the sphere: 0.07 mm of 100 mm."""
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for radius in (90.0, 100.0, 108.0):
        distances = surface_distance(radius * directions, sphere(100.0))
        assert np.abs(distances - abs(radius - 100.0)).max() < 0.075


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
