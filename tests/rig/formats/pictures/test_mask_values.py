"""Masks in every form that programs write: the same subject in all, a sentence for what is no mask, and
which level is the subject."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from rig.formats.pictures.mask_values import inverted_masks, mask_plane, read_masks, subject_convention
from rig.messages.message import Message

HEIGHT, WIDTH = 240, 320
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
INSIDE = ((COLUMNS - 160) / 70.0) ** 2 + ((ROWS - 110) / 80.0) ** 2 < 1.0
INSIDE |= (ROWS > 150) & (np.abs(COLUMNS - 160) < 120)  # shoulders, to the bottom
MASK = INSIDE.astype(np.uint8) * np.uint8(255)
NOISE = np.random.default_rng(0).integers(1, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
PHOTOGRAPH = np.maximum(cv2.GaussianBlur(NOISE, (0, 0), 3), 1)


def coded(pixels: np.ndarray, ending: str, *options: int) -> np.ndarray:
    decoded = cv2.imdecode(cv2.imencode(ending, pixels, options)[1], cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    return decoded


def painted(inside: tuple[int, int, int], outside: tuple[int, int, int]) -> np.ndarray:
    return np.where(INSIDE[..., None], np.array(inside, np.uint8), np.array(outside, np.uint8))


SAME = {
    "0 and 1": MASK // 255,
    "0 and 128": MASK // 2,
    "16 bits": MASK.astype(np.uint16) * 257,
    "12 bits in 16": MASK.astype(np.uint16) * 16,
    "floats": MASK.astype(np.float32) / 255,
    "a video's range": (16 + MASK * (219 / 255)).astype(np.uint8),
    "jpeg 90": coded(MASK, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 90),
    "jpeg 50, colour": coded(cv2.merge([MASK] * 3), ".jpg", cv2.IMWRITE_JPEG_QUALITY, 50),
    "a video's range, jpeg": coded((16 + MASK * (219 / 255)).astype(np.uint8), ".jpg", cv2.IMWRITE_JPEG_QUALITY, 80),
    "lossy webp": coded(cv2.merge([MASK] * 3), ".webp", cv2.IMWRITE_WEBP_QUALITY, 50),
    "alpha of a cut-out": np.dstack([PHOTOGRAPH, MASK]),
    "opaque": np.dstack([MASK, MASK, MASK, np.full_like(MASK, 255)]),
    "red on black": painted((0, 0, 200), (0, 0, 0)),
    "white on green": painted((255, 255, 255), (0, 255, 0)),
    "cut out on black": PHOTOGRAPH * INSIDE[..., None],
}


@pytest.mark.parametrize("pixels", [pytest.param(value, id=key) for key, value in SAME.items()])
def test_every_form_of_a_mask_is_cut_at_half_of_its_own_range(pixels: np.ndarray) -> None:
    plane = mask_plane(pixels)
    assert isinstance(plane, np.ndarray), plane
    reading = read_masks({"cam00": plane})["cam00"]
    assert (reading.fault, reading.remark) == (None, None)
    assert not reading.soft
    assert np.count_nonzero((reading.share > 127) != INSIDE) <= 4


NAMED: dict[str, tuple[np.ndarray, str]] = {
    "black": (np.zeros_like(MASK), "is empty: no pixel belongs to the subject"),
    "white": (np.full_like(MASK, 255), "the whole mask has the value 255, so it has no outline"),
    "three areas": (np.where(INSIDE, np.where(ROWS > 170, 128, 255), 0).astype(np.uint8), "holds areas of 3 values"),
    "labels": (np.where(INSIDE, 1 + ROWS // 40, 0).astype(np.uint8), "holds areas of"),
    "GrabCut's four": (np.where(INSIDE, np.where(ROWS > 130, 3, 1), np.where(COLUMNS > 260, 2, 0)).astype(np.uint8),
                       "holds areas of 4 values (0, 1, 2, 3)"),
    "a depth map": (np.where(INSIDE, 60 + (ROWS + COLUMNS) // 3, 0).astype(np.uint8), "holds values all over"),
    "a ramp": (np.clip(COLUMNS * 0.8, 0, 255).astype(np.uint8), "holds values all over its range"),
    "a photograph": (PHOTOGRAPH, "is a photograph and no mask"),
    "coloured labels": (np.choose(ROWS // 60, [10, 90, 170, 250])[..., None] * np.array([1, 0, 0], np.uint8)
                        + (COLUMNS // 80)[..., None].astype(np.uint8) * np.array([0, 40, 0], np.uint8),
                        "colours, as a picture of labels does"),
}  # fmt: skip


@pytest.mark.parametrize(("pixels", "words"), [pytest.param(*value, id=key) for key, value in NAMED.items()])
def test_what_is_no_mask_is_named(pixels: np.ndarray, words: str) -> None:
    plane = mask_plane(pixels.astype(np.uint8))
    fault = plane if isinstance(plane, Message) else read_masks({"cam00": plane})["cam00"].fault
    assert words in str(fault)


def test_noise_of_an_empty_mask_is_not_stretched_to_a_subject() -> None:
    noise = (NOISE[..., 0] > 200).astype(np.uint8) * 3 + (NOISE[..., 1] > 128).astype(np.uint8)
    readings = read_masks({"cam00": MASK, "cam01": noise})
    assert readings["cam00"].fault is None
    assert str(readings["cam01"].fault).startswith("the mask is empty")
    assert read_masks({"cam00": MASK, "cam01": MASK // 255})["cam01"].fault is None  # 0 and 1 beside 0 and 255


def test_a_trimap_is_cut_in_the_middle_of_its_band() -> None:
    distance = np.hypot(COLUMNS - 160.0, ROWS - 110.0) - 70.0
    trimap = np.where(distance < -8, 255, np.where(distance > 8, 0, 128)).astype(np.uint8)
    reading = read_masks({"cam00": trimap})["cam00"]
    assert reading.soft
    assert "grey band" in str(reading.remark)
    assert np.abs(distance[(reading.share > 127) != (distance < 0)]).max(initial=0.0) < 1.0


@pytest.mark.parametrize("soften", [
    pytest.param(lambda mask: cv2.GaussianBlur(mask, (0, 0), 2), id="drawn soft"),
    pytest.param(lambda mask: cv2.resize(cv2.resize(mask, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA),
                                         (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR), id="enlarged"),
])  # fmt: skip
def test_soft_edges_are_told(soften: Callable[[np.ndarray], np.ndarray]) -> None:
    reading = read_masks({"cam00": soften(MASK)})["cam00"]
    assert reading.soft
    assert np.count_nonzero((reading.share > 127) != INSIDE) < 500


HEAD = ((COLUMNS - 160) / 60.0) ** 2 + ((ROWS - 110) / 75.0) ** 2 < 1.0
BUST = HEAD | ((ROWS > 170) & (np.abs(COLUMNS - 160) < 150))  # wide shoulders, to the bottom and half up the sides
CLOSE_UP = np.hypot(COLUMNS - 160, ROWS - 150) < 175  # three borders and more


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("subject", [HEAD, BUST], ids=["head", "bust"])
def test_the_borders_are_background(subject: np.ndarray, turns: int) -> None:
    assert subject_convention(np.rot90(subject, turns)) == "white"
    assert subject_convention(np.rot90(~subject, turns)) == "black"


def test_single_masks_may_be_inverted_and_a_close_up_follows_the_others() -> None:
    masks = {"a": BUST, "b": ~BUST, "c": HEAD, "d": CLOSE_UP}
    assert inverted_masks(masks, {}) == ["b"]
    assert subject_convention(CLOSE_UP) is None
    middle = np.array([160.0, 120.0])
    assert inverted_masks({"a": CLOSE_UP}, {"a": middle}) == []
    masks = {"a": ~BUST, "b": ~HEAD, "c": ~CLOSE_UP}
    assert inverted_masks(masks, dict.fromkeys(masks, middle)) == ["a", "b", "c"]
