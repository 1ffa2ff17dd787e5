"""What tests plant: wrong contours, loose masks, close-ups, cameras that are off, and expressions."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from rig.studio.scene.layout import default_layout
from tests.support.drawn_expressions import JAW, WEIGHTS, drawn_weights
from tests.support.spoilt_captures import CLOSE_UP, LOOSE_PX, WRONG_RADII_PX, WRONG_SHARE, close_up, loosened, spoiled
from tests.support.subjects import off_by, stated


def test_a_fifth_of_the_contour_is_wrong() -> None:
    rows, columns = np.ogrid[:300, :400]
    mask = (rows - 150) ** 2 + (columns - 200) ** 2 < 100**2
    wrong = spoiled(mask, np.random.default_rng(1))
    edge = 2 * np.pi * 100
    changed = np.argwhere(wrong != mask)
    angle = np.arctan2(changed[:, 0] - 150, changed[:, 1] - 200)
    share = len(np.unique((angle / (2 * np.pi) * 400).astype(int))) / 400
    assert WRONG_SHARE - 0.02 < share < WRONG_SHARE + 2 * WRONG_RADII_PX[1] / edge + 0.02
    assert (wrong & ~mask).any()
    assert (mask & ~wrong).any()


def test_cameras_are_off_by_what_was_asked() -> None:
    """Mean square motion of points on a sphere of 100 mm radius, in squares of what was asked: along each image axis 1
    of tilt and slide, and 1/3 each of roll and range."""
    rig, rng = default_layout(), np.random.default_rng(3)
    directions = rng.standard_normal((200, 3))
    points = rig.centre_world() + 100.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    squares = []
    for _ in range(30):
        off = off_by(rig, 0.5, rng)
        squares += [((off[c.name].project(points) - c.project(points)) ** 2).sum(axis=1).mean() for c in rig]
    # 330 cameras with about three numbers each that dominate: a standard error of 4 % in squares.
    assert np.mean(squares) == pytest.approx(0.5**2 * 2 * (1 + 1 / 3 + 1 / 3), rel=0.16)
    assert all(camera.covariance is not None for camera in stated(rig, 0.5))


def test_draws_are_faces_that_people_make() -> None:
    names, smiles = load_model().expressions.names, 0
    for seed in range(60):
        weights = drawn_weights(np.random.default_rng(seed), names)
        assert all(0.0 < weight <= 1.0 for weight in weights.values())
        assert weights.get("jawOpen", 0.0) <= JAW * WEIGHTS[1]
        assert weights.get("mouthClose", 0.0) <= 0.5 * weights.get("jawOpen", 0.0)
        sides = [weights.get(f"mouthSmile{side}", 0.0) for side in ("Left", "Right")]
        smiles += min(sides) > 0.0
        assert seed < 0 or min(sides) == 0.0 or abs(sides[0] - sides[1]) < 0.5
    assert 22 < smiles < 50  # 60 of 0.6, within four deviations


def test_loose_masks_reach_farther_on_every_side():
    rows, columns = np.ogrid[:120, :160]
    disk = silhouette_from_mask((rows - 60) ** 2 + (columns - 80) ** 2 < 30**2)
    (loose,) = loosened({"cam": disk}).values()
    np.testing.assert_allclose(disk.distance[60, 75:] - loose.distance[60, 75:], LOOSE_PX, atol=0.5)


def test_a_close_up_shows_the_crown_lower():
    camera = default_layout()["cam00"]
    near, crown = close_up(camera), np.array([[0.0, 120.0, 0.0]])
    assert near.intrinsics.fx == CLOSE_UP * camera.intrinsics.fx
    assert 0.0 < near.project(crown)[0, 1] < near.intrinsics.height / 2
