"""The service's own picture of a head, against a pinhole written out here."""

import numpy as np
import trimesh

from rig.mesh import Mesh
from server.console.head_pictures import GROUND, SIDE, drawn


def ball(colours: np.ndarray | None = None) -> Mesh:
    round_mesh = trimesh.creation.icosphere(subdivisions=5, radius=100.0)
    return Mesh(np.asarray(round_mesh.vertices), np.asarray(round_mesh.faces, np.int32), colours)


def test_a_ball_stands_in_the_middle_as_large_as_the_lens_shows_it() -> None:
    seen = (drawn(ball()) != GROUND).any(axis=2)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    # a ball of radius r from 4.25 r fills asin(1 / 4.25) of the 14 degrees to each side
    radius = SIDE / 2 * np.tan(np.arcsin(1 / 4.25)) / np.tan(np.radians(14))
    for found in (rows, columns):
        np.testing.assert_allclose([found[0], found[-1]], [SIDE / 2 - radius, SIDE / 2 + radius], atol=2.0)


def test_the_subjects_left_is_at_the_right_and_their_crown_on_top() -> None:
    place = ball().vertices
    colours = np.full(place.shape, 40, np.uint8)
    colours[place[:, 0] > 0, 0] = 200  # the left half is red
    colours[place[:, 1] > 0, 2] = 200  # the upper one blue
    picture = drawn(ball(colours)).astype(int)
    # the plane x = 0 is turned by 15 degrees to the side that is away from the camera
    middle = SIDE // 2
    assert picture[middle + 120, middle + 120].argmax() == 0
    assert picture[middle - 120, middle - 120].argmax() == 2
    assert picture[middle + 120, middle - 160].std() < 5, "neither: the lower right quarter"


def test_what_faces_the_lamp_is_brighter() -> None:
    picture = drawn(ball(np.full((len(ball().vertices), 3), 100, np.uint8))).astype(int).mean(axis=2)
    middle = SIDE // 2
    assert picture[middle - 180, middle - 60] > picture[middle + 180, middle - 60] + 8, "the lamps hang above"


def test_a_head_without_colours_is_drawn_white_and_stays_within_range() -> None:
    picture = drawn(ball()).astype(int)[SIDE // 2, SIDE // 2 - 150 : SIDE // 2 + 150]
    assert picture.min() > 150
    assert np.abs(np.diff(picture, axis=0)).max() < 20, "what is too bright is white and does not turn dark"
