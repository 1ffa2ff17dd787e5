"""Compiled loop of ``pipeline.geometry.fans``."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True)
def sort_corners(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts the corners of faces (f, 3) by their vertices, by counting: those of vertex v are ``corner[start[v]:start[v
    + 1]]``, numbers of the corners row by row, in order."""
    start, corner = np.zeros(count + 1, np.int64), np.empty(faces.size, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(count):
        start[v + 1] += start[v]
    taken = start[:-1].copy()
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            corner[taken[v]] = 3 * f + k
            taken[v] += 1
    return start, corner
