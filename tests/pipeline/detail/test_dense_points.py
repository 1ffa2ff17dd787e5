"""What the dense stage's points say, by their votes."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.detail.dense_points import HAIR_OFF_MM, SurfacePoints, count_views_needed, dense_points, thin
from pipeline.fusion.view_stack import ALONE_FACTOR
from pipeline.part_labels.codes import Part
from pipeline.part_labels.votes import PartVotes
from rig.mesh import Mesh
from tests.pipeline.part_labels.test_votes import seen_wall, wall_camera
from tests.pipeline.stereo.ray_scene import fan


def wall_head() -> Mesh:
    """A square on the wall that the cameras see."""
    corner = 40.0 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    grid = np.repeat(corner, 4, axis=0)  # every fourth vertex stands for the others
    return Mesh(grid, np.array([[0, 8, 4], [0, 12, 8]]))


def test_a_point_that_may_be_hair_is_less_sure_by_what_hair_stands_off() -> None:
    camera = wall_camera("a", 0.0)
    found = []
    for skin in (1.0, 0.7, 0.4):
        votes = PartVotes(np.full(3, -100.0), np.ones(3, int), np.zeros(1, int), np.zeros((1, 3)),
                          np.array([[skin, 1.0 - skin, 0.0]]))  # fmt: skip
        found.append(dense_points([seen_wall(camera)], votes, wall_head()))
    sure, doubtful, hair = found
    assert len(sure.points) > 0
    for surface, part in ((sure, Part.SKIN), (doubtful, Part.SKIN), (hair, Part.HAIR)):
        assert (surface.part == part).all()
    expected = np.sqrt(sure.deviation_mm**2 + 0.3 * HAIR_OFF_MM**2)
    np.testing.assert_allclose(doubtful.deviation_mm, expected, rtol=1e-6)
    np.testing.assert_allclose(hair.deviation_mm, sure.deviation_mm)


@pytest.mark.parametrize(
    ("count", "step_deg", "needed"),
    [(2, 20.0, 2), (3, 10.0, 2), (5, 20.0, 2), (6, 12.0, 3), (8, 45.0, 2), (11, 12.0, 4), (24, 15.0, 4)],
)
def test_fewer_views_must_agree_where_fewer_can(count: int, step_deg: float, needed: int) -> None:
    # Within 65 degrees of a camera lie, itself counted, 3 of a ring of eight, 11 of a fan 12 degrees apart, 9 of 24.
    assert count_views_needed(list(fan(count, step_deg)), np.zeros(3)) == needed


def test_what_two_views_agree_on_is_less_sure() -> None:
    seen, skin = seen_wall(wall_camera("a", 0.0)), np.array([[1.0, 0.0, 0.0]])
    votes = PartVotes(np.full(3, -100.0), np.ones(3, int), np.zeros(1, int), np.zeros((1, 3)), skin)
    of_two, of_three = (
        dense_points([replace(seen, views=np.full_like(seen.views, views))], votes, wall_head()) for views in (2, 3)
    )
    np.testing.assert_allclose(of_two.deviation_mm, ALONE_FACTOR * of_three.deviation_mm)
    np.testing.assert_allclose(of_two.points, of_three.points, atol=1e-9)


def test_points_of_one_cell_part_and_side_become_their_mean_by_information() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.5, 0.3, 0.1], [0.2, 0.1, 0.1], [0.2, 0.1, 0.3], [1.6, 0.1, 0.1]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    part = np.array([Part.SKIN, Part.SKIN, Part.SKIN, Part.HAIR, Part.SKIN], np.uint8)
    found = thin(SurfacePoints(points, normals, np.array([1.0, 0.5, 1.0, 1.0, 1.0]), part), 1.5)
    assert len(found.points) == 4
    joined = np.flatnonzero(found.deviation_mm < 0.9)
    np.testing.assert_allclose(found.points[joined], [(points[0] + 4.0 * points[1]) / 5.0])
    mean = normals[0] + 4.0 * normals[1]
    np.testing.assert_allclose(found.normals[joined], [mean / np.linalg.norm(mean)])
    np.testing.assert_allclose(found.deviation_mm[joined], np.sqrt(2.0 / 5.0))
    assert sorted(found.part) == sorted([Part.SKIN, Part.SKIN, Part.HAIR, Part.SKIN])


def test_every_cell_keeps_one_of_many_points() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(-20.0, 20.0, (2000, 3))
    normals = np.tile([1.0, 0.0, 0.0], (2000, 1))
    found = thin(SurfacePoints(points, normals, np.ones(2000), np.zeros(2000, np.uint8)), 5.0)
    cells = np.unique(np.floor((points - points.min(axis=0)) / 5.0).astype(int), axis=0, return_counts=True)
    np.testing.assert_array_equal(np.floor((found.points - points.min(axis=0)) / 5.0), cells[0])
    np.testing.assert_allclose(found.deviation_mm, 1.0)
