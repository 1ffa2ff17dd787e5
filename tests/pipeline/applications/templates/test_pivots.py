"""Where jaw, eyes and neck turn."""

import numpy as np

from pipeline.applications.templates.pivots import EYE_RADIUS_MM, hinge, in_mouth, jaw_motions, pivots
from pipeline.head_model.model import HeadModel
from tests.pipeline.applications.templates.conftest import moves

Points = dict[str, np.ndarray]


def test_pivots_lie_where_anatomy_or_an_eyeball_has_them(model: HeadModel, mean: np.ndarray, points: Points) -> None:
    found = pivots(points, mean, moves(model, "eyeBlinkRight", "eyeBlinkLeft"), [])
    assert set(found) == {"jaw", "eye_right", "eye_left", "neck"}
    assert abs(found["jaw"][0]) < 1.0
    assert 8.0 < found["jaw"][2] < 14.0  # in front of the ears
    for side, sign in (("right", -1.0), ("left", 1.0)):
        corners = 0.5 * (points[f"exocanthion_{side}"] + points[f"endocanthion_{side}"])
        eye = found[f"eye_{side}"]
        assert sign * eye[0] > 20.0
        assert np.linalg.norm((eye - corners)[:2]) < 3.0
        assert 0.0 < corners[2] - eye[2] < EYE_RADIUS_MM  # the ball's middle lies behind its opening
    assert found["neck"][1] < found["jaw"][1]
    assert found["neck"][2] < found["jaw"][2]
    ball = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) * 12.0 + (31.0, 12.0, 66.0)
    found = pivots(points, mean, {}, [ball])
    np.testing.assert_allclose(found["eye_left"], (31.0, 12.0, 66.0))
    assert found["eye_right"][0] < 0


def test_the_jaw_opens_about_its_hinge_and_shifts_otherwise(model: HeadModel, mean: np.ndarray, points: Points) -> None:
    found = jaw_motions(points, mean, moves(model, "jawOpen", "jawLeft", "mouthLeft"))
    assert set(found) == {"jawOpen", "jawLeft"}
    np.testing.assert_allclose(found["jawOpen"].apply(hinge(points)), hinge(points), atol=1e-9)
    chin = points["gnathion"]
    assert found["jawOpen"].apply(chin)[1] < chin[1] - 10.0
    assert found["jawOpen"].apply(chin)[2] < chin[2]
    np.testing.assert_allclose(found["jawLeft"].rotation, np.eye(3))
    assert found["jawLeft"].translation[0] > 3.0


def test_lower_teeth_are_told_from_upper_ones_and_from_what_is_no_tooth(points: Points) -> None:
    inside = points["stomion"] + (0.0, 0.0, -15.0)
    row = np.linspace(-15.0, 15.0, 7)[:, None] * (1.0, 0.0, 0.0)
    assert in_mouth(points, inside + row - (0.0, 5.0, 0.0))
    assert not in_mouth(points, inside + row + (0.0, 6.0, 0.0))
    assert not in_mouth(points, inside + row - (0.0, 80.0, 0.0))
