"""The table of points: what was measured again, and its own symmetry."""

import numpy as np

from pipeline.faces.points import place_face, point_table, view_bias, view_terms
from rig.geometry import rotation_from_vector, vector_from_rotation

MIRROR = np.array([-1.0, 1.0, 1.0])


def test_mirror_images_are_each_others_in_shape_normals_and_bias() -> None:
    table, direction = point_table(), np.array([0.5, 0.3, np.sqrt(1 - 0.34)])
    pairs = table.mirror_images
    assert (pairs[pairs] == np.arange(468)).all()
    assert (pairs[[33, 133, 61, 1, 10, 152]] == [263, 362, 291, 1, 10, 152]).all()
    np.testing.assert_allclose(table.shape_mm, table.shape_mm[pairs] * MIRROR, atol=1e-4)
    np.testing.assert_allclose(table.normals, table.normals[pairs] * MIRROR, atol=1e-4)
    np.testing.assert_allclose(view_bias(direction), view_bias(direction * MIRROR)[pairs] * (-1.0, 1.0), atol=2e-3)
    np.testing.assert_allclose(view_terms(direction * MIRROR), view_terms(direction) * view_terms(MIRROR))


def test_the_mean_shape_is_a_face() -> None:
    shape = point_table().shape_mm
    right, left = shape[[33, 133]].mean(axis=0), shape[[362, 263]].mean(axis=0)
    assert right[0] < 0.0 < left[0]  # x to the subject's left
    assert 58.0 < left[0] - right[0] < 70.0
    assert shape[10, 1] > right[1] > shape[1, 1] > shape[13, 1] > shape[152, 1]  # forehead, eyes, nose, mouth, chin
    assert shape[1, 2] > shape[[33, 263, 10, 152], 2].max() + 15.0
    assert (point_table().normals[:, 2] > -0.2).mean() > 0.95


def test_a_face_is_placed_where_it_is() -> None:
    turn, shift = rotation_from_vector(np.array([0.3, -0.5, 1.2])), np.array([10.0, -20.0, 500.0])
    for relief in (1.0, 0.6, 0.0):
        shape = point_table().shape_mm * (1.0, 1.0, relief)
        placed, found = place_face(0.9 * shape @ turn.T + shift)
        assert abs(found - relief) < 0.03
        assert abs(placed.scale - 0.9) < 0.01
        # A poster's rotation is its plane's; the mean face's depth leans by 2 degrees against its breadth and height.
        assert np.degrees(np.linalg.norm(vector_from_rotation(placed.rotation.T @ turn))) < 2.5
