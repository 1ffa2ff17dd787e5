"""Cameras by their names."""

import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.errors import EigenheadError
from rig.geometry import RigidTransform
from rig.rig import Rig, UnknownCamera

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
