"""The quick outline of the subject, against pictures whose subject is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.acquisition.image_checks import SubjectPlace, find_subject, subject_of_mask
from rig.formats.pictures.images import read_image
from tests.support.shared_data import shared
from tests.support.textured_studio import FlatStudio

EMPTY, SEATED = FlatStudio(False, 640, 480), FlatStudio(True, 640, 480)


def filled(place: SubjectPlace, height: int, width: int) -> np.ndarray:
    corners = np.round(np.array(place.outline)).astype(np.int32)
    return cv2.fillPoly(np.zeros((height, width), np.uint8), [corners], 1) > 0


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def bust() -> np.ndarray:
    """What FlatStudio draws."""
    mask = np.zeros((480, 640), np.uint8)
    cv2.ellipse(mask, (320, 480), (160, 160), 0, 180, 360, 1, -1)
    cv2.ellipse(mask, (320, 240), (71, 96), 0, 0, 360, 1, -1)
    return mask > 0


@pytest.mark.parametrize("gain", [1.0, 0.8, 1.15])
def test_the_subject_is_found_in_light_that_changed(gain: float) -> None:
    seated = np.clip(SEATED("cam03", 0.0) * gain, 0, 255).astype(np.uint8)
    place = find_subject(seated, EMPTY("cam03", 0.0))
    assert place is not None
    # A pixel of the small picture is 2 px here; the bust's contour is about 900 px long and its area 63,000: one small
    # pixel all around is 3 %, and where skin is as bright as the wall, closing bridges at most 26 px.
    assert overlap(filled(place, 480, 640), bust()) > 0.92
    assert place.share == pytest.approx(bust().mean(), rel=0.05)
    assert place.cut_off == ()


def test_nobody_is_found_in_an_empty_studio() -> None:
    for light in (1.0, 0.85):
        assert find_subject((EMPTY("cam05", 0.0) * light).astype(np.uint8), EMPTY("cam05", 1.0)) is None


@pytest.mark.parametrize(("shift", "edge"), [((-200, 0), "top"), ((0, -290), "left"), ((0, 290), "right")])
def test_a_head_at_the_edge_is_cut_off(shift: tuple[int, int], edge: str) -> None:
    moved = np.zeros((480, 640), bool)
    down, right = shift
    source = bust()[max(0, -down) :, max(0, -right) : 640 - max(0, right)]
    moved[: source.shape[0], max(0, right) : max(0, right) + source.shape[1]] = source
    place = subject_of_mask(moved)
    assert place is not None
    assert place.cut_off == (edge,)


def test_shoulders_may_leave_the_picture() -> None:
    mask = bust()
    mask[400:] = True
    place = subject_of_mask(mask)
    assert place is not None
    assert place.cut_off == ()


@pytest.mark.parametrize("capture", ["scan-a", "draw-b"])
@pytest.mark.parametrize("camera", ["cam00", "cam01", "cam08"])
def test_the_outline_is_that_of_the_true_silhouette(capture: str, camera: str) -> None:
    root: Path = shared(f"data/captures/{capture}")
    truth = cv2.imread(str(root.with_name(f"{capture}.truth") / "silhouettes" / f"{camera}.png"), 0)
    assert truth is not None
    place = find_subject(read_image(root / "images" / f"{camera}.png"), read_image(root / f"background/{camera}.png"))
    assert place is not None
    # One pixel of the 320 px picture, 3.2 px here, around a contour of 2,000 px that encloses 220,000: 3 %.
    assert overlap(filled(place, *truth.shape), truth > 0) > 0.96
    assert place.cut_off == ()
    assert len(place.outline) < 150  # it is sent to every page
