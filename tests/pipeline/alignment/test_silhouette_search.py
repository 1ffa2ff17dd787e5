"""The search begins as the body stands, however cameras are mounted, and all around where a fan has no middle."""

import numpy as np
import pytest

from pipeline.alignment.silhouette_search import body_up, fan_strength, turn_between_deg, upright_axes
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.geometry import RigidTransform, Similarity, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout, rig_from_directions
from tests.support.changed_rigs import reposed
from tests.support.layouts import circle_directions

UP = np.array([0.0, 1.0, 0.0])


def rolled(rig: Rig, turn_deg: float) -> Rig:
    """The rig with every camera turned about its axis; pictures are square, so that sizes stay."""
    roll = RigidTransform(rotation_from_vector(np.radians([0.0, 0.0, turn_deg])), np.zeros(3))
    return reposed(rig, lambda pose: roll @ pose)


def standing(rig: Rig) -> dict[str, Silhouette]:
    """A head with a trunk that leaves every picture downwards in the world."""
    found = {}
    for camera in rig:
        k = camera.intrinsics
        mask = np.zeros((k.height, k.width), bool)
        middle = rig.centre_world()
        body = middle - np.arange(0.0, 900.0, 4.0)[:, None] * UP
        for x, y in camera.project(body):
            if np.isfinite([x, y]).all():
                row, column = round(float(y)), round(float(x))
                mask[max(row - 40, 0) : max(row + 40, 0), max(column - 40, 0) : max(column + 40, 0)] = True
        found[camera.name] = silhouette_from_mask(mask)
    return found


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, -90.0, 37.0])
def test_up_is_away_from_where_the_body_leaves_the_pictures(turn_deg: float) -> None:
    rig = rolled(default_layout().scaled(0.25), turn_deg)
    up = body_up(standing(rig), rig)
    assert up is not None
    assert up @ UP > 0.85  # a picture's corner is 37 degrees off its border


def test_a_head_that_leaves_no_picture_says_nothing_of_up() -> None:
    rig = default_layout().scaled(0.25)
    inside = np.zeros((rig.cameras[0].intrinsics.height, rig.cameras[0].intrinsics.width), bool)
    inside[60:90, 100:140] = True
    assert body_up({name: silhouette_from_mask(inside) for name in rig.names}, rig) is None


def test_a_ring_has_no_middle_and_a_fan_has() -> None:
    assert fan_strength(rig_from_directions(circle_directions(12))) < 0.3
    assert fan_strength(default_layout()) > 0.5


def test_upright_axes_look_forward_and_stand_up_and_the_turn_between_poses_is_an_angle() -> None:
    forward = np.array([0.3, 0.2, 0.9])
    axes = upright_axes(UP, forward)
    np.testing.assert_allclose(axes[:, 2], forward / np.linalg.norm(forward))
    assert axes[:, 1] @ UP > 0.9
    assert np.linalg.det(axes) == pytest.approx(1.0)
    one = Similarity.identity()
    other = Similarity(1.2, rotation_from_vector(np.radians([0.0, 170.0, 0.0])), np.ones(3))
    assert turn_between_deg(one, other) == pytest.approx(170.0)
