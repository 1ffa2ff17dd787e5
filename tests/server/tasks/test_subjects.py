"""Who sits in the studio: a mesh of the user's brings the landmarks that lie beside it."""

from pathlib import Path

import numpy as np
import pytest

from rig.studio.scene.subject import Subject
from server.tasks.subjects import subject_of, turn_eyes
from tests.support.glb import obj_bytes
from tests.support.landmark_files import write_landmarks
from tests.support.measured_heads import mannequin, marks, model


def test_landmarks_beside_a_mesh_come_with_it(tmp_path: Path) -> None:
    path, rng = tmp_path / "mannequin.obj", np.random.default_rng(0)
    path.write_bytes(obj_bytes(mannequin()))
    assert subject_of(str(path), model(), rng).landmarks == {}
    write_landmarks(path.with_suffix(".json"), marks())
    found = subject_of(str(path), model(), rng)
    np.testing.assert_allclose(found.landmarks["pronasale"], marks()["pronasale"], atol=1e-3)
    assert (found.name, len(found.landmarks)) == ("mannequin.obj", len(marks()))


def test_eyes_look_where_they_are_asked_to_and_keep_their_colour() -> None:
    head = Subject(mannequin(), marks())
    assert turn_eyes(head, None, 5) is head
    one, other = turn_eyes(head, (12.0, -5.0), 5).eyes, turn_eyes(head, (-8.0, 0.0), 5).eyes
    towards = one["left"].gaze + one["right"].gaze
    assert np.degrees(np.arctan2(towards[0], towards[2])) == pytest.approx(12.0, abs=0.1)
    assert one["left"].iris == other["left"].iris
