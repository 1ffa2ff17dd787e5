"""Cameras on an arc: those chosen are evenly spaced."""

import numpy as np

from rig.rig import spread_views
from tests.support.textured_wedge import wedge_rig


def test_views_are_spread_from_the_front_one_on_and_none_is_chosen_twice() -> None:
    rig = wedge_rig(np.linspace(-60, 60, 13).tolist())
    front, *others = spread_views(rig, 3)
    assert front == rig.front_camera()
    assert sorted(others) == ["cam00", "cam12"]  # both ends of the arc
    assert sorted(spread_views(rig, 99)) == sorted(rig.names)
