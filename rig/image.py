"""Defines the array type of pictures in memory, and distinguishes grey pictures from colour pictures."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

ImageRgb = UInt8[np.ndarray, "h w 3"]
"""A picture as sRGB, row by row from the top; h and w are those of the call's other pictures."""

GREY_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue: ITU-R BT.601, as JPEG has it
SPARSE = (slice(None, None, 16), slice(None, None, 16))  # tested first: most colour pictures show colour there


def is_grey(image: UInt8[np.ndarray, "_ _ 3"]) -> bool:
    """Returns whether red, green and blue are equal in every pixel."""
    return all(bool((part == part[..., :1]).all()) for part in (image[SPARSE], image))


def plates_for(
    image: UInt8[np.ndarray, "_ _ 3"], plates: Sequence[UInt8[np.ndarray, "_ _ 3"]]
) -> tuple[UInt8[np.ndarray, "_ _ 3"], ...]:
    """Returns the clean plates (pictures of the empty studio), in grey if ``image`` is grey, for comparison with it."""
    if not plates or not is_grey(image):
        return tuple(plates)
    return tuple(plate if is_grey(plate) else _in_grey(plate) for plate in plates)


def _in_grey(image: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    grey = np.rint(image @ GREY_WEIGHTS).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)
