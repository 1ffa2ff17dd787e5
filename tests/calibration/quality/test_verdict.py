"""A calibration is as good as its weakest camera, and what it lacks is named by camera."""

from dataclasses import replace

import pytest

from calibration.quality.checks import CameraEvidence, Check, judge
from rig.messages.message import verbatim

SOUND = CameraEvidence(views=12, focal_share=0.004, pose_sigma_px=0.1, covered=0.6)
HELD_OUT = Check("held-out shots", True, verbatim(""))


@pytest.mark.parametrize(
    ("weak", "word", "reason"),
    [
        ({}, "good", None),
        ({"views": 5}, "usable", "cam02: fewer than 6 views of the board"),
        ({"views": 2}, "poor", "cam02: fewer than 3 views of the board"),
        ({"focal_share": 0.02}, "usable", "cam02: the focal length is uncertain by more than 1 %"),
        ({"focal_share": 0.05}, "poor", "cam02: the focal length is uncertain by more than 3 %"),
        ({"pose_sigma_px": 0.7}, "usable", "cam02: the pose is uncertain by more than 0.5 px"),
        ({"pose_sigma_px": float("inf")}, "poor", "cam02: the pose is uncertain by more than 1.0 px"),
        ({"covered": 0.2}, "usable", "cam02: the board was never near the border"),
    ],
)
def test_the_weakest_camera_decides(weak: dict[str, float], word: str, reason: str | None) -> None:
    cameras = {f"cam{i:02}": SOUND for i in range(4)} | {"cam02": replace(SOUND, **weak)}
    verdict = judge(cameras, [HELD_OUT])
    assert verdict.word == word
    assert [missing.text.startswith(reason or "") for missing in verdict.missing] == [True] * (reason is not None)


def test_shots_that_none_could_be_held_out_of_are_usable_at_most() -> None:
    verdict = judge({"cam00": SOUND, "cam01": SOUND}, [Check("held-out shots", None, verbatim("too few"))])
    assert verdict.word == "usable"
    assert "take 15 in all" in verdict.missing[0].text
