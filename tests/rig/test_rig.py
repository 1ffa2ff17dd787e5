"""Cameras by their names, and those that are chosen evenly spaced."""

import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.errors import EigenheadError
from rig.geometry import RigidTransform
from rig.rig import Rig, UnknownCamera, spread_views
from tests.support.textured_wedge import wedge_rig

LENS = Intrinsics(640, 480, 800.0, 800.0, 319.5, 239.5)


def rig_of(*names: str) -> Rig:
    return Rig(tuple(Camera(name, LENS, RigidTransform(np.eye(3), np.zeros(3))) for name in names))


def test_a_camera_is_found_by_its_name_and_another_name_is_an_error_that_says_which_there_are() -> None:
    rig = rig_of("left", "right")
    assert rig["right"] is rig.cameras[1]
    with pytest.raises(KeyError) as caught:
        rig["middle"]
    assert isinstance(caught.value, EigenheadError)
    assert str(caught.value) == "the rig has no camera 'middle'; its cameras are left, right"
    with pytest.raises(UnknownCamera, match="the rig has no camera 'left'; it has no cameras at all"):
        rig_of()["left"]
    with pytest.raises(UnknownCamera):  # no StopIteration, which would end the loop
        list(rig_of("left")[name] for name in ("left", "middle"))


def test_views_are_spread_from_the_front_one_on_and_none_is_chosen_twice() -> None:
    rig = wedge_rig(np.linspace(-60, 60, 13).tolist())
    front, *others = spread_views(rig, 3)
    assert front == rig.front_camera()
    assert sorted(others) == ["cam00", "cam12"]  # both ends of the arc
    assert sorted(spread_views(rig, 99)) == sorted(rig.names)
