"""A head of the population is found from its landmarks, as far as other heads and the network's errors allow."""

import numpy as np

from pipeline.alignment.face_alignment import POINTS, align_to_face, frontmost_camera, spread_points
from pipeline.alignment.silhouette_search import turn_between_deg
from pipeline.faces.landmark_map import LandmarkMap, landmark_map
from pipeline.faces.matching import MatchedFaces
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity, rotation_from_vector
from rig.studio.scene.layout import default_layout

NOISE_MM = 0.5


def matched(points_world: np.ndarray, pose: Similarity) -> MatchedFaces:
    covariances = np.tile(NOISE_MM**2 * np.eye(3), (468, 1, 1))
    return MatchedFaces({}, {}, {}, {}, {}, points_world, covariances, np.zeros((2, 468, 3)), {}, pose, 1.0)


def found(model: HeadModel, places: LandmarkMap, pose: Similarity, rng: np.random.Generator) -> MatchedFaces:
    """Landmarks of a random head at a pose, off by what the map says and by triangulation."""
    vertices = model.vertices(0.8 * rng.standard_normal(len(model.modes)))
    together = np.einsum("m,mnc->nc", rng.standard_normal(len(places.shared_mm)), places.shared_mm)
    separate = places.deviation_mm * rng.standard_normal((468, 3))
    points = pose.apply(places.expected(vertices) + together + separate) + rng.normal(0.0, NOISE_MM, (468, 3))
    return matched(points, pose)


def test_poses_of_random_heads_are_found(model: HeadModel) -> None:
    """Of 12 heads; the network's own idea of a face is worth 1 to 2 degrees, and another head's face as much."""
    places, rng = landmark_map(model), np.random.default_rng(4)
    turns, shifts = [], []
    for _ in range(12):
        pose = Similarity(1.0, rotation_from_vector(rng.normal(0.0, 0.7, 3)), rng.normal(0.0, 200.0, 3))
        aligned = align_to_face(model, found(model, places, pose, rng), places)
        turns.append(turn_between_deg(aligned.world_from_head, pose))
        nose = model.vertices(np.zeros(0))[model.landmarks["subnasale"]][None]
        shifts.append(np.linalg.norm(aligned.world_from_head.apply(nose) - pose.apply(nose)))
    assert np.median(turns) < 2.0
    assert max(turns) < 5.0
    assert np.median(shifts) < 5.0


def test_points_that_are_elsewhere_hardly_turn_the_head(model: HeadModel) -> None:
    """An open jaw: the lower face 15 mm down."""
    places, rng = landmark_map(model), np.random.default_rng(5)
    pose = Similarity(1.0, rotation_from_vector(np.array([0.1, 0.3, 0.0])), np.array([10.0, -20.0, 5.0]))
    face = found(model, places, pose, rng)
    mouth = places.points(model.vertices(np.zeros(0)))[:, 1]
    low = mouth < np.quantile(mouth, 0.2)
    moved = face.points_world - 15.0 * low[:, None] * pose.rotation[:, 1]
    straight = align_to_face(model, face, places).world_from_head
    opened = align_to_face(model, matched(moved, pose), places).world_from_head
    assert turn_between_deg(straight, opened) < 4.0


def test_points_are_spread_and_none_of_them_slides(model: HeadModel) -> None:
    places = landmark_map(model)
    chosen = spread_points(places)
    assert len(chosen) == len(set(chosen.tolist())) == min(POINTS, int((~places.slides).sum()))
    assert not places.slides[chosen].any()


def test_the_front_camera_is_the_one_that_is_looked_at() -> None:
    rig = default_layout()
    for name in ("cam00", "cam03"):
        assert frontmost_camera(rig[name].centre_world - rig.centre_world(), rig.centre_world(), rig) == name
