"""Heads with open, half closed and closed eyes: what is photographed, and what counts as wrong."""

from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from pipeline.warnings import ReportWarning
from rig.errors import EigenheadError
from rig.messages.message import Message
from tests.laboratory.experiments.people.eye_states import (
    STATES,
    blink_of,
    closed_sides,
    eye_row,
    figures,
    photograph_eyes,
    table,
    warned_sides,
)

if TYPE_CHECKING:
    from pipeline.results.reconstruction import Reconstruction
    from rig.capture import Capture
    from rig.render.renderer import Renderer
    from rig.rig import Rig


def eyes_closed(text: str, code: str = "eyes-closed") -> ReportWarning:
    return Message(code, {}, text)


def test_the_eyes_are_those_that_the_warning_names() -> None:
    assert warned_sides([eyes_closed("both eyes are closed: no white")]) == {"right", "left"}
    assert warned_sides([eyes_closed("the left eye is closed: no white")]) == {"left"}
    assert warned_sides([eyes_closed("the left eye is closed", "view")]) == frozenset()
    assert warned_sides([]) == frozenset()


def test_every_fourth_head_moves_one_eye_and_wrong_heads_are_counted_by_state() -> None:
    assert [len(closed_sides(number)) for number in range(8)] == [1, 2, 2, 2, 1, 2, 2, 2]
    rows = [
        {"name": "a", "state": "open", "closed": [], "told": ["left"], "is_wrong": True},
        {"name": "b", "state": "half", "closed": [], "told": [], "is_wrong": False},
        {"name": "c", "state": "closed", "closed": ["left", "right"], "refused": "no view", "is_wrong": True},
    ]
    found = figures(rows)
    assert (found["eyes_wrong"], found["eyes_heads"]) == (2, 3)
    assert [found[f"eyes_{state}_wrong"] for state in STATES] == [1, 0, 1]
    assert [line.split(" | ")[-1] for line in table(rows).splitlines()[2:]] == ["wrong |", "- |", "wrong |"]


@pytest.mark.slow
@pytest.mark.gl
def test_lids_are_photographed_closed(renderer: "Renderer") -> None:
    """Of the same head: the pictures differ between the states where an eye is, and a half is between."""
    model = load_model()
    shots = {state: photograph_eyes(model, 1, share, renderer) for state, share in STATES.items()}
    marks = shots["open"].scene.landmarks_world
    at = shots["open"].rig["cam00"].project(np.array([marks["exocanthion_left"], marks["endocanthion_left"]]))
    column, row = np.rint(at.mean(axis=0)).astype(int)
    eye = {state: shot.capture.images["cam00"][row - 12 : row + 12, column - 20 : column + 20].astype(float)
           for state, shot in shots.items()}  # fmt: skip
    assert np.abs(eye["closed"] - eye["open"]).mean() > 10.0
    assert blink_of(model, "left") == "eyeBlinkLeft"


@pytest.mark.slow
@pytest.mark.gl
def test_a_refusal_is_wrong_and_a_row(renderer: "Renderer") -> None:
    def fail(capture: "Capture", rig: "Rig") -> "Reconstruction":
        raise EigenheadError("no view shows a head")

    found = eye_row(load_model(), 0, "closed", fail, renderer)
    assert found == {"closed": ["right"], "refused": "no view shows a head", "is_wrong": True}
