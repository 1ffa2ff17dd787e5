"""Shapes of a mesh together: a mouth that closes after it has opened, and visemes."""

import numpy as np

from pipeline.applications.templates.animated import parted_shapes
from pipeline.applications.templates.contact import crossings, rest_surface
from pipeline.applications.templates.eye_picture import (
    SIZE_PX,
    PhotographedEyes,
    darkest_direction,
    eyeball_uv,
    paint_eyeball,
)
from pipeline.applications.templates.eyeballs import AHEAD, Eyeball
from pipeline.head_model.visemes import VISEMES, mixed
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from rig.mesh import Mesh
from tests.pipeline.applications.templates.test_contact import EVERY, dent, sheets


def test_a_mouth_closes_after_it_has_opened_and_speaks_without_crossing() -> None:
    vertices, faces = sheets(gap_mm=0.3)
    rest, upper = rest_surface(vertices, faces), np.arange(len(vertices)) >= len(vertices) // 2
    opening = np.where(upper, 0.0, -8.0)[:, None] * (0.0, 0.0, 1.0)
    closing = -opening + dent(vertices, 1.5)
    shapes = {"jawOpen": opening, "mouthClose": closing, "mouthFunnel": dent(vertices, 2.0)}
    assert crossings(rest, opening + closing).sum() > 0
    found = parted_shapes(rest, shapes)
    assert list(found) == [*shapes, *VISEMES]
    np.testing.assert_array_equal(found["jawOpen"], opening)
    assert crossings(rest, found["jawOpen"] + found["mouthClose"], EVERY).sum() == 0
    for name in VISEMES:
        assert crossings(rest, found[name], EVERY).sum() == 0, name
    np.testing.assert_allclose(found["viseme_aa"], mixed(found, VISEMES["viseme_aa"]))
    assert not found["viseme_sil"].any()


HALF_MM = (10.0, 7.0)  # of what lids show, seen from ahead
GAZE = np.array([0.2, 0.1, np.sqrt(0.95)])
IRIS, PUPIL, WHITE = (90, 60, 30), (20, 20, 20), (210, 205, 200)
EYEBALL = Eyeball(np.array([31.0, 12.0, 60.0]), GAZE)


def photographed() -> PhotographedEyes:
    """The ball itself between lids, with an iris of 5 mm about the gaze in its texture, a texel 0.1 mm."""
    x, y = (np.linspace(-half, half, 41) for half in HALF_MM)
    aside = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    directions = np.column_stack([aside, np.sqrt(12.0**2 - (0.8 * aside**2).sum(axis=1))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vertices = EYEBALL.centre + EYEBALL.reach(directions)[:, None] * directions
    index = np.arange(len(aside)).reshape(41, 41)
    a, b, c, d = (each.ravel() for each in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    image = np.full((200, 200, 3), WHITE, np.uint8)
    uv = 0.5 + aside / (2.0 * HALF_MM[0]) * (1.0, -1.0)
    at = (np.stack(np.meshgrid(*[(np.arange(200) + 0.5) / 200] * 2), axis=2) - 0.5) * (20.0, -20.0)
    flat = at.reshape(-1, 2)
    there = np.column_stack([flat, np.sqrt(np.maximum(144.0 - 0.8 * (flat**2).sum(axis=1), 1.0))])
    angle = np.arccos(there @ GAZE / np.linalg.norm(there, axis=1)).reshape(200, 200)
    image[angle < np.arcsin(5.9 / 12.0)], image[angle < np.arcsin(2.0 / 12.0)] = IRIS, PUPIL
    atlas = Atlas(Layout(uv, faces, index.ravel()), image)
    return PhotographedEyes(Mesh(vertices, faces), np.arange(len(faces)), atlas)


def test_an_iris_lies_in_the_middle_of_its_picture() -> None:
    image = paint_eyeball(EYEBALL, photographed())
    assert image is not None
    middle = image[SIZE_PX // 2, SIZE_PX // 2].astype(int)
    assert np.abs(middle - PUPIL).max() < 5
    ring = image[SIZE_PX // 2, SIZE_PX // 2 + round(SIZE_PX * 20.0 / 360.0)].astype(int)  # 20 degrees off
    assert np.abs(ring - IRIS).max() < 5
    assert np.abs(image[5, 5].astype(int) - WHITE).max() < 5  # behind: what no photograph shows is white
    front = eyeball_uv(EYEBALL, Eyeball(EYEBALL.centre, AHEAD).mesh())[0]
    np.testing.assert_allclose(front, 0.5, atol=1e-9)


def test_an_iris_that_was_not_measured_is_what_is_dark() -> None:
    ahead = Eyeball(EYEBALL.centre, AHEAD)
    found = darkest_direction(ahead, photographed())
    assert found is not None
    assert np.degrees(np.arccos(found @ GAZE)) < 3.0  # an iris is cut by the lids on one side
    seen = photographed()
    assert seen.atlas is not None
    lid = Atlas(seen.atlas.layout, np.full((200, 200, 3), (190, 140, 120), np.uint8))
    assert darkest_direction(ahead, PhotographedEyes(seen.head, seen.between, lid)) is None
