"""Draws what stands behind the subject in each camera's image: a cloth with folds and panels, lit unevenly, out of
focus."""

import cv2
import numpy as np
from jaxtyping import Float

from rig.camera import Intrinsics
from rig.studio.sensor.noise import smooth

COLOURS = ((0.20, 0.36, 0.26), (0.12, 0.19, 0.38), (0.28, 0.28, 0.36), (0.16, 0.30, 0.42), (0.36, 0.34, 0.30))
"""Linear RGB: green, blue, lilac grey, light blue, warm grey."""


def backdrop(
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    unevenness: float,
    colour: tuple[float, float, float] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Draws the backdrop of one camera's picture (linear radiance, float32). ``colour`` is linear RGB; None draws one
    at random."""
    height, width = intrinsics.height, intrinsics.width
    base = np.array(COLOURS[rng.integers(len(COLOURS))] if colour is None else colour, np.float32)
    image = np.broadcast_to(base, (height, width, 3)).astype(np.float32)
    if unevenness <= 0:
        return image
    unit = height / 768
    folds = smooth(rng, height, width, 2, 14) + 0.5 * smooth(rng, height, width, 3, 40)
    image = image * (1 + unevenness * (0.07 * folds + 0.10 * smooth(rng, height, width, 2, 2)))
    for _ in range(rng.integers(2, 6)):
        tint = base * rng.uniform(0.45, 1.5) * rng.uniform(0.85, 1.15, 3)
        _panel(image, rng, tint.astype(np.float32), unevenness)
    image = cv2.GaussianBlur(image, (0, 0), 3.0 * unit)
    weave = smooth(rng, height, width, height // 4, width // 4)
    return np.maximum(image * (1 + 0.02 * unevenness * weave), 0.004).astype(np.float32)


def _panel(image: Float[np.ndarray, "h w 3"], rng: np.random.Generator, tint: np.ndarray, strength: float) -> None:
    height, width = image.shape[:2]
    w, h = int(width * rng.uniform(0.04, 0.18)), int(height * rng.uniform(0.08, 0.35))
    x, y = rng.integers(-w // 2, width - w // 2), rng.integers(-h // 2, height - h // 2)
    part = image[max(y, 0) : y + h, max(x, 0) : x + w]
    part += min(strength, 1.0) * 0.8 * (tint - part)


def chair(width: int, height: int, rng: np.random.Generator) -> Float[np.ndarray, "h w 4"]:
    """Draws the back of a chair at one side of the picture: linear RGB times alpha, and alpha."""
    image = np.zeros((height, width, 4), np.float32)
    colour = (*(rng.uniform(0.02, 0.08, 3)).tolist(), 1.0)
    left = int(width * (rng.uniform(0.03, 0.08) if rng.random() < 0.5 else rng.uniform(0.76, 0.8)))
    right, top = left + int(0.15 * width), int(0.55 * height)
    bar = max(int(0.018 * width), 2)
    for x in (left, right - bar):
        cv2.rectangle(image, (x, top), (x + bar, height), colour, -1)
    for y in range(top, height, int(0.11 * height)):
        cv2.rectangle(image, (left, y), (right, y + bar), colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 2.0 * height / 768)
