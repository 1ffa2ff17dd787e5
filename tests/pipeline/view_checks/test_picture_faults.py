"""Pictures that are blurred or turned, planted: each is named, and nothing is said of good ones."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.view_checks.picture_faults import (
    blurred_views,
    plates_brightness,
    turned_against_plate,
    with_picture_faults,
)
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.messages.message import compose
from rig.rig import Rig
from tests.support.scenes import fan

HEIGHT, WIDTH = 192, 256
RIG = Rig(tuple(replace(camera, name=name) for name, camera in zip("abcd", fan(WIDTH, HEIGHT), strict=False)))
NAMES = ("a", "b", "c", "d")
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
SUBJECT = np.hypot(COLUMNS - 128, ROWS - 96) < 60


def room(seed: int) -> np.ndarray:
    rough = np.random.default_rng(seed).integers(40, 220, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(rough, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def person(seed: int) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 1)


@pytest.fixture(scope="module")
def capture() -> Capture:
    plates = {name: room(k) for k, name in enumerate(NAMES)}
    images = {name: np.where(SUBJECT[..., None], person(k), plates[name]) for k, name in enumerate(NAMES)}
    return Capture(images, {name: (plate,) for name, plate in plates.items()})


@pytest.fixture(scope="module")
def outlines() -> dict[str, Silhouette]:
    return dict.fromkeys(NAMES, silhouette_from_mask(SUBJECT))


def test_nothing_is_said_of_good_pictures(capture: Capture, outlines: dict[str, Silhouette]) -> None:
    assert blurred_views(capture.images, outlines) == {}
    assert [turned_against_plate(capture, name) for name in NAMES] == [None] * 4
    assert with_picture_faults(outlines, capture, NAMES, RIG) == outlines


@pytest.mark.parametrize("sigma", [3.0, 12.0])
def test_a_blurred_picture_is_named_instead_of_what_follows_from_it(
    capture: Capture, outlines: dict[str, Silhouette], sigma: float
) -> None:
    blurred = replace(capture, images={**capture.images, "c": cv2.GaussianBlur(capture.images["c"], (0, 0), sigma)})
    weak = replace(outlines["c"].quality, warnings=(compose("outline-weak", share=0.3),))
    doubted = {**outlines, "c": replace(outlines["c"], quality=weak)}
    found = with_picture_faults(doubted, blurred, ["c"], RIG)
    assert [fault.code for fault in found["c"].quality.warnings] == ["detail-missing"]
    assert found["c"].quality.usable
    assert all(found[name] is outlines[name] for name in "abd")


@pytest.mark.parametrize(
    ("turned", "word"),
    [
        (lambda image: image[::-1, ::-1], "turned by 180 degrees"),
        (lambda image: image[:, ::-1], "flipped left to right"),
        (lambda image: image[::-1], "flipped upside down"),
    ],
)
def test_a_turned_picture_is_named_and_left_out(capture: Capture, outlines: dict, turned, word: str) -> None:
    pictures = {**capture.images, "b": np.ascontiguousarray(turned(capture.images["b"]))}
    found = with_picture_faults(outlines, replace(capture, images=pictures), ["b"], RIG)
    assert not found["b"].quality.usable
    (fault,) = found["b"].quality.warnings
    assert word in fault.text


def test_two_views_do_not_tell_what_is_sharp(capture: Capture, outlines: dict[str, Silhouette]) -> None:
    assert blurred_views({name: capture.images[name] for name in "ab"}, outlines) == {}


@pytest.mark.parametrize("exposure", [1.0, 1.5, 4.0, 0.25])
def test_clean_plates_of_another_exposure_are_measured(capture: Capture, exposure: float) -> None:
    def exposed(image: np.ndarray) -> np.ndarray:
        light = exposure * linear_from_srgb(image / 255.0)
        return np.rint(255.0 * srgb_from_linear(np.clip(light, 0.0, 1.0))).astype(np.uint8)

    plates = {name: tuple(map(exposed, of)) for name, of in capture.backgrounds.items()}
    found = plates_brightness(replace(capture, backgrounds=plates))
    assert (found is None) == (0.6 < exposure < 1.8)
    assert found is None or found == pytest.approx(exposure, rel=0.1)
