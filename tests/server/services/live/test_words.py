"""What is said of a look follows from where the head is and what the cameras show."""

from dataclasses import replace

import numpy as np
import pytest

from rig.geometry import rotation_from_vector
from server.services.live.seen import CameraSeen, HeadOut, Seen
from server.services.live.words import HOLD_S, STEADY_S, Speaker, lamps_of, reasons_of

CAMERA = CameraSeen(130.0, 1.0, 0.0, 0.3, facing=0.8, face=True, centred=True)
HEAD = HeadOut(
    rotation=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
    translation=(0.0, 0.0, 0.0),
    scale=1.0,
    left_deg=3.0,
    up_deg=-4.0,
    right_mm=10.0,
    down_mm=-20.0,
    away_mm=30.0,
    room_mm=60.0,
    depth_mm=85.0,
    openings={"left": 0.2, "right": 0.22},
    eyes_open=True,
    vertices=(),
    triangles=(),
)
CAMERAS = {f"cam{k}": CAMERA for k in range(4)}
GOOD = Seen(CAMERAS, HEAD, True, True)


def with_camera(**changes: object) -> Seen:
    return replace(GOOD, cameras={**CAMERAS, "cam2": replace(CAMERA, **changes)})


def codes(seen: Seen) -> list[tuple[str, str | None]]:
    return [(word.message.code, word.camera) for word in reasons_of(seen)]


def test_nothing_is_said_of_a_good_subject() -> None:
    assert codes(GOOD) == []
    assert {lamp for lamps in lamps_of(GOOD).values() for lamp in (lamps.face, lamps.sharp, lamps.exposed)} == {True}


@pytest.mark.parametrize(
    ("changes", "code", "text"),
    [
        ({"left_deg": 20.4}, "live-turn-right", "turn right by 20 degrees"),
        ({"left_deg": -20.4}, "live-turn-left", "turn left by 20 degrees"),
        ({"up_deg": 28.0}, "live-chin-down", "lower your chin"),
        ({"up_deg": -28.0}, "live-chin-up", "raise your chin"),
        ({"away_mm": 120.0}, "live-closer", "come closer by 12 cm"),
        ({"away_mm": -120.0}, "live-back", "go back by 12 cm"),
        ({"down_mm": 70.0}, "live-higher", "sit higher by 7 cm"),
        ({"down_mm": -70.0}, "live-lower", "sit lower by 7 cm"),
        ({"right_mm": 70.0}, "live-move-right", "move to your right by 7 cm"),
        ({"right_mm": -70.0}, "live-move-left", "move to your left by 7 cm"),
        ({"eyes_open": False}, "live-eyes-shut", "open your eyes"),
    ],
)
def test_the_subject_is_told_what_to_do(changes: dict[str, object], code: str, text: str) -> None:
    (word,) = reasons_of(replace(GOOD, head=HEAD.model_copy(update=changes)))
    assert (word.message.code, word.message.text, word.camera) == (code, text, None)


@pytest.mark.parametrize(
    ("changes", "code", "lamp"),
    [
        ({"light": 0.7}, "live-darker", "exposed"),
        ({"light": 1.5}, "live-brighter", "exposed"),
        ({"light": 0.06}, "live-black", "exposed"),
        ({"clipped": 0.1}, "live-burnt-out", "exposed"),
        ({"blur_px": 1.5}, "live-soft", "sharp"),
        ({"face": False}, "live-no-face", "face"),
        ({"face": False, "stranger": True}, "live-stranger", "face"),
        ({"centred": False}, "live-off-centre", "centred"),
    ],
)
def test_a_camera_is_named_and_its_lamp_goes_out(changes: dict[str, object], code: str, lamp: str) -> None:
    seen = with_camera(**changes)
    assert codes(seen) == [(code, "cam2")]
    assert [name for name, lamps in lamps_of(seen).items() if getattr(lamps, lamp) is False] == ["cam2"]


def test_light_is_judged_by_the_other_cameras_without_plates() -> None:
    bare = {name: replace(CAMERA, light=None) for name in CAMERAS}
    assert codes(replace(GOOD, cameras=bare)) == []
    assert codes(replace(GOOD, cameras={**bare, "cam2": replace(CAMERA, light=None, mean=60.0)})) == [
        ("live-darker-than-others", "cam2")
    ]


def test_lamps_that_are_off_are_told_once() -> None:
    dark = {name: replace(CAMERA, light=0.1, mean=12.0) for name in CAMERAS}
    assert codes(replace(GOOD, cameras=dark)) == [("live-lights", None)]


def test_it_is_said_when_there_is_no_head() -> None:
    assert codes(replace(GOOD, head=None, faces=False)) == [("live-nobody", None)]
    assert codes(replace(GOOD, head=None)) == [("live-faces-differ", None)]
    assert codes(replace(GOOD, head=None, calibrated=False)) == [("live-uncalibrated", None)]
    assert codes(Seen({}, None, False, True)) == [("live-no-pictures", None)]


def test_a_blink_is_not_told() -> None:
    speaker, shut = Speaker(), replace(GOOD, head=HEAD.model_copy(update={"eyes_open": False}))
    assert speaker.words(shut, 0.0) == ()
    assert speaker.words(GOOD, 0.25) == ()
    assert speaker.words(shut, 0.5) == ()
    assert [word.message.code for word in speaker.words(shut, 0.5 + HOLD_S)] == ["live-eyes-shut"]
    assert speaker.words(GOOD, 1.2) == ()


def test_a_dark_camera_is_told_at_once() -> None:
    assert [word.message.code for word in Speaker().words(with_camera(light=0.7), 0.0)] == ["live-darker"]


def test_a_head_is_steady_when_it_has_kept_its_pose_for_a_while() -> None:
    speaker, times = Speaker(), np.arange(0.0, 3.0 * STEADY_S, 0.2)
    assert [speaker.steady(HEAD, time_s) for time_s in times.tolist()] == [time_s >= STEADY_S for time_s in times]
    turned = tuple(rotation_from_vector(np.radians([0.0, 4.0, 0.0])).ravel().tolist())
    last_s = float(times[-1])
    assert not speaker.steady(HEAD.model_copy(update={"rotation": turned}), last_s + 0.2)
    assert not speaker.steady(HEAD.model_copy(update={"rotation": turned}), last_s + 0.4)
    assert speaker.steady(HEAD.model_copy(update={"rotation": turned}), last_s + 0.5 + STEADY_S)
    assert not speaker.steady(None, last_s + 3.0)
    assert not speaker.steady(HEAD, last_s + 3.2)
