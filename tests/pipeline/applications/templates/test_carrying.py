"""Vertices of one mesh on the surface of another."""

import numpy as np
import trimesh

from pipeline.applications.templates.carrying import SurfaceBinding, bind_vertices, frames, surface_binding
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import vertex_normals

BALL = trimesh.creation.icosphere(subdivisions=3, radius=80.0)
VERTICES, FACES = np.array(BALL.vertices), np.array(BALL.faces, np.int32)
TURN = Similarity(1.0, rotation_from_vector(np.array([0.4, -1.1, 0.2])), np.array([30.0, -5.0, 12.0]))


def carried() -> SurfaceBinding:
    """Points on the ball, a strip of lashes 12 mm off it, and a small ball inside it."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    eye = np.array(trimesh.creation.icosphere(subdivisions=2, radius=12.0).vertices) + (0.0, 0.0, 66.0)
    rest = np.concatenate([80.0 * directions, 92.0 * directions[:20], eye])
    wholes = np.concatenate([np.full(320, -1), np.zeros(len(eye), int)])
    attachment, _, _ = bind_vertices(rest[:300], directions, VERTICES, FACES)
    return surface_binding(rest, np.arange(300), attachment, wholes)


def test_frames_are_right_handed_and_unit() -> None:
    axes = frames(VERTICES[FACES])
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (len(FACES), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)


def test_points_come_back_where_they_were_attached() -> None:
    rng = np.random.default_rng(1)
    points = VERTICES[:100] * 1.02 + 0.3 * rng.standard_normal((100, 3))
    attachment, distances, cosine = bind_vertices(points, VERTICES[:100] / 80.0, VERTICES, FACES)
    np.testing.assert_allclose(attachment.on(VERTICES, FACES), points, atol=1e-9)
    np.testing.assert_allclose(distances, np.linalg.norm(attachment.offsets, axis=1), atol=1e-9)
    assert cosine.min() > 0.98
    on_it, distances, _ = bind_vertices(VERTICES, vertex_normals(VERTICES, FACES), VERTICES, FACES)
    assert distances.max() < 1e-9
    np.testing.assert_allclose(on_it.weights.sum(axis=1), 1.0)


def test_sheets_that_touch_are_told_apart_by_the_way_they_face() -> None:
    square = np.array([[0.0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]])
    vertices = np.concatenate([square, square + (0, 0, 1.0)])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]], np.int32)  # the lower looks down, the upper up
    points = np.array([[20.0, 10, 0.2], [20.0, 10, 0.8]])
    attachment, _, _ = bind_vertices(points, np.array([[0.0, 0, 1], [0.0, 0, -1]]), vertices, faces)
    assert (attachment.triangles >= 2).tolist() == [True, False]


def test_everything_follows_a_head_that_moves_led_by_the_nearest_skin() -> None:
    found = carried()
    np.testing.assert_allclose(found.on(VERTICES, FACES), found.rest, atol=1e-8)
    np.testing.assert_allclose(found.on(TURN.apply(VERTICES), FACES), TURN.apply(found.rest), atol=1e-7)
    assert set(found.anchors) <= set(found.skin)
    led = np.linalg.norm(found.rest[found.whole_anchors[0]] - (0.0, 0.0, 78.0), axis=1)
    others = np.linalg.norm(found.rest[np.setdiff1d(found.skin, found.whole_anchors[0])] - (0.0, 0.0, 78.0), axis=1)
    assert np.median(led) < 0.5 * np.median(others)


def test_an_eyeball_stays_round_where_the_head_grows_wider_and_lashes_stretch_with_it() -> None:
    found = carried()
    wider = found.on(VERTICES * (1.2, 1.0, 1.0), FACES)
    eye = wider[320:]
    radii = np.linalg.norm(eye - eye.mean(axis=0), axis=1)
    assert np.ptp(radii) < 1e-9
    assert 11.0 < radii.mean() < 14.5
    # affine motions are exact for the warp; 1 mm for offsets of chords that sag 1 mm below the ball
    assert np.abs(wider[300:320] - found.rest[300:320] * (1.2, 1.0, 1.0)).max() < 1.0
