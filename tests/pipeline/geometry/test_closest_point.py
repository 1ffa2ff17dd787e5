"""Closest points beside a search through every pair, by the plain formula; fans and normals."""

import numpy as np
import pytest

from pipeline.geometry.surface_index import closest_candidates, corners_at_vertices, facing_cosine
from tests.support.closest_points import closest_candidates_naive, closest_on_triangles_naive


def random_triangles(seed: int, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all shapes, slivers among them, and points inside, beside and far from them."""
    rng = np.random.default_rng(seed)
    spread = rng.normal(0, 10, (count, 3, 3)) * rng.uniform(0.01, 1, (count, 3, 1))
    corners = rng.uniform(-50, 50, (count, 1, 3)) + spread
    weights = rng.dirichlet((0.3, 0.3, 0.3), 200)
    near = np.einsum("nk,nkx->nx", weights, corners[rng.integers(0, count, 200)])
    return corners, np.concatenate([near + rng.normal(0, 3, near.shape), rng.uniform(-200, 200, (100, 3))])


def every(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.arange(len(corners)), (len(points), len(corners)))


@pytest.mark.parametrize("seed", range(3))
def test_the_closest_of_all_triangles_is_that_of_the_plain_search(seed: int) -> None:
    corners, points = random_triangles(seed)
    triangle, weights = closest_candidates(points, every(points, corners), corners)
    expected, blends = closest_candidates_naive(points, corners)
    np.testing.assert_array_equal(triangle, expected)
    places = np.einsum("nk,nkx->nx", weights, corners[triangle])
    np.testing.assert_allclose(places, np.einsum("nk,nkx->nx", blends, corners[expected]), atol=1e-9)
    assert weights.min() >= -1e-12
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_a_triangle_that_faces_the_other_way_is_chosen_only_where_it_is_nearer_by_that() -> None:
    corners, points = random_triangles(5)
    facing = np.random.default_rng(6).normal(size=points.shape)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    triangle, _ = closest_candidates(points, every(points, corners), corners, facing, 30.0)
    np.testing.assert_array_equal(triangle, closest_candidates_naive(points, corners, facing, 30.0)[0])
    assert (triangle != closest_candidates(points, every(points, corners), corners)[0]).mean() > 0.2


def test_only_candidates_are_chosen() -> None:
    corners, points = random_triangles(7)
    candidates = np.random.default_rng(8).integers(0, len(corners), (len(points), 3))
    triangle, weights = closest_candidates(points, candidates, corners)
    assert (triangle[:, None] == candidates).any(axis=1).all()
    off = np.linalg.norm(np.einsum("nk,nkx->nx", weights, corners[triangle]) - points, axis=1)
    for column in candidates.T:
        other = closest_on_triangles_naive(points, corners[column])[0]
        assert (off <= np.linalg.norm(other - points, axis=1) + 1e-9).all()


def test_triangles_without_area_have_a_closest_point() -> None:
    line = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    point = np.zeros((3, 3))
    for corners, expected in ((line, [6.0, 0.0, 0.0]), (point, [0.0, 0.0, 0.0])):
        _, weights = closest_candidates(np.array([[6.0, 5.0, 0.0]]), np.zeros((1, 1), int), corners[None])
        np.testing.assert_allclose(weights[0] @ corners, expected, atol=1e-12)


def test_corners_are_those_of_a_stable_sort() -> None:
    faces = np.random.default_rng(4).integers(0, 90, (300, 3))
    start, corner = corners_at_vertices(faces, 100)
    np.testing.assert_array_equal(corner, np.argsort(faces.ravel(), kind="stable"))
    np.testing.assert_array_equal(np.diff(start), np.bincount(faces.ravel(), minlength=100))
    assert start[0] == 0


def test_cosines_are_those_between_normals_and_lines_of_sight() -> None:
    rng = np.random.default_rng(5)
    place, points, towards = rng.normal(size=3), rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sight = place - points
    expected = (sight * towards).sum(axis=1) / np.linalg.norm(sight, axis=1)
    np.testing.assert_allclose(facing_cosine(place, points, towards), expected, atol=1e-12)
