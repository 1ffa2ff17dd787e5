"""A drawn head is met once and then followed, wherever it turns; an empty studio has none."""

import numpy as np
import pytest

from pipeline.applications.moments.live_head import LiveHead, follow, meet
from pipeline.faces.networks import FaceNetworks, load_networks
from pipeline.faces.points import place_face
from pipeline.faces.sighting import GLANCE, gaze_from
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import load_model
from tests.support.drawn_studio import drawn_pictures, drawn_studio, hidden_from

TURN_OFF_DEG = 5.0  # as tests/pipeline/faces/test_sighting.py allows drawn faces


@pytest.fixture(scope="module")
def networks() -> FaceNetworks:
    return load_networks()


@pytest.fixture(scope="module")
def head(networks: FaceNetworks) -> LiveHead:
    subject = find_subject(drawn_pictures(), drawn_studio(), networks, effort=GLANCE)
    assert subject.matched is not None
    met = meet(load_model(), subject.matched, drawn_pictures(), drawn_studio(), networks)
    assert met is not None
    return met


def left_deg(head: LiveHead) -> float:
    return gaze_from(place_face(head.landmarks_world)[0], drawn_studio()["cam0"].axis_world)[0]


def test_a_head_is_placed_where_it_is(head: LiveHead) -> None:
    assert abs(left_deg(head)) < TURN_OFF_DEG
    shown = drawn_studio()["cam0"].project(head.landmarks_world)
    assert np.linalg.norm(shown - head.sighting.pixels["cam0"], axis=1).mean() < 3.0
    assert {name for name, facing in head.facing.items() if facing > 0.5} >= {"cam0", "cam1", "cam2", "cam3"}
    assert head.facing["cam5"] < -0.5


@pytest.mark.parametrize("turn_deg", [-20.0, 20.0])
def test_a_head_that_turns_at_once_is_followed(head: LiveHead, networks: FaceNetworks, turn_deg: float) -> None:
    turned = follow(head, drawn_pictures(turn_deg), networks)
    assert turned is not None
    assert left_deg(turned) == pytest.approx(turn_deg, abs=TURN_OFF_DEG)
    again = follow(turned, drawn_pictures(), networks)
    assert again is not None
    assert abs(left_deg(again)) < TURN_OFF_DEG


def test_a_hidden_camera_lacks_the_face_and_hidden_ones_lose_the_head(head: LiveHead, networks: FaceNetworks) -> None:
    one = follow(head, hidden_from(["cam3"], drawn_pictures()), networks)
    assert one is not None
    assert "cam3" not in one.sighting.pixels
    assert {"cam0", "cam1", "cam2"} <= one.sighting.pixels.keys()
    assert follow(head, hidden_from(list(drawn_studio().names), drawn_pictures()), networks) is None
