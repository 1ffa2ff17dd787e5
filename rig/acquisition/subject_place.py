"""Finds where the subject is in a picture, within a few hundredths of a second, so that the operator can shoot again.

A picture is compared with its clean plate at a small size, where noise is averaged out. The largest part that differs
is the subject. The result serves to check framing and to draw an outline; reconstruction segments anew
(pipeline.segmentation). Its intersection over union with the true silhouettes is 0.978 to 0.987 on two rendered
captures of eleven cameras."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool

from rig.image import ImageRgb

Edge = Literal["top", "left", "right"]

WIDTH_PX = 320  # of the picture that is compared
CHANGE_LEAST = 10.0  # of 255; most shadows on a backdrop change it by less
NOISE_FACTOR = 6.0
LOOSE_PX, GAP_PX = 5, 13  # thinner parts are dropped; gaps so wide are closed (skin before a skin-coloured wall)
SHARE_LEAST = 0.02  # of the picture: a head that fills less is too far away to be measured, or nobody is there
OUTLINE_PX = 0.8  # largest error of the simplified outline


@dataclass(frozen=True, slots=True)
class SubjectPlace:
    """Holds where the subject is in a picture.

    ``outline``: corners of its contour (px of the picture); ``share``: share of the picture's area that it fills;
    ``cut_off``: edges of the picture that cut off the upper half of the outline (the bottom edge always cuts a bust).
    """

    outline: tuple[tuple[float, float], ...]
    share: float
    cut_off: tuple[Edge, ...]


def find_subject(image: ImageRgb, plate: ImageRgb) -> SubjectPlace | None:
    """Finds the subject: the largest part of a picture that differs from the clean plate. Returns None where nothing as
    large as a head differs."""
    if image.shape != plate.shape:
        return None
    here, there = (np.float32(_reduced(picture)) + 1.0 for picture in (image, plate))
    gain = np.median(here / there, axis=(0, 1))  # the light may be brighter or dimmer than for the plate
    change = np.abs(here - gain * there).max(axis=2)
    noise = 1.4826 * float(np.median(change))
    return _place(change > max(CHANGE_LEAST, NOISE_FACTOR * noise), image.shape)


def subject_of_mask(mask: Bool[np.ndarray, "h w"]) -> SubjectPlace | None:
    """Returns where the subject is in a picture whose mask is known. Returns None where the mask shows nothing as large
    as a head."""
    return _place(_reduced(mask.astype(np.uint8)) > 0, mask.shape)


def _reduced(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    factor = min(1.0, WIDTH_PX / width)
    return cv2.resize(picture, (round(width * factor), max(1, round(height * factor))), interpolation=cv2.INTER_AREA)


def _place(different: Bool[np.ndarray, "h w"], shape: tuple[int, ...]) -> SubjectPlace | None:
    opened = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_OPEN, np.ones((LOOSE_PX, LOOSE_PX), np.uint8))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (GAP_PX, GAP_PX))
    contours, _ = cv2.findContours(
        cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disc), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    largest = max(contours, key=cv2.contourArea, default=None)
    if largest is None:
        return None
    filled = cv2.drawContours(np.zeros(different.shape, np.uint8), [largest], -1, 1, cv2.FILLED) > 0
    share = float(filled.mean())
    if share < SHARE_LEAST:
        return None
    scale = shape[1] / different.shape[1]
    corners = cv2.approxPolyDP(largest, OUTLINE_PX, True).reshape(-1, 2)
    outline = tuple((float((x + 0.5) * scale - 0.5), float((y + 0.5) * scale - 0.5)) for x, y in corners)
    return SubjectPlace(outline, share, _cut_off(filled))


def _cut_off(filled: Bool[np.ndarray, "h w"]) -> tuple[Edge, ...]:
    rows = np.flatnonzero(filled.any(axis=1))
    head = filled[: (int(rows[0]) + int(rows[-1])) // 2 + 1]
    edges: tuple[tuple[Edge, np.ndarray], ...] = (("top", head[0]), ("left", head[:, 0]), ("right", head[:, -1]))
    return tuple(edge for edge, line in edges if line.any())
