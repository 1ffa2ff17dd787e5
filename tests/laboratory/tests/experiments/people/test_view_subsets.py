"""Subsets of a rig's views: the most frontal cameras of a turned head, and even ones of a circle."""

import numpy as np
import pytest

from rig.geometry import Similarity, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout, rig_from_directions
from tests.laboratory.experiments.people.view_subsets import even_views, frontal_views, is_circle
from tests.support.layouts import circle_directions, row_directions


def facing(yaw_deg: float) -> Similarity:
    """A head that looks ``yaw_deg`` to its left."""
    return Similarity(1.0, rotation_from_vector(np.radians([0.0, yaw_deg, 0.0])), np.zeros(3))


def azimuths(rig: Rig, names: tuple[str, ...]) -> np.ndarray:
    x, _, z = np.array([rig[name].centre_world for name in names]).T
    return np.sort(np.degrees(np.arctan2(x, z)))


def test_the_most_frontal_cameras_are_those_that_the_face_looks_at_and_a_fan_is_no_circle() -> None:
    rig = default_layout()
    assert frontal_views(rig, facing(0.0), 1) == ("cam00",)
    assert set(frontal_views(rig, facing(90.0), 2)) == {"cam08", "cam10"}
    assert frontal_views(rig, facing(0.0), 11) == rig.names
    assert not is_circle(default_layout(), facing(0.0))
    assert not is_circle(rig_from_directions(row_directions(3, 100.0, 500.0)), facing(0.0))
    assert is_circle(rig_from_directions(circle_directions(8)), facing(30.0))


@pytest.mark.parametrize("count", [5, 8, 11, 12, 16])
def test_even_views_of_a_circle_are_even_and_one_is_frontal(count: int) -> None:
    rig = rig_from_directions(circle_directions(24, (0.0, 20.0)))
    names = even_views(rig, facing(0.0), count)
    found = azimuths(rig, names)
    gaps = np.diff(found, append=found[0] + 360.0)
    assert len(set(names)) == count
    assert "cam00" in names
    assert gaps.max() < 360.0 / count + 15.0 + 4.0  # cameras stand 15 degrees apart and a little off
    assert gaps.min() > 360.0 / count - 15.0 - 4.0
    assert is_circle(rig.subset(names), facing(0.0))
