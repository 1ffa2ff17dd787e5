"""The compiled loop of ``crops``: where a photograph with its lens shows the pixels of a pinhole."""

import numpy as np

from pipeline.compute.jit import njit
from pipeline.geometry.projection_kernels import NOWHERE, distorted

BESIDE_PX = -1e4  # a place that is in no photograph


@njit(cache=True, nogil=True)
def fill_lens_map(crop: np.ndarray, lens: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> None:
    """Fills column and row in the photograph of each pixel (h, w) of a pinhole with fx fy cx cy ``crop`` at the same
    pose; ``lens`` as ``packed_lens`` has it."""
    height, width = columns.shape
    for row in range(height):
        for column in range(width):
            u, v = distorted((column - crop[2]) / crop[0], (row - crop[3]) / crop[1], lens)
            seen = u < NOWHERE
            columns[row, column] = u if seen else BESIDE_PX
            rows[row, column] = v if seen else BESIDE_PX
