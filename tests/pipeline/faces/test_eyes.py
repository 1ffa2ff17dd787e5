"""Eyes of a found face: irises and lids where they are drawn, open or closed."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.faces.detection import FaceDetection, find_faces, make_pyramid
from pipeline.faces.eyes import eye_openings, find_eyes
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import FaceNetworks
from pipeline.faces.points import point_table
from rig.camera import Camera, Intrinsics
from rig.geometry import Similarity, look_at
from rig.rig import Rig
from tests.support.drawn_faces import drawn_face, turned_about


def test_irises_and_lids_are_where_they_are_drawn(networks: FaceNetworks) -> None:
    image = drawn_face(scale=1.6)
    (face,) = find_faces(image, networks)
    face = find_eyes(make_pyramid(image), face, networks)
    assert face.irises_px is not None
    assert face.lids_px is not None
    middles = np.array([[-33.0, -20.0], [33.0, -20.0]]) * 1.6 + (319.5, 239.5)
    assert np.abs(face.irises_px[[0, 5]] - middles).max() < 3.0
    radii = np.linalg.norm(face.irises_px[[1, 2, 3, 4]] - face.irises_px[0], axis=1)
    assert np.abs(radii - 7.5 * 1.6).max() < 0.3 * 7.5 * 1.6
    # The subject's right eye comes first; its second iris point lies towards the nose, its third above.
    assert face.irises_px[1, 0] > face.irises_px[0, 0] > face.irises_px[3, 0]
    assert face.irises_px[6, 0] < face.irises_px[5, 0] < face.irises_px[8, 0]
    assert face.irises_px[2, 1] < face.irises_px[0, 1] < face.irises_px[4, 1]
    lids = face.lids_px[:16]
    assert lids[12, 1] < middles[0, 1] < lids[4, 1]
    assert np.abs(lids[[12, 4], 1] - middles[0, 1]).max() < 1.5 * 8.0 * 1.6


@pytest.mark.parametrize("roll", [40.0, 90.0, 180.0])
def test_eyes_of_a_turned_face_turn_with_it(networks: FaceNetworks, roll: float) -> None:
    image = drawn_face(scale=1.6, roll_deg=roll)
    face = find_eyes(make_pyramid(image), find_faces(image, networks)[0], networks)
    assert face.irises_px is not None
    middles = turned_about(np.array([[-33.0, -20.0], [33.0, -20.0]]) * 1.6, roll) + (319.5, 239.5)
    assert np.abs(face.irises_px[[0, 5]] - middles).max() < 4.0  # a third of the iris's radius


def test_the_two_eyes_of_a_symmetric_face_are_alike(networks: FaceNetworks) -> None:
    image = drawn_face(641, 481, ((320.0, 240.0),), scale=1.6)
    face = find_eyes(make_pyramid(image), find_faces(image, networks)[0], networks)
    assert face.irises_px is not None
    assert face.lids_px is not None
    for points in (face.irises_px, face.lids_px):
        right, left = points[: len(points) // 2], points[len(points) // 2 :]
        assert np.abs((640.0 - left[:, 0]) - right[:, 0]).max() < 1.5
        assert np.abs(left[:, 1] - right[:, 1]).max() < 1.5


def planted(openings: tuple[float, float], direction: np.ndarray) -> MatchedFaces:
    """A face whose lids stand apart by shares of the eye's length, as a camera in that direction sees it."""
    x, y, _ = direction
    across, up = np.sqrt(1.0 - x * x), np.sqrt(1.0 - y * y)
    lids = []
    for middle, opening in zip(((300.0, 200.0), (420.0, 210.0)), openings, strict=True):
        along = np.linspace(-30.0, 30.0, 9)
        half = 0.5 * 60.0 * opening
        lower = np.column_stack([along, np.where(abs(along) < 29.0, half, 0.0)])
        upper = np.column_stack([along[1:-1], np.full(7, -half)])
        lids.append(np.concatenate([lower, upper]) * (across, up) + middle)
    points = point_table().shape_mm
    face = FaceDetection(np.zeros((468, 2)), 30.0, np.zeros(4), 0.0, lids_px=np.concatenate(lids))
    other = replace(face, lids_px=None)
    faces = {"cam00": face, "cam01": other}
    empty = np.zeros((468, 3, 3))
    return MatchedFaces(faces, {}, {}, {}, {}, points, empty, np.zeros((0, 468, 3)), {}, Similarity.identity(), 1.0)


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -45.0])
def test_openings_are_as_if_seen_from_the_front(yaw_deg: float) -> None:
    direction = np.array([np.sin(np.radians(yaw_deg)), 0.1, np.cos(np.radians(yaw_deg))])
    direction /= np.linalg.norm(direction)
    k = Intrinsics(640, 480, 800.0, 800.0, 319.5, 239.5)
    pose = look_at(1000.0 * direction, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    rig = Rig((Camera("cam00", k, pose), Camera("cam01", k, pose)))
    face = planted((0.2, 0.05), direction)
    assert eye_openings(face, rig) == pytest.approx({"right": 0.2, "left": 0.05}, abs=1e-6)
    unseen = replace(face, detections={"cam01": face.detections["cam01"]})
    assert eye_openings(unseen, rig.subset(["cam01"])) == {}
