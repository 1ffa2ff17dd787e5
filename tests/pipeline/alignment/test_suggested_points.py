"""Suggested feature points: on the head that the finder's points are of, and only where a camera sees them. Picked
ones beside them."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.alignment.feature_checks import features_beside_face, locate_landmarks, suggest_points
from pipeline.faces.landmark_map import LandmarkMap, landmark_map
from pipeline.faces.matching import MatchedFaces, complete_match
from pipeline.faces.triangulated_face import triangulate_face
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel, load_model
from rig.capture import Features
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
def test_landmarks_lie_on_the_head_of_the_points(model: HeadModel, places: LandmarkMap, seed: int | None) -> None:
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


MODEL = load_model()


def picked(offset_px: tuple[float, float], share: float = 1.0, noise_px: float = 6.0) -> Features:
    """Points on a head that is not the mean one, all moved and scaled."""
    rng, rig = np.random.default_rng(4), default_layout()
    vertices = MODEL.vertices(np.random.default_rng(3).normal(size=8))
    at = {n: WORLD_FROM_HEAD.apply(vertices[MODEL.levels["full"].landmarks[n]][None]) for n in SEVEN_POINTS}
    return {
        name: {v: share * rig[v].project(point)[0] + offset_px + rng.normal(0, noise_px, 2) for v in VIEWS}
        for name, point in at.items()
    }


@pytest.mark.parametrize(
    ("offset_px", "share", "word"),
    [
        ((0.0, 0.0), 1.0, None),
        ((70.0, 0.0), 1.0, "+70 px"),
        ((0.0, -70.0), 1.0, "-70 px"),
        ((0.0, 0.0), 0.5, "0.5"),
        ((0.0, 0.0), 0.8, "0.8"),
    ],
)
def test_points_of_other_pictures_are_noticed(offset_px: tuple[float, float], share: float, word: str | None) -> None:
    rig, places = default_layout(), landmark_map(MODEL)
    face = found_on(MODEL.vertices(np.random.default_rng(3).normal(size=8)), places, rig)
    found = features_beside_face(picked(offset_px, share), face, rig, MODEL, places)
    assert (found is None) == (word is None)
    if share != 1.0:
        assert found is not None
        assert found.code == "features-of-size"
        assert found.parameters["factor"] == pytest.approx(share, rel=0.03)
    elif found is not None:
        assert int(str(word).split()[0]) == pytest.approx(
            max((float(str(found.parameters[side])) for side in ("right_px", "down_px")), key=abs), abs=12
        )


def test_points_of_no_landmark_say_nothing_and_rows_that_count_from_the_bottom_are_named() -> None:
    rig, places = default_layout(), landmark_map(MODEL)
    face = found_on(MODEL.vertices(np.random.default_rng(3).normal(size=8)), places, rig)
    assert features_beside_face({"nobody": {"cam00": np.zeros(2)}}, face, rig, MODEL, places) is None
    turned = {
        name: {v: np.array([x, rig[v].intrinsics.height - 1 - y]) for v, (x, y) in views.items()}
        for name, views in picked((0.0, 0.0)).items()
    }
    found = features_beside_face(turned, face, rig, MODEL, places)
    assert found is not None
    assert found.code == "features-from-bottom"
