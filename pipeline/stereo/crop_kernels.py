"""Compiled loop of ``crops``: which point of a photograph each pixel of a pinhole camera shows."""

import numpy as np

from pipeline.geometry.projection_kernels import NOWHERE, distorted
from rig.jit import njit

BESIDE_PX = -1e4  # a place that is in no photograph


@njit(cache=True, nogil=True)
def fill_lens_map(crop: np.ndarray, lens: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> None:
    """Fills ``columns`` and ``rows`` (h, w) with the point (px) of the photograph that each pixel of a pinhole camera
    at the same pose shows; ``BESIDE_PX`` if there is none. ``crop`` is fx, fy, cx, cy of the pinhole; ``lens`` that of
    the photograph (``packed_lens``)."""
    height, width = columns.shape
    for row in range(height):
        for column in range(width):
            u, v = distorted((column - crop[2]) / crop[0], (row - crop[3]) / crop[1], lens)
            seen = u < NOWHERE
            columns[row, column] = u if seen else BESIDE_PX
            rows[row, column] = v if seen else BESIDE_PX
