"""Shapes that would push one sheet of a mesh through another."""

import numpy as np
import pytest

from pipeline.applications.templates.contact import WEIGHTS, crossing_vertices, keep_apart, prepare_rest_surface
from rig.studio.scene.anatomy import grid_faces

SIDE, EVERY = 21, tuple(k / 8 for k in range(1, 9))


def sheets(gap_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Two square sheets of 20 mm over each other, the upper one facing up and the lower one down, and which vertices
    are the upper one's."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    up = grid_faces(SIDE, SIDE, closed=False)[:, ::-1]
    lower = np.stack([x + 0.37, y + 0.21, np.zeros(len(x))], axis=1).astype(float)
    upper = np.stack([x, y, np.full(len(x), gap_mm)], axis=1).astype(float)
    return np.concatenate([lower, upper]), np.concatenate([up[:, ::-1], up + len(lower)]).astype(np.int32)


def dent(vertices: np.ndarray, depth_mm: float) -> np.ndarray:
    """The middle of the upper sheet pushed down."""
    upper = np.arange(len(vertices)) >= len(vertices) // 2
    out = np.zeros_like(vertices)
    reach = np.linalg.norm(vertices[:, :2] - 10.0, axis=1)
    out[:, 2] = np.where(upper, -depth_mm * np.exp(-0.5 * (reach / 3.0) ** 2), 0.0)
    return out


def test_lips_that_touch_move_together_and_do_not_cross() -> None:
    vertices, faces = sheets(gap_mm=0.3)
    rest, pressed = prepare_rest_surface(vertices, faces), dent(vertices, 4.0)
    assert all(crossing_vertices(rest, pressed, (weight,)).any() for weight in WEIGHTS)
    found = keep_apart(rest, pressed, closing=False)
    assert not crossing_vertices(rest, found, EVERY).any()
    lower = slice(0, SIDE * SIDE)
    assert found[lower, 2].min() < -0.5  # the other lip gives way
    assert found[:, 2].min() < -1.0  # and the one that pushes still does


def test_lids_stop_where_they_meet_and_what_crosses_nothing_stays() -> None:
    vertices, faces = sheets(gap_mm=9.0)
    rest, closing = prepare_rest_surface(vertices, faces), dent(vertices, 9.6)
    assert not crossing_vertices(rest, closing, WEIGHTS[:3]).any()
    found = keep_apart(rest, closing, closing=True)
    assert not crossing_vertices(rest, found, EVERY).any()
    assert -9.0 < found[:, 2].min() < -7.5
    still = np.linalg.norm(vertices[:, :2] - 10.0, axis=1) > 8.0
    np.testing.assert_array_equal(found[still], closing[still])
    opening = -dent(vertices, 5.0)
    assert keep_apart(prepare_rest_surface(vertices, faces), opening, closing=True) is opening


def test_what_crosses_at_rest_is_not_asked_of_a_shape() -> None:
    vertices, faces = sheets(gap_mm=1.0)
    vertices = vertices + dent(vertices, 2.0)
    rest = prepare_rest_surface(vertices, faces)
    assert rest.excluded.any()
    assert not rest.excluded.all()
    assert not crossing_vertices(rest, np.zeros_like(vertices), WEIGHTS).any()


@pytest.mark.parametrize("closing", [True, False])
def test_a_shape_is_changed_no_more_than_near_what_crosses(closing: bool) -> None:
    vertices, faces = sheets(gap_mm=5.0)
    wanted = dent(vertices, 5.5) + (0.5, 0.0, 0.0)
    found = keep_apart(prepare_rest_surface(vertices, faces), wanted, closing=closing)
    corner = np.linalg.norm(vertices[:, :2] - (20.0, 20.0), axis=1) < 2.0
    np.testing.assert_allclose(found[corner], wanted[corner], atol=1e-9)
