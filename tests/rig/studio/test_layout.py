"""Rigs of many kinds: rows, circles, cameras on their side; the head keeps its size in the picture."""

import numpy as np
import pytest

from rig.rig import Rig
from rig.studio.scene.layout import DEFAULT_DIRECTIONS_DEG, default_layout, rig_from_directions
from tests.support.layouts import circle_directions, row_directions


def size_px(rig: Rig, name: str) -> float:
    """Of 100 mm upwards at the middle of the head."""
    ends = rig[name].project(np.array([[0.0, -50.0, 0.0], [0.0, 50.0, 0.0]]))
    return float(np.linalg.norm(ends[1] - ends[0]))


@pytest.mark.parametrize("distance_mm", [400.0, 1200.0, 3000.0])
def test_a_head_keeps_its_size_at_every_distance(distance_mm: float) -> None:
    rig = rig_from_directions(((0, 0),), distance_mm=distance_mm)
    assert np.linalg.norm(rig["cam00"].centre_world) == pytest.approx(distance_mm, rel=0.1)
    assert size_px(rig, "cam00") == pytest.approx(183.0, rel=0.1)


@pytest.mark.parametrize(("roll_deg", "up"), [(0.0, (0, -1)), (90.0, (-1, 0)), (180.0, (0, 1)), (-90.0, (1, 0))])
def test_rolled_cameras_see_the_head_turned(roll_deg: float, up: tuple[int, int]) -> None:
    """A camera that is turned clockwise shows the head turned anticlockwise."""
    camera = rig_from_directions(((20, 10),), rolls_deg=(roll_deg,))["cam00"]
    low, high = camera.project(np.array([[0.0, -50.0, 0.0], [0.0, 50.0, 0.0]]))
    along = (high - low) / np.linalg.norm(high - low)
    assert along @ np.array(up) > np.cos(np.radians(8.0))


def test_mounting_and_distance_leave_the_default_rig_as_it_was() -> None:
    ours, default = rig_from_directions(DEFAULT_DIRECTIONS_DEG), default_layout()
    for camera in default:
        assert np.array_equal(ours[camera.name].camera_from_world.rotation, camera.camera_from_world.rotation)
        assert ours[camera.name].intrinsics == camera.intrinsics


def test_a_row_is_evenly_spaced_and_a_circle_goes_all_around_from_the_front() -> None:
    at = [1000.0 * np.tan(np.radians(azimuth)) for azimuth, _ in row_directions(3, 100.0, 1000.0)]
    assert at == pytest.approx([-100.0, 0.0, 100.0])
    found = circle_directions(8, (0.0, 20.0))
    assert found[0] == (0.0, 0.0)
    assert [elevation for _, elevation in found] == [0.0, 20.0] * 4
    assert sorted(azimuth % 360.0 for azimuth, _ in found) == pytest.approx(np.arange(8) * 45.0)
