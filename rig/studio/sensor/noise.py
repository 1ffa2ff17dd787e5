"""Draws smooth random fields."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8


def volume(rng: np.random.Generator, cells: int) -> UInt8[np.ndarray, "n n n 4"]:
    """Draws independent random bytes for a 3D texture that repeats, ``cells`` a side."""
    return rng.integers(0, 256, (cells, cells, cells, 4), np.uint8)


def smooth(
    rng: np.random.Generator, height: int, width: int, cells_high: int, cells_wide: int, channels: int = 1
) -> Float[np.ndarray, "h w c"]:
    """Draws a smooth random field (float32): normal values on a coarse grid of cells, interpolated by cubics."""
    grid = rng.standard_normal((cells_high + 3, cells_wide + 3, channels)).astype(np.float32)
    large = cv2.resize(grid, (width * (cells_wide + 3) // cells_wide, height * (cells_high + 3) // cells_high),
                       interpolation=cv2.INTER_CUBIC)  # fmt: skip
    large = large.reshape(large.shape[0], large.shape[1], channels)
    top, left = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
    return large[top : top + height, left : left + width]


def around(
    rng: np.random.Generator, rows: int, columns: int, cells_high: int, cells_wide: int
) -> Float[np.ndarray, "h w"]:
    """Draws a smooth random field (float64) like ``smooth``, but of one channel and periodic: its first column follows
    its last."""
    grid = rng.standard_normal((cells_high + 2, cells_wide)).astype(np.float32)
    grid = np.concatenate([grid[:, -3:], grid, grid[:, :3]], axis=1)
    step = columns / cells_wide
    x = (np.arange(columns, dtype=np.float32) / step + 3.0)[None, :].repeat(rows, 0)
    y = np.linspace(0.5, cells_high + 0.5, rows, dtype=np.float32)[:, None].repeat(columns, 1)
    return cv2.remap(grid, x, y, cv2.INTER_CUBIC).astype(float)


def waves(
    rng: np.random.Generator, points: Float[np.ndarray, "n 3"], shortest_mm: float, longest_mm: float
) -> Float[np.ndarray, " n"]:
    """Draws a random field in space with standard deviation 1, and returns its values at ``points`` (mm). It is a sum
    of waves of random directions, with lengths from ``shortest_mm`` to ``longest_mm``."""
    count = 32
    directions = rng.normal(0, 1, (count, 3))
    lengths = rng.uniform(shortest_mm, longest_mm, (count, 1))
    directions *= 2 * np.pi / lengths / np.linalg.norm(directions, axis=1, keepdims=True)
    phases = points @ directions.T + rng.uniform(0, 2 * np.pi, count)
    return np.sin(phases).sum(axis=1) / np.sqrt(count / 2)
