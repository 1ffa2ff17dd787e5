"""The samples of a matching window."""

import numpy as np
from jaxtyping import Float32


def square_pattern(radius_px: int) -> Float32[np.ndarray, "2 s"]:
    """Returns the offsets (across and down, px) of every pixel in a square about its middle."""
    side = np.arange(-radius_px, radius_px + 1, dtype=np.float32)
    down, across = np.meshgrid(side, side, indexing="ij")
    return np.stack([across.ravel(), down.ravel()])
