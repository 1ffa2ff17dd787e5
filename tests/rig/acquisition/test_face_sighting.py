"""What a verdict says of the face: nothing where all is well, and one line where there is none."""

import pytest

from rig.acquisition.face_sighting import FaceSighting, face_remarks
from rig.acquisition.shot import Fault
from rig.messages.message import compose, texts_of

WELL = FaceSighting(5, True, True, "cam00", (), 3.0, -8.0)


def turned(left_deg: float, up_deg: float, missing: tuple[str, ...] = ()) -> FaceSighting:
    return FaceSighting(5, True, True, "cam00", missing, left_deg, up_deg)


def test_a_face_that_looks_into_the_front_camera_is_passed_over_and_no_face_is_one_line_at_most() -> None:
    assert face_remarks(WELL, ()) == ()
    assert face_remarks(None, ()) == ()
    assert face_remarks(FaceSighting(9, True, True, "cam00"), ()) == ()  # of a ring, which has no front
    statue = FaceSighting(6, False, False, "cam00")
    assert [remark.code for remark in face_remarks(statue, ())] == ["face-nowhere"]
    assert face_remarks(FaceSighting(6, False, True, "cam00"), ()) == ()  # posters: nobody knows whose
    assert face_remarks(statue, [Fault("empty", None, compose("nobody-in-pictures"))]) == ()


@pytest.mark.parametrize(
    ("left_deg", "up_deg", "way"),
    [
        (25.0, 0.0, "25 degrees to the subject's left"),
        (-31.2, 9.0, "31 degrees to the subject's right"),
        (0.0, 17.0, "17 degrees up"),
        (14.9, -22.0, "22 degrees down"),
        (16.0, -22.0, "16 degrees to the subject's left and 22 degrees down"),
    ],
)
def test_a_turned_face_is_told_with_its_angle(left_deg: float, up_deg: float, way: str) -> None:
    (remark,) = face_remarks(turned(left_deg, up_deg), ())
    assert remark.code == "face-turned"
    assert remark.text == f"the face looks {way}, seen from the front camera cam00: have the subject look there"


def test_cameras_without_the_face_are_named_unless_a_fault_explains_it() -> None:
    sighting = turned(0.0, 0.0, ("cam03", "cam04"))
    assert [remark.parameters["cameras"] for remark in face_remarks(sighting, ())] == [("cam03", "cam04")]
    dark = Fault("dark", "cam03", compose("picture-dark", percent=4.0))
    assert texts_of(face_remarks(sighting, [dark]))[0].startswith("no face was found in cam04, although")
    unset = Fault("plates", "cam04", compose("camera-without-plates"))
    assert [remark.parameters["cameras"] for remark in face_remarks(sighting, [dark, unset])] == [("cam04",)]
