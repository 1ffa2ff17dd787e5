"""The shipped networks: undamaged, the same numbers whoever runs them, and a crop's pixels where they say."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.faces.networks import PACKS, SHA256, DamagedNetwork, FaceNetworks, load_networks
from tests.support.drawn_faces import drawn_face

MIDDLE, SCALE = (95.5, 95.5), 0.69  # the points of a face this large fill two thirds of a crop


def crop() -> np.ndarray:
    return np.ascontiguousarray(drawn_face(192, 192, (MIDDLE,), scale=SCALE))


def test_the_points_of_a_face_lie_on_it_and_those_of_its_mirror_image_on_that(networks: FaceNetworks) -> None:
    points, score = networks.place_landmarks(crop())
    assert score > 20.0
    drawn = np.array([[-50.0, -20.0], [50.0, -20.0]]) * SCALE + MIDDLE  # outer corners of the eyes
    assert np.abs(points[[33, 263], :2] - drawn).max() < 4.0
    turned, _ = networks.place_landmarks(np.ascontiguousarray(crop()[:, ::-1]))
    # The drawn face is symmetric, so both crops are alike to rounding: x and its mirror image add up to 191.
    assert np.abs(points[[33, 263, 61, 291], 0] + turned[[263, 33, 291, 61], 0] - 191.0).max() < 2.0


def test_numbers_do_not_depend_on_threads(networks: FaceNetworks) -> None:
    alone = networks.place_landmarks(crop())[0].tobytes(), networks.find(crop())[1].tobytes()
    threads = cv2.getNumThreads()
    try:
        for count in (1, 2, 4):
            cv2.setNumThreads(count)
            assert (networks.place_landmarks(crop())[0].tobytes(), networks.find(crop())[1].tobytes()) == alone
    finally:
        cv2.setNumThreads(threads)


def test_threads_may_share_the_networks(networks: FaceNetworks) -> None:
    pictures = [np.roll(crop(), shift, axis=1) for shift in range(6)]
    alone = [networks.place_landmarks(picture)[0].tobytes() for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            assert [p.tobytes() for p, _ in pool.map(networks.place_landmarks, pictures)] == alone


def test_a_missing_file_and_a_damaged_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(DamagedNetwork, match=r"face_detection_full_range\.tflite: No such file"):
        load_networks(tmp_path)
    for name in SHA256:
        shutil.copy(PACKS / name, tmp_path)
    raw = bytearray((tmp_path / "face_landmark.tflite").read_bytes())
    raw[-100] ^= 1
    (tmp_path / "face_landmark.tflite").write_bytes(raw)
    with pytest.raises(DamagedNetwork, match=r"face_landmark\.tflite.*sha256.*install the program again"):
        load_networks(tmp_path)


def test_the_licence_lies_beside_the_networks() -> None:
    text = (PACKS / "mediapipe.LICENSE.txt").read_text(encoding="utf-8")
    assert "Apache License" in text
    assert all(name in text for name in SHA256)
