"""Faces found in one picture: drawn ones however they are turned, and none where there is none."""

import numpy as np
import pytest

from pipeline.faces.detection import Crop, crop_around, find_face_at, find_faces, in_picture, make_pyramid
from pipeline.faces.networks import FaceNetworks
from tests.support.drawn_faces import OUTER_EYE_CORNERS, drawn_face, turned_about


@pytest.mark.parametrize("roll", [0.0, 30.0, 90.0, 135.0, 180.0, 250.0, -45.0])
def test_a_face_is_found_however_it_is_turned(networks: FaceNetworks, roll: float) -> None:
    (face,) = find_faces(drawn_face(roll_deg=roll), networks)
    assert face.score > 20.0
    assert abs((face.roll_deg - roll + 180.0) % 360.0 - 180.0) < 2.0
    corners = turned_about(np.array(OUTER_EYE_CORNERS), roll) + 319.5 - (0.0, 80.0)
    assert np.abs(face.landmarks_px[[33, 263]] - corners).max() < 0.03 * face.size_px
    low, high = face.box_px[:2], face.box_px[2:]
    assert (low <= face.landmarks_px.min(axis=0)).all()
    assert (high >= face.landmarks_px.max(axis=0)).all()


def test_turning_the_picture_by_a_quarter_turns_the_points(networks: FaceNetworks) -> None:
    image = drawn_face(scale=1.2, roll_deg=8.0)
    (upright,), (turned,) = (find_faces(np.ascontiguousarray(i), networks) for i in (image, np.rot90(image, -1)))
    height = image.shape[0]
    expected = np.stack([height - 1 - upright.landmarks_px[:, 1], upright.landmarks_px[:, 0]], axis=1)
    # The crop follows the face: what is left is its sampling, and the last round's step.
    assert np.abs(turned.landmarks_px - expected).max() < 0.01 * upright.size_px


@pytest.mark.parametrize("scale", [0.25, 0.5, 2.0])
def test_small_and_large_faces_are_found(networks: FaceNetworks, scale: float) -> None:
    size = (640, 480) if scale < 1.0 else (800, 900)
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    (face,) = find_faces(drawn_face(*size, (middle,), scale=scale), networks)
    corners = np.array(OUTER_EYE_CORNERS) * scale + middle
    assert np.abs(face.landmarks_px[[33, 263]] - corners).max() < 0.03 * face.size_px


def test_a_face_of_a_twentieth_of_a_picture_is_found_and_two_faces_are_two(networks: FaceNetworks) -> None:
    middle = (300.0, 600.0)
    image = drawn_face(1000, 800, (middle,), scale=0.24)
    (face,) = find_faces(image, networks)
    assert np.abs(face.landmarks_px.mean(axis=0) - middle).max() < 0.3 * face.size_px
    image = drawn_face(900, 480, ((220.0, 240.0), (660.0, 240.0)))
    faces = find_faces(image, networks)
    middles = sorted(float(face.landmarks_px[:, 0].mean()) for face in faces)
    assert np.allclose(middles, [220.0, 660.0], atol=15.0)


@pytest.mark.parametrize("grain_px", [0, 4, 16])
def test_noise_a_tiny_and_a_narrow_picture_hold_no_face(networks: FaceNetworks, grain_px: int) -> None:
    for shape in ((8, 8, 3), (900, 30, 3)):
        assert find_faces(np.full(shape, 128, np.uint8), networks) == ()
    rng = np.random.default_rng(grain_px)
    cells = rng.uniform(0, 255, (480 // max(grain_px, 1), 640 // max(grain_px, 1), 3)).astype(np.uint8)
    assert find_faces(np.kron(cells, np.ones((max(grain_px, 1), max(grain_px, 1), 1), np.uint8)), networks) == ()


def test_a_place_without_a_face_has_a_low_score(networks: FaceNetworks) -> None:
    image = drawn_face(900, 480, ((220.0, 240.0),))
    (face,) = find_faces(image, networks)
    pyramid, crop = make_pyramid(image), crop_around(face.landmarks_px)
    assert find_face_at(pyramid, crop, networks).score > 20.0
    crop.centre_px[0] += 420.0
    assert find_face_at(pyramid, crop, networks).score < 0.0


def coordinates(width: int, height: int) -> np.ndarray:
    """A picture whose red says x and whose green says y, of 255 parts of its size."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([x * 255.0 / (width - 1), y * 255.0 / (height - 1), 0.0 * x], axis=2).round().astype(np.uint8)


@pytest.mark.parametrize("size", [(640, 480), (1023, 767), (200, 333)])
@pytest.mark.parametrize("side", [40.0, 150.0, 190.0])
@pytest.mark.parametrize(("roll", "mirrored"), [(0.0, False), (35.0, False), (90.0, True), (-130.0, True)])
def test_a_crop_shows_what_lies_there(size: tuple[int, int], side: float, roll: float, mirrored: bool) -> None:
    width, height = size
    side *= max(size) / 640.0
    crop = Crop(np.array([0.52 * width, 0.47 * height]), side, roll, mirrored)
    shown = make_pyramid(coordinates(width, height)).sample(crop, 48).astype(float)
    columns, rows = np.meshgrid(np.arange(48), np.arange(48))
    pixels = in_picture(np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float), crop.picture_from_crop(48))
    expected = pixels / (width - 1, height - 1) * 255.0
    inside = ((expected > 2.0) & (expected < 253.0)).all(axis=1)
    assert inside.mean() > 0.9
    # Rounding to whole values when the picture is made, halved and sampled: half a value each.
    assert np.abs(shown.reshape(-1, 3)[inside, :2] - expected[inside]).max() < 2.0


def test_a_coarse_crop_is_a_mean_and_what_lies_outside_is_black() -> None:
    checks = (np.add.outer(np.arange(1024), np.arange(1024)) % 2 * 255).astype(np.uint8)
    crop = Crop(np.array([511.5, 511.5]), 800.0, 10.0)
    shown = make_pyramid(np.repeat(checks[..., None], 3, axis=2)).sample(crop, 64)
    assert np.abs(shown.astype(float) - 127.5).max() < 2.0  # single pixels would be 0 and 255
    white = np.full((100, 100, 3), 255, np.uint8)
    shown = make_pyramid(white).sample(Crop(np.array([0.0, 50.0]), 50.0, 0.0), 50)
    assert shown[:, :20].max() == 0
    assert shown[:, 30:].min() == 255
