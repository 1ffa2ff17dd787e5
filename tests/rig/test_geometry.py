"""Rigid motions and similarities: the group laws, and scipy's rotations beside ours; vertices of parabolas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rig.geometry import (
    RigidTransform,
    Similarity,
    cross_matrix,
    look_at,
    nearest_rotation,
    nearest_to_rays,
    rigid_fit,
    rotation_from_vector,
    second_difference,
    vector_from_rotation,
    vertex_offset,
)

POINTS = np.random.default_rng(0).normal(0, 100.0, (5, 3))
components = st.floats(-10.0, 10.0)
vectors = st.tuples(components, components, components).map(np.array)
rigid = st.tuples(vectors, vectors).map(lambda p: RigidTransform(rotation_from_vector(p[0]), 50.0 * p[1]))
similarities = st.tuples(st.floats(0.2, 5.0), rigid).map(lambda p: Similarity(p[0], p[1].rotation, p[1].translation))


@given(vector=vectors)
def test_rodrigues_is_scipy_s(vector: np.ndarray) -> None:
    np.testing.assert_allclose(rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


@given(vector=vectors)
def test_vector_of_a_rotation_is_scipy_s(vector: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(vector)
    found = vector_from_rotation(rotation.as_matrix())
    assert np.linalg.norm(found) <= np.pi + 1e-12
    np.testing.assert_allclose(rotation_from_vector(found), rotation.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-5, 9.9e-5, 1.01e-4, 3.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, -0.6, 0.8], [0.6, 0.64, 0.48]])
def test_small_and_half_turns(angle: float, axis: list[float]) -> None:
    vector = angle * np.array(axis)
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    found = vector_from_rotation(rotation)
    flipped = found if found @ vector >= 0 else -found  # at pi both signs are right
    np.testing.assert_allclose(flipped, vector, atol=1e-8 if angle > 3.1 else 1e-12)


@given(a=rigid, b=rigid, c=rigid)
def test_rigid_transforms_are_a_group(a: RigidTransform, b: RigidTransform, c: RigidTransform) -> None:
    np.testing.assert_allclose((a @ b).apply(POINTS), a.apply(b.apply(POINTS)), atol=1e-8)
    np.testing.assert_allclose(((a @ b) @ c).apply(POINTS), (a @ (b @ c)).apply(POINTS), atol=1e-8)
    np.testing.assert_allclose((a @ a.inverse()).apply(POINTS), POINTS, atol=1e-8)
    np.testing.assert_allclose((a @ RigidTransform.identity()).apply(POINTS), a.apply(POINTS))


@given(a=similarities, b=similarities, c=rigid)
def test_similarities_are_a_group(a: Similarity, b: Similarity, c: RigidTransform) -> None:
    np.testing.assert_allclose((a @ b).apply(POINTS), a.apply(b.apply(POINTS)), atol=1e-7)
    np.testing.assert_allclose((a @ c).apply(POINTS), a.apply(c.apply(POINTS)), atol=1e-7)
    np.testing.assert_allclose((a.inverse() @ a).apply(POINTS), POINTS, atol=1e-7)
    np.testing.assert_allclose((Similarity.identity() @ a).apply(POINTS), a.apply(POINTS))
    np.testing.assert_allclose(Similarity.from_rigid(c).apply(POINTS), c.apply(POINTS))
    moved = a.apply(POINTS)
    assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(a.scale * np.linalg.norm(POINTS[1] - POINTS[0]))


@given(a=vectors, b=vectors)
def test_cross_matrix(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(cross_matrix(a) @ b, np.cross(a, b), atol=1e-12)


@given(vector=vectors, seed=st.integers(0, 1000))
def test_nearest_rotation_undoes_small_errors_and_is_never_a_mirror(vector: np.ndarray, seed: int) -> None:
    rotation = rotation_from_vector(vector)
    disturbed = nearest_rotation(rotation + 1e-4 * np.random.default_rng(seed).uniform(-1, 1, (3, 3)))
    assert np.abs(disturbed - rotation).max() < 3e-4
    mirrored = nearest_rotation(rotation @ np.diag([1.0, 1.0, -1.0]))
    assert np.linalg.det(mirrored) == pytest.approx(1.0)


def test_look_at_sees_the_target_ahead_and_up_above() -> None:
    places = np.array([[300.0, 100.0, 900.0], [10.0, 20.0, 30.0], [10.0, 70.0, 30.0]])
    camera_from_world = look_at(places[0], places[1], np.array([0.0, 1.0, 0.0]))
    centre, target, above = camera_from_world.apply(places)
    np.testing.assert_allclose(centre, 0.0, atol=1e-9)
    np.testing.assert_allclose(target[:2], 0.0, atol=1e-9)
    assert target[2] > 0
    assert above[1] < 0  # image rows count downwards
    assert above[0] == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.det(camera_from_world.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("flat", [False, True])
def test_rigid_fit_finds_a_planted_motion(flat: bool) -> None:
    rng = np.random.default_rng(4)
    source = rng.normal(0.0, 50.0, (9, 3)) * (1.0, 1.0, 0.0 if flat else 1.0)
    planted = RigidTransform(rotation_from_vector(np.array([0.9, -1.7, 0.4])), np.array([30.0, -700.0, 12.0]))
    target, weights = planted.apply(source), rng.uniform(0.1, 2.0, 9)
    for found in (rigid_fit(source, target), rigid_fit(source, target, weights)):
        np.testing.assert_allclose(found.rotation, planted.rotation, atol=1e-12)
        np.testing.assert_allclose(found.translation, planted.translation, atol=1e-10)


def test_rigid_fit_is_scipy_s_and_no_reflection() -> None:
    rng = np.random.default_rng(5)
    source, weights = rng.normal(0.0, 50.0, (9, 3)), rng.uniform(0.1, 2.0, 9)
    target = source * (-1.0, 1.0, 1.0) + rng.normal(0.0, 5.0, (9, 3))
    found = rigid_fit(source, target, weights)
    share = weights / weights.sum()
    expected = Rotation.align_vectors(target - share @ target, source - share @ source, weights)[0]
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.apply(share @ source), share @ target, atol=1e-10)


def test_many_vectors_at_once_are_each_turned_alone() -> None:
    many = np.random.default_rng(3).normal(0, 1.0, (4, 5, 3))
    for function in (cross_matrix, rotation_from_vector):
        together = function(many)
        assert together.shape == (4, 5, 3, 3)
        np.testing.assert_array_equal(together[2, 3], function(many[2, 3]))


def test_a_small_rotation_has_every_digit() -> None:
    """Where the series stands for sin(a)/a, which at 9e-5 differs from 1 by 1.35e-9."""
    angle = 9e-5
    rotation = rotation_from_vector(np.array([angle, 0.0, 0.0]))
    assert rotation[2, 1] == pytest.approx(np.sin(angle), rel=1e-14)
    assert rotation[1, 1] == pytest.approx(np.cos(angle), abs=3e-16)
    tiny = np.array([0.0, 5e-13, 0.0])
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(tiny)), tiny, rtol=1e-3)


def test_the_point_nearest_to_rays_is_where_they_meet_and_weights_decide_where_they_do_not() -> None:
    rng = np.random.default_rng(1)
    centres, points = rng.normal(0.0, 1000.0, (4, 3)), rng.normal(0.0, 50.0, (6, 3))
    rays = points - centres[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    np.testing.assert_allclose(nearest_to_rays(centres, rays), points, atol=1e-6)
    rays[3] = rays[3, ::-1]  # the fourth looks at other points
    weights = np.ones((4, 6))
    assert np.linalg.norm(nearest_to_rays(centres, rays, weights) - points, axis=1).max() > 1.0
    weights[3] = 0.0
    np.testing.assert_allclose(nearest_to_rays(centres, rays, weights), points, atol=1e-6)
    along = np.array([[0.0, 0.0, 1.0]] * 2)  # parallel: the ridge keeps the point finite
    np.testing.assert_allclose(nearest_to_rays(np.array([[1.0, 0, 0], [3.0, 0, 0]]), along), [2.0, 0, 0], atol=1e-6)


ARRAYS = np.array([0.1, -0.2, 0.4]), np.array([-1.0, -3.0, 2.0])


@pytest.mark.parametrize(("vertex", "bend"), [(0.0, -2.0), (0.3, -0.5), (-0.45, 3.0), (1.7, -1.0), ARRAYS])
def test_a_planted_vertex_is_found(vertex: float | np.ndarray, bend: float | np.ndarray) -> None:
    before, middle, after = (np.asarray(0.5 * bend * (x - vertex) ** 2 + 7.0) for x in (-1.0, 0.0, 1.0))
    curvature = second_difference(before, middle, after)
    assert curvature == pytest.approx(bend, abs=1e-12)
    assert vertex_offset(before, after, curvature) == pytest.approx(vertex, abs=1e-12)
