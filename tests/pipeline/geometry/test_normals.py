"""Normals of the compiled loop are those of ``rig.mesh``, bit by bit."""

import numpy as np
import pytest

from pipeline.geometry import normals
from pipeline.geometry.normals import normals_of
from rig import mesh
from rig.mesh import Mesh


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_they_are_those_of_rig(kind: type) -> None:
    rng = np.random.default_rng(2)
    vertices, faces = rng.normal(size=(200, 3)).astype(kind), rng.integers(0, 190, (500, 3))
    faces.flags.writeable = False
    found, expected = normals.vertex_normals(vertices, faces), mesh.vertex_normals(vertices, faces)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=0, atol=0 if kind is np.float64 else 1e-5)
    np.testing.assert_array_equal(normals_of(Mesh(vertices, faces)), found)


def test_vertices_without_an_area_look_ahead() -> None:
    flat = normals.vertex_normals(np.ones((3, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(flat, np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert normals.vertex_normals(np.zeros((0, 3)), np.zeros((0, 3), int)).shape == (0, 3)


def test_cosines_are_those_between_normals_and_lines_of_sight() -> None:
    rng = np.random.default_rng(5)
    place, points, towards = rng.normal(size=3), rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sight = place - points
    expected = (sight * towards).sum(axis=1) / np.linalg.norm(sight, axis=1)
    np.testing.assert_allclose(normals.facing_cosine(place, points, towards), expected, atol=1e-12)
