"""Cuts squares out of a picture, turned so that a face is upright in them, and resamples them to the size of a
network's input.

A picture is kept at full size and repeatedly halved, so that a small sample of a large face averages over its pixels.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.capture import ImageRgb

SMALLEST_PX = 192  # of the longer side: no network wants a smaller picture
AREA_FROM = 1.7  # pixels of the picture to one of the crop from which the next half is read: bilinear reads two


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """Holds a square part of a picture: its centre and side (px of the picture), and the angle (degrees, clockwise) by
    which the square is turned in the picture. A ``mirrored`` crop is read from right to left."""

    centre_px: Float[np.ndarray, " 2"]
    side_px: float
    roll_deg: float
    mirrored: bool = False

    def picture_from_crop(self, size: int) -> Float[np.ndarray, "2 3"]:
        """Returns the affine map (2 x 3) from pixels of this crop, sampled at ``size`` x ``size``, to pixels of the
        picture."""
        turn = np.deg2rad(self.roll_deg)
        scale = self.side_px / size
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if self.mirrored:
            linear[:, 0] *= -1.0
        middle = np.full(2, (size - 1) / 2)
        return np.column_stack([linear, self.centre_px - linear @ middle])


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Holds a picture at full size, half, quarter and so on, the full size first."""

    levels: tuple[ImageRgb, ...]

    @property
    def size_px(self) -> Float[np.ndarray, " 2"]:
        """Returns the width and height of the full-size picture in pixels."""
        return np.array(self.levels[0].shape[1::-1], float)

    def sample(self, crop: Crop, size: int) -> UInt8[np.ndarray, "size size 3"]:
        """Returns the pixels of a crop, resampled to ``size`` x ``size``; black where the crop leaves the picture."""
        picture_from_crop = crop.picture_from_crop(size)
        halvings = int(np.ceil(np.log2(max(crop.side_px / size / AREA_FROM, 1.0))))
        level = self.levels[min(halvings, len(self.levels) - 1)]
        ratio = np.array(level.shape[1::-1]) / self.size_px
        level_from_crop = ratio[:, None] * picture_from_crop
        level_from_crop[:, 2] += 0.5 * ratio - 0.5  # pixel centres: u' = (u + 1/2) ratio - 1/2
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(level, level_from_crop, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT)


def make_pyramid(image: ImageRgb) -> Pyramid:
    """Halves a picture again and again, until its longer side is below twice ``SMALLEST_PX``, and returns all sizes."""
    levels = [np.ascontiguousarray(image)]
    while max(levels[-1].shape[:2]) >= 2 * SMALLEST_PX:
        height, width = levels[-1].shape[:2]
        half = ((width + 1) // 2, (height + 1) // 2)
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return Pyramid(tuple(levels))


def in_picture(
    points_crop: Float[np.ndarray, "n 2"], picture_from_crop: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "n 2"]:
    """Returns the pixels of the picture at which points of a crop lie."""
    return points_crop @ picture_from_crop[:, :2].T + picture_from_crop[:, 2]
