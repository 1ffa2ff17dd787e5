"""The verdict on a capture, from its pictures and from its faults."""

import numpy as np
import pytest

from rig.acquisition.shot import Fault
from rig.acquisition.verdict import check_view, verdict_of, view_faults
from rig.formats.rig_toml import ShotConfig
from rig.messages.message import verbatim
from tests.support.textured_studio import NAMES, FlatStudio

EMPTY, SEATED = FlatStudio(False, 640, 480), FlatStudio(True, 640, 480)


@pytest.mark.parametrize(
    ("faulty", "cameras", "verdict"),
    [
        ([], 11, "good"),
        (["cam03"], 11, "usable"),
        (["cam01", "cam02"], 11, "usable"),
        (["cam01", "cam02", "cam03"], 11, "poor"),  # eight sound ones are less than three quarters
        (["cam01", "cam01"], 11, "usable"),
        ([None], 11, "poor"),
        (["cam01"], 4, "usable"),
        (["cam01"], 3, "poor"),
    ],
)
def test_the_verdict_follows_from_cameras_without_a_fault(faulty: list[str | None], cameras: int, verdict: str) -> None:
    assert verdict_of([Fault("moved", camera, verbatim("")) for camera in faulty], NAMES[:cameras]) == verdict


def test_who_is_not_in_the_picture_is_named() -> None:
    views = {name: check_view(SEATED(name, 0.0), EMPTY(name, 0.0), None) for name in NAMES[:4]}
    assert view_faults(views, ShotConfig()) == []
    views["cam01"] = check_view(EMPTY("cam01", 0.0), EMPTY("cam01", 0.0), None)
    wall, seated = EMPTY("cam02", 0.0), SEATED("cam02", 0.0)
    high = np.vstack([seated[200:], wall[280:]])  # the head's top is 56 px above the picture
    wall = np.vstack([wall[200:], wall[280:]])
    views["cam02"] = check_view(high, wall, None, place_only=True)
    found = {(fault.code, fault.camera) for fault in view_faults(views, ShotConfig())}
    assert found == {("empty", "cam01"), ("cut-off", "cam02")}
    nobody = {name: check_view(EMPTY(name, 0.0), EMPTY(name, 0.0), None) for name in NAMES[:4]}
    assert [(fault.code, fault.camera) for fault in view_faults(nobody, ShotConfig())] == [("empty", None)]


def test_a_mask_shows_the_subject_where_there_is_no_plate() -> None:
    image = SEATED("cam00", 0.0)
    mask = np.zeros(image.shape[:2], bool)
    mask[100:, 200:400] = True
    document = check_view(image, None, mask).document()
    subject = document.get("subject")
    assert subject is not None
    assert subject["share"] == pytest.approx(mask.mean(), rel=0.03)
    assert "subject" not in check_view(image, None, None).document()
