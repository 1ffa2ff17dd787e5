"""Suggested feature points: on the head that the finder's points are of, and only where a camera sees them."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.alignment.feature_checks import locate_landmarks, suggest_points
from pipeline.faces.landmark_map import LandmarkMap, landmark_map
from pipeline.faces.matching import MatchedFaces, complete_match
from pipeline.faces.triangulated_face import triangulate_face
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.drawn_faces import seen_face

WORLD_FROM_HEAD = Similarity(1.03, rotation_from_vector(np.array([0.05, 0.1, 0.03])), np.array([12.0, 40.0, -40.0]))
VIEWS = ("cam00", "cam05", "cam06", "cam07", "cam08")


@pytest.fixture(scope="module")
def places(model: HeadModel) -> LandmarkMap:
    return landmark_map(model)


def found_on(vertices: np.ndarray, places: LandmarkMap, rig: Rig) -> MatchedFaces:
    """A face whose points are exactly where the finder puts them in the mean on a head."""
    somewhere = Similarity(1.0, WORLD_FROM_HEAD.rotation, WORLD_FROM_HEAD.apply(places.points(vertices)).mean(axis=0))
    rng = np.random.default_rng(1)
    detections = {name: seen_face(somewhere, rig[name], rng) for name in VIEWS}
    triangulated = triangulate_face(detections, rig)
    assert triangulated is not None
    face = complete_match(triangulated, {}, rig)
    assert face is not None
    return replace(face, points_world=WORLD_FROM_HEAD.apply(places.expected(vertices)))


@pytest.mark.parametrize("seed", [None, 3])
def test_landmarks_lie_on_the_head_that_the_points_are_of(
    model: HeadModel, places: LandmarkMap, seed: int | None
) -> None:
    """Exactly on the mean head, and near those of another one, of which no more is known than the finder's points."""
    modes = 0 if seed is None else 8
    vertices = model.vertices(np.zeros(0) if seed is None else np.random.default_rng(seed).normal(size=modes))
    rows = [model.levels["full"].landmarks[name] for name in SEVEN_POINTS]
    positions, world_from_head = locate_landmarks(found_on(vertices, places, default_layout()), model, places, rows)
    apart = np.linalg.norm(positions - WORLD_FROM_HEAD.apply(vertices[rows]), axis=1)
    if seed is None:
        assert apart.max() < 0.1
        assert world_from_head.scale == pytest.approx(WORLD_FROM_HEAD.scale, abs=1e-4)
    else:
        mean = world_from_head.apply(model.vertices(np.zeros(0))[rows])
        assert apart.max() < 3.0
        assert np.median(apart) < 0.5 * np.median(np.linalg.norm(mean - WORLD_FROM_HEAD.apply(vertices[rows]), axis=1))


def test_a_view_gets_the_points_that_its_camera_sees(model: HeadModel, places: LandmarkMap) -> None:
    rig = default_layout()
    vertices = model.vertices(np.zeros(0))
    face = found_on(vertices, places, rig)
    suggested = suggest_points(face, rig, model, places, SEVEN_POINTS)
    assert suggested.keys() == set(SEVEN_POINTS)
    assert {name for views in suggested.values() for name in views} <= set(VIEWS)
    for name, views in suggested.items():
        position = WORLD_FROM_HEAD.apply(vertices[model.levels["full"].landmarks[name]][None])
        for camera, pixel in views.items():
            assert np.linalg.norm(pixel - rig[camera].project(position)[0]) < 0.5
    assert set(suggested["pronasale"]) == set(VIEWS)
    for side, other in (("right", "left"), ("left", "right")):
        only = suggested[f"cheilion_{side}"].keys() - suggested[f"cheilion_{other}"].keys()
        assert only, f"some camera sees the {side} corner of the mouth alone"
