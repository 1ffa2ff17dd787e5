"""Pictures beside the results: tints against the formula."""

import numpy as np

from pipeline.results.overlays import DARKEST, LAMP, SKIN, clay, lit
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid

BALL = ellipsoid(3)
WHITE = (255, 255, 255)


def area(mesh: Mesh, box: tuple[np.ndarray, np.ndarray]) -> int:
    return int((clay(mesh, panel=(120, 160), box=box, paper=WHITE) < 250).any(axis=2).sum())


def test_the_side_to_the_lamp_is_bright_and_the_other_is_not_black() -> None:
    normals, colours = BALL.normals(), lit(BALL)
    towards = normals @ LAMP
    np.testing.assert_allclose(colours[towards.argmin()], DARKEST * SKIN, atol=1.0)
    np.testing.assert_allclose(colours[towards.argmax()], SKIN, atol=2.0)
    blue = np.tile(np.array([0, 0, 200], np.uint8), (len(normals), 1))
    assert lit(BALL, blue, darkest=1.0).tolist() == blue.tolist()


def test_a_box_shows_a_head_of_half_the_size_at_half_the_size() -> None:
    box = (BALL.vertices.min(axis=0), BALL.vertices.max(axis=0))
    middle = (box[0] + box[1]) / 2
    half = Mesh(middle + (BALL.vertices - middle) / 2, BALL.faces)
    assert 0.22 < area(half, box) / area(BALL, box) < 0.27  # a quarter, less perspective
