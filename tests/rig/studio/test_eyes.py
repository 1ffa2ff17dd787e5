"""Eyeballs of the simulated studio: behind the lids, looking where they are told, and in the truth."""

import numpy as np
import pytest

from pipeline.geometry.projection import depth_maps
from pipeline.head_model.model import load_model
from rig.camera import Camera, Intrinsics
from rig.errors import InputError
from rig.geometry import Similarity, look_at, rotation_from_vector
from rig.mesh import Mesh, face_normals
from rig.rig import Rig
from rig.studio.scene.eyes import LIMBUS_MM, RADIUS_MM, open_lids, surface
from rig.studio.scene.subject import Subject, add_eyeballs


@pytest.fixture(scope="module")
def sitter() -> Subject:
    model = load_model()
    vertices = model.vertices(np.zeros(0))
    marks = {name: vertices[row] for name, row in model.landmarks.items()}
    return Subject(Mesh(vertices, model.levels["full"].faces), marks)


@pytest.fixture(scope="module")
def looking(sitter: Subject) -> Subject:
    return add_eyeballs(sitter, 12.0, -5.0, np.random.default_rng(1))


def test_both_eyes_look_at_one_point(looking: Subject) -> None:
    right, left = looking.eyes["right"], looking.eyes["left"]
    assert right.centre[0] < -20.0
    assert left.centre[0] > 20.0
    target = 0.5 * (right.centre + left.centre) + 1200.0 * np.array([
        np.sin(np.radians(12.0)) * np.cos(np.radians(-5.0)),
        np.sin(np.radians(-5.0)),
        np.cos(np.radians(12.0)) * np.cos(np.radians(-5.0)),
    ])  # fmt: skip
    for eye in (right, left):
        assert np.linalg.norm(np.cross(target - eye.centre, eye.gaze)) < 1e-6
        assert np.linalg.norm(eye.iris_centre - eye.centre) == pytest.approx(np.sqrt(RADIUS_MM**2 - LIMBUS_MM**2))


def test_lids_stand_before_the_eyeballs_and_let_them_be_seen(sitter: Subject, looking: Subject) -> None:
    head = open_lids(sitter.mesh, sitter.landmarks)
    np.testing.assert_array_equal(head.vertices[: len(sitter.mesh.vertices)], sitter.mesh.vertices)
    lens = Intrinsics(400, 200, 2600.0, 2600.0, 199.5, 99.5)
    front = Camera(
        "front", lens, look_at(np.array([0.0, 15.0, 1200.0]), np.array([0.0, 15.0, 0.0]), np.array([0, 1.0, 0]))
    )
    rig = Rig((front,))
    skin = depth_maps(rig, head)["front"]
    for eye in looking.eyes.values():
        ball = surface(eye, np.random.default_rng(0))
        assert (face_normals(ball.vertices, ball.faces) * (ball.vertices[ball.faces[:, 0]] - eye.centre)).sum(
            axis=1
        ).min() >= 0
        shown = depth_maps(rig, Mesh(ball.vertices, ball.faces))["front"] < skin - 0.01
        x, y = np.rint(front.project(eye.iris_centre[None])[0]).astype(int)
        assert shown[y, x]
        off = np.linalg.norm(np.cross(ball.vertices - eye.centre, eye.gaze), axis=1)
        limbus = np.abs(off - LIMBUS_MM) < 0.1
        dark, white = ball.paint[off < 1.5, 1].max(), ball.paint[off > 6.5, 1].min()
        assert dark < 0.02 < 0.3 < white
        assert (ball.paint[limbus, 1] < white).all()
        assert 0.08 < shown.sum() * (1200.0 / 2600.0) ** 2 / (28.0 * 8.0 * 0.67) < 1.5  # the lids' gap


def test_the_truth_holds_the_eyes_and_a_head_without_landmarks_gets_none(looking: Subject, sitter: Subject) -> None:
    pose = Similarity(1.0, rotation_from_vector(np.array([0.1, 0.7, 0.0])), np.array([5.0, -20.0, 30.0]))
    eye = looking.eyes["left"]
    placed = eye.placed(pose)
    np.testing.assert_allclose(placed.iris_centre, pose.apply(eye.iris_centre[None])[0])
    np.testing.assert_allclose(placed.gaze, pose.rotation @ eye.gaze)
    with pytest.raises(InputError, match="landmarks"):
        add_eyeballs(Subject(sitter.mesh), 0.0, 0.0, np.random.default_rng(1))
