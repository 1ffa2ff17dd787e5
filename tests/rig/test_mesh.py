"""Normals of the compiled loop are those that NumPy sums face by face, bit by bit."""

import numpy as np
import pytest

from rig.mesh import Mesh, face_normals, vertex_normals


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_normals_are_sums_of_those_of_faces(kind: type) -> None:
    rng = np.random.default_rng(2)
    vertices, faces = rng.normal(size=(200, 3)).astype(kind), rng.integers(0, 190, (500, 3))
    faces.flags.writeable = False
    found = vertex_normals(vertices, faces)
    expected = np.zeros((200, 3))
    np.add.at(expected, faces.ravel(), np.repeat(face_normals(vertices.astype(float), faces), 3, axis=0))
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    expected = np.where(length > 0, expected / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    assert found.dtype == kind
    np.testing.assert_array_equal(found, expected.astype(kind))
    np.testing.assert_array_equal(Mesh(vertices, faces).normals(), found)


def test_vertices_without_an_area_look_ahead() -> None:
    flat = vertex_normals(np.ones((3, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(flat, np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert vertex_normals(np.zeros((0, 3)), np.zeros((0, 3), int)).shape == (0, 3)
