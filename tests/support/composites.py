"""Photographs composed from known shapes: the truth is a formula, and nothing here is shared with the code under test.

A subject of smooth outline stands before a patterned backdrop. Light adds up in linear units, 3 x 3 samples a pixel,
then comes the lens's blur, noise, the sRGB curve and rounding.
"""

from dataclasses import dataclass

import cv2
import numpy as np

OVERSAMPLING = 3


@dataclass(frozen=True)
class Scene:
    """What a composite shows. Colours are linear, 0 to 1."""

    width: int = 480
    height: int = 360
    backdrop: tuple[float, float, float] = (0.20, 0.30, 0.35)
    pattern: float = 0.25  # relative depth of the backdrop's waves and panels
    skin: tuple[float, float, float] = (0.50, 0.32, 0.24)
    hair: tuple[float, float, float] = (0.05, 0.035, 0.025)
    coat: tuple[float, float, float] = (0.30, 0.10, 0.12)
    gain: float = 1.01  # light at the shot by light at the plate
    drift: float = 0.01  # smooth change of light over the image
    blur_px: float = 0.7
    noise: float = 0.015  # of full scale, in sRGB codes
    shadow: float = 0.0  # share of light that a soft shadow beside the head takes
    chair: tuple[int, int, int, int] | None = None  # columns and rows of something that stands there at the shot only
    seed: int = 0
    plates: int = 1


def compose(scene: Scene) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """The photograph, its clean plates, and the true signed distance (px, negative inside) at pixel centres."""
    rng = np.random.default_rng(scene.seed)
    n = OVERSAMPLING
    fine_x, fine_y = np.meshgrid(
        ((np.arange(scene.width * n) + 0.5) / n - 0.5).astype(np.float32),
        ((np.arange(scene.height * n) + 0.5) / n - 0.5).astype(np.float32),
    )
    backdrop = _backdrop(scene, fine_x, fine_y)
    light = 1 + scene.drift * np.sin(fine_x / scene.width * 2.1 + 0.4) * np.cos(fine_y / scene.height * 1.7)
    lit = backdrop * (scene.gain * light)[:, :, None]
    if scene.shadow:
        away = np.hypot((fine_x - 0.72 * scene.width) / 0.16, (fine_y - 0.45 * scene.height) / 0.3) / scene.width
        lit *= (1 - scene.shadow * np.clip(1.6 - 1.6 * away, 0, 1))[:, :, None]
    if scene.chair is not None:
        left, right, top, bottom = scene.chair
        lit[(fine_x > left) & (fine_x < right) & (fine_y > top) & (fine_y < bottom)] = (0.35, 0.18, 0.05)
    inside = outline(scene, fine_x, fine_y) < 0
    subject = _subject(scene, fine_x, fine_y) * scene.gain
    shot = _photograph(np.where(inside[:, :, None], subject, lit), scene, rng)
    plates = tuple(_photograph(backdrop, scene, rng) for _ in range(scene.plates))
    x, y = np.meshgrid(np.arange(scene.width, dtype=float), np.arange(scene.height, dtype=float))
    return shot, plates, _true_distance(scene, x, y)


def outline(scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A level function of head and shoulders, negative inside; near its zero almost the distance in pixels."""
    s = scene.height / 240
    head = (np.hypot((x / s - 160) / 0.8, y / s - 95) - 62) * 0.85 * s
    shoulders = (np.hypot((x / s - 160) / 2.1, y / s - 250) - 62) * 1.2 * s
    neck = np.maximum(np.abs(x / s - 160) - 24, -(y / s - 130)) * s
    # Joined smoothly: at a corner the lens's blur, and no error, moves the contour.
    return _joined(_joined(head, neck, 14 * s), shoulders, 14 * s)


def _joined(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The smooth minimum of Quilez: https://iquilezles.org/articles/smin/"""
    share = np.clip(width - np.abs(a - b), 0, None) / width
    return np.minimum(a, b) - share * share * share * width / 6


def _true_distance(scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Level by gradient: the distance to second order, which is all that is needed near the contour."""
    step = 1e-3
    level = outline(scene, x, y)
    across = (outline(scene, x + step, y) - outline(scene, x - step, y)) / (2 * step)
    down = (outline(scene, x, y + step) - outline(scene, x, y - step)) / (2 * step)
    return level / np.maximum(np.hypot(across, down), 1e-6)


def _backdrop(scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    waves = np.sin(x / 17 + 0.3 * np.sin(y / 40)) * 0.5 + np.sin(y / 29) * 0.3
    panels = np.where((x % 97 < 22) & (y % 83 < 40), 0.6, 0.0)
    return np.array(scene.backdrop, np.float32) * (1 + scene.pattern * (waves + panels))[:, :, None]


def _subject(scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    s = scene.height / 240
    shade = 0.85 + 0.15 * np.sin(x / s / 25 + 1) * np.cos(y / s / 31)
    strands = 1 + 0.35 * np.sin(x * 1.3 / s + np.sin(y / s / 5))
    colour = np.broadcast_to(np.array(scene.skin, np.float32), (*x.shape, 3)) * shade[:, :, None]
    hair = y / s < 70 + 12 * np.cos((x / s - 160) / 30)
    colour = np.where(hair[:, :, None], np.array(scene.hair, np.float32) * strands[:, :, None], colour)
    coat = y / s > 195
    return np.where(
        coat[:, :, None], np.array(scene.coat, np.float32) * (1 + 0.1 * np.sin(y / s / 3))[:, :, None], colour
    )


def _photograph(linear: np.ndarray, scene: Scene, rng: np.random.Generator) -> np.ndarray:
    n = OVERSAMPLING
    blurred = cv2.GaussianBlur(linear, (0, 0), scene.blur_px * n) if scene.blur_px else linear
    light = cv2.resize(blurred, (scene.width, scene.height), interpolation=cv2.INTER_AREA)
    codes = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    noisy = codes + rng.normal(0, scene.noise, codes.shape)
    return np.clip(np.rint(255 * noisy), 0, 255).astype(np.uint8)
