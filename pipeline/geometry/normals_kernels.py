"""Compiled loops of ``pipeline.geometry.normals``."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def cosines_towards(place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the cosine between the unit normal (n, 3) of each of the points (n, 3) and the direction to a place."""
    cosine = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = place[0] - points[n, 0], place[1] - points[n, 1], place[2] - points[n, 2]
        along = x * normals[n, 0] + y * normals[n, 1] + z * normals[n, 2]
        cosine[n] = along / np.sqrt(x * x + y * y + z * z)
    return cosine
