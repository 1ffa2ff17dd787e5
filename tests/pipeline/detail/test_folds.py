"""Folds are found and taken out, and nothing else is touched."""

import numpy as np

from pipeline.detail.refine import folded, unfolded
from tests.support.subdivided_spheres import subdivided_sphere


def test_a_smooth_displacement_is_left_alone() -> None:
    vertices, faces, _ = subdivided_sphere()
    moved = vertices * (1.0 + 0.02 * np.sin(vertices[:, :1] / 20.0))
    assert not folded(vertices, moved, faces).any()
    assert unfolded(vertices, moved, faces) is moved


def test_a_planted_fold_gives_way_and_the_rest_stays() -> None:
    vertices, faces, _ = subdivided_sphere()
    moved = vertices.copy()
    moved[500] += 3.0 * (vertices[faces[(faces == 500).any(axis=1)][0]].mean(axis=0) - vertices[500])
    assert folded(vertices, moved, faces).any()
    mended = unfolded(vertices, moved, faces)
    assert not folded(vertices, mended, faces).any()
    far = np.linalg.norm(vertices - vertices[500], axis=1) > 50.0
    np.testing.assert_array_equal(mended[far], moved[far])
