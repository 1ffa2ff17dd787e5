"""Pictures of the screen clock, as cameras of the studio would take them, and when each was exposed."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from rig.acquisition.screen_clock import PERIOD, draw_row

SIZE = (480, 640)  # height and width
CELL_PX = 12  # of the screen
SCREEN_HZ = 60.0


@dataclass(frozen=True)
class FreeCamera:
    """Exposes ``exposure_s`` long, ``rate_hz`` times a second, first at ``first_s``."""

    rate_hz: float
    first_s: float
    exposure_s: float

    def next_begin_s(self, time_s: float) -> float:
        """When the first exposure after a moment begins."""
        return np.ceil((time_s - self.first_s) * self.rate_hz) / self.rate_hz + self.first_s


def photograph_clock(begin_s: float, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
    """The screen from a little aside: refreshes within the exposure are blended, with blur and noise."""
    begin, end = SCREEN_HZ * begin_s, SCREEN_HZ * (begin_s + exposure_s)
    edges = np.unique([begin, *np.arange(np.ceil(begin), end), end])
    shown = sum((b - a) * draw_row(int((a + b) / 2) % PERIOD).astype(float) for a, b in pairwise(edges))
    screen = cv2.resize(shown / (end - begin), None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST)
    height, width = screen.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = np.array([[110, 190], [530, 205], [525, 265], [115, 260]]) + rng.normal(0.0, 10.0, (4, 2))
    warp = cv2.getPerspectiveTransform(corners, seen.astype(np.float32))
    picture = cv2.warpPerspective(screen, warp, SIZE[::-1], flags=cv2.INTER_AREA, borderValue=120.0)
    noisy = 0.8 * cv2.GaussianBlur(picture, (0, 0), 0.8) + 20.0 + rng.normal(0.0, 4.0, SIZE)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def true_middles_s(cameras: Mapping[str, FreeCamera], asked_s: np.ndarray) -> dict[str, np.ndarray]:
    """When the middle of each exposure was, of the first pictures after the moments ``asked_s``."""
    return {
        name: np.array([camera.next_begin_s(moment) for moment in asked_s]) + camera.exposure_s / 2
        for name, camera in cameras.items()
    }
