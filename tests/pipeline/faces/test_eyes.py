"""Eyes of a found face: irises and lids where they are drawn, open or closed."""

import numpy as np
import pytest

from pipeline.faces.crops import make_pyramid
from pipeline.faces.detection import find_faces
from pipeline.faces.eyes import find_eyes
from pipeline.faces.networks import FaceNetworks, load_networks
from tests.support.drawn_faces import drawn_face, turned_about


@pytest.fixture(scope="module")
def networks() -> FaceNetworks:
    return load_networks()


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
