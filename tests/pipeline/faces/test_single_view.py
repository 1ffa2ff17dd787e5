"""A face that one view alone shows: planted poses come back, at the mean adult's size."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.faces.points import point_table
from pipeline.faces.subject import DISTANCE_SHARE, match_alone, place_from_one_view
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import Similarity, look_at, rotation_from_vector, vector_from_rotation
from tests.support.drawn_faces import seen_face

LENS = Distortion(-0.12, 0.05, 1e-3, -8e-4, 0.01)
TURNS = ((0.0, 0.0, 0.0), (0.3, -0.4, 0.1), (-0.4, 0.7, 1.5), (0.1, 0.2, 3.0))


def camera() -> Camera:
    pose = look_at(np.array([200.0, 300.0, 1000.0]), np.array([20.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    return Camera("front", Intrinsics(1024, 768, 1500.0, 1480.0, 520.0, 377.0, LENS), pose)


@pytest.mark.parametrize("turn", TURNS)
def test_a_planted_pose_comes_back(turn: tuple[float, float, float]) -> None:
    face = Similarity(1.0, rotation_from_vector(np.array(turn)), np.array([30.0, -20.0, 10.0]))
    found = place_from_one_view(seen_face(face, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    assert np.degrees(np.linalg.norm(vector_from_rotation(found.rotation.T @ face.rotation))) < 0.7
    # 468 points with 1 px of noise: a size to 0.02 %; the bias, taken off in three rounds, leaves more.
    assert np.linalg.norm(found.translation - face.translation) < 6.0
    assert found.scale == 1.0


def test_a_child_is_taken_for_an_adult_farther_away() -> None:
    child = Similarity(0.8, np.eye(3), np.zeros(3))
    found = place_from_one_view(seen_face(child, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    away = np.linalg.norm(found.translation - camera().centre_world) / np.linalg.norm(camera().centre_world)
    assert abs(away - 1.0 / 0.8) < 0.02


def test_points_outside_the_lens_are_no_pose() -> None:
    """A lens whose model turns back at 1.1 of the focal length: nothing is seen beyond."""
    face = seen_face(Similarity.identity(), camera(), np.random.default_rng(0))
    narrow = replace(camera(), intrinsics=replace(camera().intrinsics, distortion=Distortion(k1=-0.28)))
    far_off = replace(face, landmarks_px=face.landmarks_px + (3000.0, 0.0))
    assert place_from_one_view(face, narrow) is not None
    assert place_from_one_view(far_off, narrow) is None
    assert match_alone("front", far_off, narrow) is None


def test_what_one_view_leaves_open_is_said() -> None:
    """Along the rays a tenth of the distance, across them what pixels leave: a child's points are among the likely."""
    child = Similarity(0.9, rotation_from_vector(np.array([0.1, -0.2, 0.0])), np.array([10.0, 5.0, 0.0]))
    found = match_alone("front", seen_face(child, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    assert list(found.detections) == ["front"]
    modes = found.shared_mm.reshape(len(found.shared_mm), -1)
    error = found.points_world - child.apply(point_table().shape_mm)
    assert np.linalg.norm(error, axis=1).mean() > 90.0  # taken for an adult, farther away
    covariance = modes.T @ modes
    for k, block in enumerate(found.covariances):
        covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), error.ravel())
    assert (whitened**2).mean() < 2.0
    along = found.points_world - camera().centre_world
    assert np.allclose(found.shared_mm[0], DISTANCE_SHARE * along)
