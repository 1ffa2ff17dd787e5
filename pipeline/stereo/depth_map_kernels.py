"""Compiled loops that place the pixels of a depth map in space."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def place_known(
    depth: np.ndarray, deviation: np.ndarray, pinhole: np.ndarray, turn: np.ndarray, shift: np.ndarray
) -> np.ndarray:
    """Returns the places (n, 3; world, mm) of the pixels whose ``deviation`` is finite, row by row. ``pinhole`` is fx
    fy cx cy; ``turn`` (3, 3) and ``shift`` (3) are those of world_from_camera."""
    height, width = depth.shape
    count = 0
    for row in range(height):
        for column in range(width):
            count += np.isfinite(deviation[row, column])
    points, n = np.empty((count, 3)), 0
    for row in range(height):
        for column in range(width):
            if np.isfinite(deviation[row, column]):
                z = float(depth[row, column])
                x, y = (column - pinhole[2]) / pinhole[0] * z, (row - pinhole[3]) / pinhole[1] * z
                for axis in range(3):
                    points[n, axis] = turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z + shift[axis]
                n += 1
    return points


@njit(cache=True, nogil=True, error_model="numpy")
def normals_of_known(
    depth: np.ndarray, slopes: np.ndarray, known: np.ndarray, pinhole: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """Returns the unit normals (h, w, 3; world, towards the camera) of the surface at ``known`` pixels, 0 at others,
    from depths (mm) and slopes (h, w, 2; mm a pixel). ``pinhole`` and ``turn`` as in ``place_known``."""
    height, width = depth.shape
    normals = np.zeros((height, width, 3), np.float32)
    for row in range(height):
        for column in range(width):
            if not known[row, column]:
                continue
            x, y = (column - pinhole[2]) / pinhole[0], (row - pinhole[3]) / pinhole[1]
            per_mm = 1.0 / max(float(depth[row, column]), 1.0)
            a, b = slopes[row, column, 0] * pinhole[0] * per_mm, slopes[row, column, 1] * pinhole[1] * per_mm
            c = -(1.0 + x * a + y * b)
            share = 1.0 / np.sqrt(a * a + b * b + c * c)
            for axis in range(3):
                normals[row, column, axis] = (turn[axis, 0] * a + turn[axis, 1] * b + turn[axis, 2] * c) * share
    return normals
