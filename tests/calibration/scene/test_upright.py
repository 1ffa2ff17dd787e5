"""Up is found whichever way round photographs were held."""

import numpy as np
import pytest

from calibration.scene.scene import QUARTER, in_guessed_frame, quarter_turns
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import reposed

ELSEWHERE = RigidTransform(rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([30.0, -200.0, 900.0]))


def held(rig: Rig, turns: list[int]) -> Rig:
    """The cameras turned about their axes, in another world frame."""
    rolls = iter([RigidTransform(np.linalg.matrix_power(QUARTER, k), np.zeros(3)) for k in turns])
    return reposed(rig, lambda pose: next(rolls) @ pose @ ELSEWHERE)


def worst_deg(found: Rig, studio: Rig) -> float:
    """The studio's cameras are rolled by 1.1 degrees and stand 12 mm off, one by one: up is good to a few degrees."""
    cosines = []
    for camera in studio:
        ours, its = found[camera.name].centre_world, camera.centre_world
        cosines.append(ours @ its / np.linalg.norm(ours) / np.linalg.norm(its))
    return float(np.degrees(np.arccos(min(cosines))))


@pytest.mark.parametrize("turns", [[0] * 11, [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0]])
def test_up_and_front_are_the_studios(turns: list[int]) -> None:
    studio = default_layout()
    assert worst_deg(in_guessed_frame(held(studio, turns), "cam00"), studio) < 8.0


@pytest.mark.parametrize("quarters", [1, 3])
def test_cameras_all_on_their_side_look_down_at_the_subject(quarters: int) -> None:
    studio = Rig(tuple(c for c in default_layout() if c.centre_world[1] > -10.0))
    assert len(studio) == 8
    assert worst_deg(in_guessed_frame(held(studio, [quarters] * 8), "cam00"), studio) < 8.0


def test_the_poses_differ_from_the_given_ones_by_one_motion_of_the_world() -> None:
    rig = held(default_layout(), [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0])
    moves = [
        a.camera_from_world.inverse() @ b.camera_from_world
        for a, b in zip(rig, in_guessed_frame(rig, None), strict=True)
    ]
    for move in moves:
        np.testing.assert_allclose(move.rotation, moves[0].rotation, atol=1e-12)
        np.testing.assert_allclose(move.translation, moves[0].translation, atol=1e-9)


def test_turns_undo_how_the_cameras_were_held() -> None:
    turns = [0, 1, 0, 3, 2, 0, 0, 0, 1, 1, 0]
    assert ((quarter_turns(held(default_layout(), turns)) + turns) % 4 == 0).all()
