"""Fills the empty rims of pictures whose clean plates have none, and of plates whose pictures have none.

Undistortion leaves a rim without light, transparent or black, and sometimes white. Compared with a plate that was not
treated so it is a subject all around the picture. The scene behind the rim is unknown and taken for backdrop.

Enters: pictures and clean plates by camera. Leaves: the same without such rims, and a remark.
"""

from collections.abc import Collection, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from rig.image import ImageRgb
from rig.messages.fault_groups import some_of
from rig.messages.message import Message, compose

MAX_LEVEL = 4  # of 255 that an empty pixel is from black or white; the rest is JPEG's
MIN_SHARE = 0.002  # of the picture: less is no rim
MAX_SHARE = 0.9  # of the picture: more is one that is dark or burnt out; beside a fisheye's circle lies 0.6 at most
SOFT_PX = 2  # where the edge of a rim is averaged with the picture


def fill_rims(
    images: Mapping[str, ImageRgb], plates: Mapping[str, Sequence[ImageRgb]], masked: Collection[str]
) -> tuple[dict[str, ImageRgb], dict[str, tuple[ImageRgb, ...]], list[Message]]:
    """Fills the rim that a picture has and its plates have not with what the first plate shows there, and the reverse.
    Plates of cameras that are ``masked`` are not asked."""
    filled, behind = dict(images), {name: tuple(of) for name, of in plates.items()}
    rimmed = []
    for name, image in images.items():
        if name in masked or not behind.get(name):
            continue
        first = behind[name][0]
        filled[name] = _without_rim(image, first)
        behind[name] = tuple(_without_rim(plate, image) for plate in behind[name])
        if filled[name] is not image or behind[name][0] is not first:
            rimmed.append(name)
    return filled, behind, [compose("rims-empty", cameras=some_of(rimmed), count=len(rimmed))] if rimmed else []


def _without_rim(image: ImageRgb, other: ImageRgb) -> ImageRgb:
    """Returns the picture with its empty rim as ``other`` shows it, or as it is where it has none or both have it."""
    rim = empty_rim(image)
    if rim is None or rim.mean() > MAX_SHARE or (rim & ~_empty(other)).mean() < MIN_SHARE:
        return image
    soft = cv2.dilate(rim.view(np.uint8), np.ones((2 * SOFT_PX + 1, 2 * SOFT_PX + 1), np.uint8)).view(bool)
    filled = np.where(soft[..., None], other, image)
    filled.setflags(write=False)
    return filled


def empty_rim(image: ImageRgb) -> Bool[np.ndarray, "h w"] | None:
    """Returns the pixels of one value, black or white, that are connected with the border; None where they do not touch
    all four sides of the picture, as dark clothes and burnt-out windows do not."""
    for dark in (True, False):
        sides = (image[:1], image[-1:], image[:, :1], image[:, -1:])
        if not all(_of_value(side, dark=dark).any() for side in sides):
            continue
        empty = _of_value(image, dark=dark)
        _, labels = cv2.connectedComponents(empty.view(np.uint8), connectivity=8)
        at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        return empty & np.isin(labels, at_border[at_border > 0])
    return None


def _of_value(image: ImageRgb, *, dark: bool) -> Bool[np.ndarray, "h w"]:
    return image.max(axis=2) <= MAX_LEVEL if dark else image.min(axis=2) >= 255 - MAX_LEVEL


def _empty(image: ImageRgb) -> Bool[np.ndarray, "h w"]:
    return _of_value(image, dark=True) | _of_value(image, dark=False)
