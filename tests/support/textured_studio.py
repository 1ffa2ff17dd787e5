"""A studio of flat pictures for the tests of devices: walls with texture, a head-and-shoulders blob, sensor noise.

It knows nothing of cameras or lenses, so the tests of streams, drivers and sessions need no renderer; what matters is
that every camera has a background of its own, and that no two pictures have the same noise.
"""

import itertools

import cv2
import numpy as np

NAMES = tuple(f"cam{i:02}" for i in range(11))
NOISE = 2.0  # standard deviation, values


class FlatStudio:
    """An ImageSource: ``camera``'s wall, with or without the subject before it."""

    def __init__(self, seated: bool, width: int = 320, height: int = 240) -> None:
        self._seated = seated
        self._size = (height, width)
        self._takes = itertools.count()
        self._walls = {name: self._wall(index) for index, name in enumerate(NAMES)}

    def __call__(self, camera: str, time_s: float) -> np.ndarray:
        picture = self._walls[camera].copy()
        if self._seated:
            height, width = self._size
            centre = (width // 2, height // 2)
            cv2.ellipse(
                picture, (centre[0], height), (width // 4, height // 3), 0, 180, 360, (90, 60, 70), -1, cv2.LINE_AA
            )
            cv2.ellipse(picture, centre, (width // 9, height // 5), 0, 0, 360, (190, 140, 120), -1, cv2.LINE_AA)
        noise = np.random.default_rng(next(self._takes)).standard_normal(picture.shape, np.float32)
        return np.clip(np.round(picture + NOISE * noise), 0, 255).astype(np.uint8)

    def _wall(self, index: int) -> np.ndarray:
        rng = np.random.default_rng(index)
        cell = 12 + index  # no two walls have their edges in the same places
        coarse = rng.uniform(60, 160, (self._size[0] // cell, self._size[1] // cell, 3)).astype(np.float32)
        wall = cv2.resize(coarse, self._size[::-1], interpolation=cv2.INTER_NEAREST)
        return cv2.GaussianBlur(wall, (0, 0), 0.8).astype(np.uint8)
