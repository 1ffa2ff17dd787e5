"""What the dense stage's points say, by their votes."""

import numpy as np

from pipeline.dense.part_codes import Part
from pipeline.dense.part_votes import PartVotes
from pipeline.fitting.fine.dense_points import dense_points
from pipeline.settings import FineSettings
from rig.mesh import Mesh
from tests.pipeline.dense.test_part_votes import seen_wall, wall_camera

SETTINGS = FineSettings(views_least=2)


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
        found.append(dense_points([seen_wall(camera)], votes, wall_head(), SETTINGS))
    sure, doubtful, hair = found
    assert len(sure.points) > 0
    for surface, part in ((sure, Part.SKIN), (doubtful, Part.SKIN), (hair, Part.HAIR)):
        assert (surface.part == part).all()
    expected = np.sqrt(sure.deviation_mm**2 + 0.3 * SETTINGS.hair_off_mm**2)
    np.testing.assert_allclose(doubtful.deviation_mm, expected, rtol=1e-6)
    np.testing.assert_allclose(hair.deviation_mm, sure.deviation_mm)
